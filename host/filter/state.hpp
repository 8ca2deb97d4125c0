// The filter's state: a small core that is always estimated (x_c of the source paper, and six more), and the
// parameters of the site (x_s of the source paper, equation (9)).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>

#include <Eigen/Core>

#include "host/model/anchor_parameters.hpp"

namespace groma::filter {

// Maximum number of active anchors and of tags: CMake's GROMA_ACTIVE_ANCHORS and GROMA_TAGS.
#ifdef GROMA_ACTIVE_ANCHORS
inline constexpr int kMaxAnchors = GROMA_ACTIVE_ANCHORS;
inline constexpr int kMaxTags = GROMA_TAGS;
#else
inline constexpr int kMaxAnchors = 16;
inline constexpr int kMaxTags = 4;
#endif

// Number and index of pairs of an active anchor's slot and a tag.
inline constexpr std::size_t kMaxPairs = static_cast<std::size_t>(kMaxAnchors) * kMaxTags;
[[nodiscard]] constexpr std::size_t pair_at(int slot, int tag) noexcept {
  return static_cast<std::size_t>(slot) * kMaxTags + static_cast<std::size_t>(tag);
}

// Exponential forgetting: the factor by which a sum with time constant over_s decays between two times.
[[nodiscard]] inline double fading(double from_s, double to_s, double over_s) noexcept {
  return std::exp(-std::max(to_s - from_s, 0.0) / over_s);
}

// Core error state. The last three are the errors of the odometry sample that is held (zero-order hold). A
// sample's noise is constant until the next sample, so all steps within the interval share it.
enum CoreIndex : int {
  kX,              // m, map
  kY,              // m, map
  kTheta,          // rad, heading on the surface
  kScale,          // v = (1 + scale) v_odometry - e_v
  kYawBias,        // rad/s, omega = omega_odometry - bias - e_omega
  kDelay,          // s, a range measures the pose this long before its timestamp, less the odometry's delay
  kOdometryVx,     // m/s, e_v
  kOdometryVy,     // m/s
  kOdometryOmega,  // rad/s, e_omega
  kCoreSize,
};

// Parameters: the error of the anchors' common frame (x, y, z in m, yaw in rad); the lever arm of each tag
// (3); for each active anchor its model::anchor_size() parameters and its slow (Gauss-Markov) range bias; the
// ground's deviation from the surface model (height in m, dS/dx, dS/dy).
inline constexpr int kFrameSize = 4;
inline constexpr int kMaxCommon = kFrameSize + 3 * kMaxTags;
inline constexpr int kMaxAnchorSize = model::anchor_size(kMaxTags) + 1;
inline constexpr int kGroundSize = 3;
inline constexpr int kMaxParameters = kMaxCommon + kMaxAnchors * kMaxAnchorSize + kGroundSize;

using CoreVector = Eigen::Matrix<double, kCoreSize, 1>;
using CoreMatrix = Eigen::Matrix<double, kCoreSize, kCoreSize>;
using CoreRow = Eigen::Matrix<double, 1, kCoreSize>;
using PoseRows = Eigen::Matrix<double, 3, kCoreSize>;  // derivatives of x, y, theta w.r.t. the core state
template <int kMaxRows, int kMaxColumns>
using Bounded = Eigen::Matrix<double, Eigen::Dynamic, kMaxColumns == 1 ? 1 : Eigen::Dynamic, Eigen::ColMajor,
                              kMaxRows, kMaxColumns>;
// Parameters common to all anchors: frame, lever arms.
using CommonVector = Bounded<kMaxCommon, 1>;
using CommonMatrix = Bounded<kMaxCommon, kMaxCommon>;
// Parameters of one anchor: position, terms of each tag, slow range bias.
using AnchorVector = Bounded<kMaxAnchorSize, 1>;
using AnchorMatrix = Bounded<kMaxAnchorSize, kMaxAnchorSize>;
using AnchorByCommon = Bounded<kMaxAnchorSize, kMaxCommon>;
using CommonToAnchor = Bounded<kMaxCommon, kMaxAnchorSize>;

}  // namespace groma::filter
