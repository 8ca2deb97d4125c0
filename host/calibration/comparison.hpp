// Comparison of two calibrations of one site: what changed by more than the uncertainty of both.
#pragma once

#include <vector>

#include <Eigen/Core>

#include "host/model/calibration.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// Offset of B's common frame from A's, estimated from the anchors of both within what the drives' poses
// allow. B's anchors are at a + offset.head<3>() + offset(3) (z axis x a) where A's are at a.
struct FrameOffset {
  Eigen::Vector4d mean = Eigen::Vector4d::Zero();  // x, y, z in m, yaw in rad
  Eigen::Matrix4d covariance = Eigen::Matrix4d::Zero();
};

// An anchor in both calibrations. The frames' offset that is removed from it is estimated from the other
// anchors.
struct AnchorChange {
  model::NodeId id = 0;
  Eigen::Vector3d displacement_m = Eigen::Vector3d::Zero();  // B minus A, without the frames' offset
  Eigen::Matrix3d covariance_m2 = Eigen::Matrix3d::Zero();   // of it
  double chi2 = 0.0;     // squared Mahalanobis distance; 3 degrees of freedom if unchanged
  double chance = 1.0;   // probability of this chi2 or more if unchanged
  bool differs = false;  // chance times the number of anchors is below kChance
  // It differs, and is more than kMoved_m away with 95 % confidence.
  bool moved = false;
};

// B minus A.
struct PairChange : model::PairBias {
  model::NodeId anchor_id = 0;
  bool differs = false;  // as above, among all pairs
};

// The height of an anchor with verdict `weak-z` or `weak` is not trusted: it may be on the other side of the
// tags. This sigma is added to it: by hand, more than the some 4 m between the sides in the paper's hall.
// Without it and bend_over() weak drives made updates worse: 0.189 m from 0.093 m RMSE
// (calibration_update_test).
inline constexpr double kWeakHeight_m = 5.0;

struct Comparison {
  // Probability of a false report per unchanged site (Bonferroni over the anchors): by hand.
  static constexpr double kChance = 1e-3;
  static constexpr double kMoved_m = 0.15;  // as kMinMove_m of moved.hpp

  FrameOffset frame;                  // from all anchors that do not differ
  std::vector<AnchorChange> anchors;  // by id; only those with a position in both
  std::vector<PairChange> pairs;      // of those anchors, by anchor, then tag
  std::vector<model::NodeId> only_a;  // anchors with a position in A alone
  std::vector<model::NodeId> only_b;
};

[[nodiscard]] Comparison compare(const model::Calibration& a, const model::Calibration& b);

// Upper tails of the chi-square distribution.
[[nodiscard]] double chi2_tail_1(double chi2) noexcept;
[[nodiscard]] double chi2_tail_3(double chi2) noexcept;

// Least squared Mahalanobis distance from `displacement_m` to any point within `radius_m` of zero.
[[nodiscard]] double chi2_beyond(const Eigen::Vector3d& displacement_m, const Eigen::Matrix3d& covariance_m2,
                                 double radius_m);

struct Update {
  model::Calibration calibration;    // anchors of both, by id, in the earlier frame
  Comparison comparison;             // later against earlier
  std::vector<model::NodeId> moved;  // by more than Comparison::kMoved_m
  std::vector<model::NodeId> added;
  std::vector<model::NodeId> kept;  // unchanged: the later drive has no data on them
};

// Fuses two calibrations. `later` must have been estimated independently of `earlier`; `priors` are those
// that both had of each pair, and count once. A moved anchor takes the position of the later drive if that is
// usable, else none; its verdict is `moved` in both cases.
[[nodiscard]] Update update(const model::Calibration& earlier, const model::Calibration& later,
                            const model::RangePriors& priors);

}  // namespace groma::calibration
