// The filter's state: a small core that is always estimated, and the parameters of the site.
#pragma once

#include <Eigen/Core>

namespace groma::filter {

inline constexpr int kMaxAnchors = 16;
inline constexpr int kMaxTags = 4;

// Core error state. The last three are the errors of the odometry row that is held now: a row's noise is
// one draw, constant over the row, so that steps within the row share it.
enum CoreIndex : int {
  kX,         // m, map
  kY,         // m, map
  kTheta,     // rad, heading on the surface
  kScale,     // v = (1 + scale) v_row - e_v
  kYawBias,   // rad/s, omega = omega_row - bias - e_omega
  kDelay,     // s, a range tells of the pose that long before its stamp
  kRowVx,     // m/s, e_v
  kRowVy,     // m/s
  kRowOmega,  // rad/s, e_omega
  kCoreSize,
};

// Parameters: of each anchor its position (3), beta (a tag) and gamma (a tag); lever arms (3 a tag); the
// error of the frame that all anchors share (x, y, z, yaw); the slow range error of each anchor.
inline constexpr int kFrameSize = 4;
inline constexpr int kMaxParameters = kMaxAnchors * (3 + 2 * kMaxTags + 1) + 3 * kMaxTags + kFrameSize;

using CoreVector = Eigen::Matrix<double, kCoreSize, 1>;
using CoreMatrix = Eigen::Matrix<double, kCoreSize, kCoreSize>;
using CoreRow = Eigen::Matrix<double, 1, kCoreSize>;

}  // namespace groma::filter
