// Two calibrations of one site, set against each other: what changed by more than both are uncertain.
#pragma once

#include <vector>

#include <Eigen/Core>

#include "host/model/calibration.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// Of B's common frame against A's: what both calibrations' anchors show of it, within what the drives' poses
// allow. B's anchors are at a + offset.head<3>() + offset(3) (z axis x a) where A's are at a.
struct FrameOffset {
  Eigen::Vector4d mean = Eigen::Vector4d::Zero();  // x, y, z in m, yaw in rad
  Eigen::Matrix4d covariance = Eigen::Matrix4d::Zero();
};

// An anchor that both know. The offset that its own difference is freed of is that of the others alone.
struct AnchorChange {
  model::NodeId id = 0;
  Eigen::Vector3d displacement_m = Eigen::Vector3d::Zero();  // B less A, the frames' offset taken out
  Eigen::Matrix3d covariance_m2 = Eigen::Matrix3d::Zero();   // of it
  double chi2 = 0.0;     // squared Mahalanobis distance; 3 degrees of freedom where nothing changed
  double chance = 1.0;   // that so much or more comes about where nothing changed
  bool differs = false;  // even as one of so many anchors: chance times their number is below kChance
  // It differs, and is clearly (95 %) further away than kMoved_m.
  bool moved = false;
};

struct PairChange {
  model::NodeId tag_id = 0;
  model::NodeId anchor_id = 0;
  double beta_m = 0.0;  // B less A
  double beta_sigma_m = 0.0;
  double gamma = 0.0;  // B less A
  double gamma_sigma = 0.0;
  bool differs = false;  // of all pairs, as above
};

// The height of an anchor that is `weak-z` or `weak` is not trusted: it may be on the other side of the tags.
// It counts as this much more uncertain than its covariance says.
inline constexpr double kWeakHeight_m = 5.0;

struct Comparison {
  static constexpr double kChance = 1e-3;
  static constexpr double kMoved_m = 0.15;

  FrameOffset frame;                  // by all anchors that do not differ
  std::vector<AnchorChange> anchors;  // by id; those without a position in either are left out
  std::vector<PairChange> pairs;      // by anchor, then tag; of those anchors
  std::vector<model::NodeId> only_a;  // that have a position there alone
  std::vector<model::NodeId> only_b;
};

[[nodiscard]] Comparison compare(const model::Calibration& a, const model::Calibration& b);

// Upper tails of the chi-square distribution.
[[nodiscard]] double chi2_tail_1(double chi2) noexcept;
[[nodiscard]] double chi2_tail_3(double chi2) noexcept;

// The least squared Mahalanobis distance from `displacement` to any point within `radius` of zero.
[[nodiscard]] double chi2_beyond(const Eigen::Vector3d& displacement_m, const Eigen::Matrix3d& covariance_m2,
                                 double radius_m);

struct Update {
  model::Calibration calibration;    // anchors of both, by id; in the earlier one's frame
  Comparison comparison;             // of the later against the earlier
  std::vector<model::NodeId> moved;  // more than Comparison::kMoved_m
  std::vector<model::NodeId> added;
  std::vector<model::NodeId> kept;  // as they were: the later drive tells nothing of them
};

// `later` was found without `earlier`; `priors` are those that both had of each pair, and count once.
// A moved anchor is where the later drive found it, if that is any good, else without a position; its verdict
// is `moved` in both cases.
[[nodiscard]] Update update(const model::Calibration& earlier, const model::Calibration& later,
                            const model::RangePriors& priors);

}  // namespace groma::calibration
