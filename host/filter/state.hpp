// The filter's state: a small core that is always estimated, and the parameters of the site.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>

#include <Eigen/Core>

namespace groma::filter {

// Anchors that are active at a time, and tags: CMake's GROMA_ACTIVE_ANCHORS and GROMA_TAGS.
#ifdef GROMA_ACTIVE_ANCHORS
inline constexpr int kMaxAnchors = GROMA_ACTIVE_ANCHORS;
inline constexpr int kMaxTags = GROMA_TAGS;
#else
inline constexpr int kMaxAnchors = 16;
inline constexpr int kMaxTags = 4;
#endif

// For what is kept of each pair of an active anchor's slot and a tag.
inline constexpr std::size_t kMaxPairs = static_cast<std::size_t>(kMaxAnchors) * kMaxTags;
[[nodiscard]] constexpr std::size_t pair_at(int slot, int tag) noexcept {
  return static_cast<std::size_t>(slot) * kMaxTags + static_cast<std::size_t>(tag);
}

// What is left of a sum that fades over `over_s`, from one time to a later one.
[[nodiscard]] inline double fading(double from_s, double to_s, double over_s) noexcept {
  return std::exp(-std::max(to_s - from_s, 0.0) / over_s);
}

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

// Parameters: the error of the frame that all anchors share (x, y, z, yaw); lever arms (3 a tag); of each
// active anchor its position (3), beta (a tag), gamma (a tag) and its slow range error; what the ground is
// higher (m) and steeper (dS/dx, dS/dy) by than the surface tells.
inline constexpr int kFrameSize = 4;
inline constexpr int kMaxCommon = kFrameSize + 3 * kMaxTags;
inline constexpr int kMaxAnchorSize = 3 + 2 * kMaxTags + 1;
inline constexpr int kGroundSize = 3;
inline constexpr int kMaxParameters = kMaxCommon + kMaxAnchors * kMaxAnchorSize + kGroundSize;

using CoreVector = Eigen::Matrix<double, kCoreSize, 1>;
using CoreMatrix = Eigen::Matrix<double, kCoreSize, kCoreSize>;
using CoreRow = Eigen::Matrix<double, 1, kCoreSize>;
using PoseRows = Eigen::Matrix<double, 3, kCoreSize>;  // derivatives of x, y, theta by the core state
template <int kMaxRows, int kMaxColumns>
using Bounded = Eigen::Matrix<double, Eigen::Dynamic, kMaxColumns == 1 ? 1 : Eigen::Dynamic, Eigen::ColMajor,
                              kMaxRows, kMaxColumns>;
// Of what all anchors share: frame, lever arms.
using CommonVector = Bounded<kMaxCommon, 1>;
using CommonMatrix = Bounded<kMaxCommon, kMaxCommon>;
// Of one anchor: position, beta of each tag, gamma of each tag, slow error.
using AnchorVector = Bounded<kMaxAnchorSize, 1>;
using AnchorMatrix = Bounded<kMaxAnchorSize, kMaxAnchorSize>;
using AnchorByCommon = Bounded<kMaxAnchorSize, kMaxCommon>;
using CommonToAnchor = Bounded<kMaxCommon, kMaxAnchorSize>;

}  // namespace groma::filter
