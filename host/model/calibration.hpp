// What a calibration knows: written by the solver, kept in a file, read by the filter.
#pragma once

#include <limits>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "host/model/antenna_pattern.hpp"
#include "host/model/types.hpp"

namespace groma::model {

enum class AnchorVerdict { kOk, kWeakZ, kWeak, kNeverInSight, kMoved, kNoData };
// Whether a filter may use an anchor of that verdict.
[[nodiscard]] constexpr bool is_usable(AnchorVerdict verdict) noexcept {
  return verdict == AnchorVerdict::kOk || verdict == AnchorVerdict::kWeakZ;
}
enum class Verdict { kUsable, kWarnings, kUnusable };

// Constant and range-dependent bias of one tag and anchor, with marginal sigmas.
struct PairBias {
  NodeId tag_id = 0;
  double beta_m = 0.0;
  double beta_sigma_m = 0.0;
  double gamma = 1.0;
  double gamma_sigma = 0.0;
};

struct AnchorCalibration {
  NodeId id = 0;
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  std::vector<PairBias> pairs;  // by tag id, ascending; T of them
  // (3 + 2T) x (3 + 2T): position, then beta of each pair, then gamma of each pair, in the order of `pairs`.
  // All of the anchor's error, what it shares with the others by the common frame among it.
  Eigen::MatrixXd covariance;
  std::size_t ranges_used = 0;
  std::size_t ranges_rejected = 0;
  std::optional<double> held_out_rms_m;         // none: too few ranges were held out
  std::optional<double> held_out_robust_rms_m;  // the same from the median: outliers do not count
  std::optional<double> mirror_ratio;  // cost of the best solution over that of its mirror side, 0..1
  AnchorVerdict verdict = AnchorVerdict::kNoData;
  std::string advice;  // empty when there is nothing to do
};

// Whether there is a position with its whole block of covariance.
[[nodiscard]] bool has_position(const AnchorCalibration& anchor) noexcept;

// base_link; each axis that was not shown clearly is as it was said to be, with a variance of null: NaN.
struct LeverArmCalibration {
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Vector3d sigma_m = Eigen::Vector3d::Constant(std::numeric_limits<double>::quiet_NaN());
};

// What a drive showed of a tag on the robot's body.
struct TagCalibration {
  NodeId id = 0;
  std::optional<LeverArmCalibration> lever_arm;  // none: as it was said to be
  std::optional<PatternTerms> pattern_m;  // of its antenna, in base_link: coefficients of pattern_terms()
};

// Of a range in sight, what beta and gamma leave: white noise, and an error that lasts (reflections, shadows
// of what is near, poor surveys), first-order Gauss-Markov, common to an anchor's tags.
struct RangeNoise {
  double white_sigma_m = 0.0;
  double slow_sigma_m = 0.0;
  double slow_time_s = 1.0;  // correlation falls by e over it
};

struct Calibration {
  std::string frame = "map";
  std::vector<AnchorCalibration> anchors;  // by id, ascending
  std::vector<TagCalibration> tags;        // by id, ascending: those of which there is something to tell
  // Covariance F (x, y, z, yaw about the map's origin) of the frame error that all anchors share through the
  // drive's poses: a + (x, y, z) + yaw (z axis x a). It is a part of each anchor's block, not on top of it:
  // between the positions of two anchors stands place_by_frame(a) F place_by_frame(b)^T, and own_covariance()
  // is what is left of a block. Zero: errors of anchors are independent.
  Eigen::Matrix4d common_frame_covariance = Eigen::Matrix4d::Zero();
  // Ranges are stamped so much later than measured, against the poses; both zero: not observed.
  double range_delay_s = 0.0;
  double range_delay_sigma_s = 0.0;
  std::optional<RangeNoise> range_noise;  // none: not observed
  Verdict verdict = Verdict::kUnusable;
  std::string input_sha256;
  std::string program_version;
};

// Null where there is none of that id.
[[nodiscard]] const AnchorCalibration* find_anchor(const Calibration& calibration, NodeId id) noexcept;

// The shift of a place by the common frame's (x, y, z, yaw): 3 x 4.
[[nodiscard]] Eigen::Matrix<double, 3, 4> place_by_frame(const Eigen::Vector3d& place_m) noexcept;

// The anchor's block less what it has of the common frame: what is independent of the other anchors. Where
// the frame is said to vary more than the block has room for, given its biases, only what there is room for
// is taken off, so that it stays a covariance.
[[nodiscard]] Eigen::MatrixXd own_covariance(const AnchorCalibration& anchor,
                                             const Eigen::Matrix4d& common_frame_covariance);
// Makes an own covariance the whole block again.
void add_common_frame(AnchorCalibration& anchor, const Eigen::Matrix4d& common_frame_covariance);

// Positions as surveyed, with that sigma an axis; beta and gamma of each pair at their priors; no error of a
// common frame.
[[nodiscard]] Calibration surveyed_calibration(std::span<const Anchor> anchors, std::span<const Tag> tags,
                                               const RangePriors& priors, double position_sigma_m);

}  // namespace groma::model
