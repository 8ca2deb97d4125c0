// The result of a calibration: written by the solver, stored in a file, read by the filter.
#pragma once

#include <limits>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "host/model/anchor_parameters.hpp"
#include "host/model/antenna_pattern.hpp"
#include "host/model/clock_error.hpp"
#include "host/model/state_archive.hpp"
#include "host/model/types.hpp"

namespace groma::model {

enum class AnchorVerdict { kOk, kWeakZ, kWeak, kNeverLos, kMoved, kNoData };
// Whether a filter may use an anchor with this verdict.
[[nodiscard]] constexpr bool is_usable(AnchorVerdict verdict) noexcept {
  return verdict == AnchorVerdict::kOk || verdict == AnchorVerdict::kWeakZ;
}
enum class Verdict { kUsable, kWarnings, kUnusable };

struct AnchorCalibration {
  NodeId id = 0;
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  std::vector<PairBias> pairs;  // by tag id, ascending; T of them
  // anchor_size(T) x anchor_size(T), in the order of `pairs`. It is the anchor's whole error, including the
  // common frame's error that all anchors share.
  Eigen::MatrixXd covariance;
  std::size_t ranges_used = 0;
  std::size_t ranges_rejected = 0;
  std::optional<double> held_out_rms_m;         // none: too few ranges were held out
  std::optional<double> held_out_robust_rms_m;  // from the median, so that outliers do not count
  std::optional<double> mirror_ratio;  // cost of the best solution over that of its mirror side, 0..1
  AnchorVerdict verdict = AnchorVerdict::kNoData;
  std::string advice;                         // empty when no action is needed
  std::optional<Eigen::Vector2d> drive_to_m;  // the place that the advice names; not in a calibration file

  void archive(StateArchive& state) {
    state(id, position_m, pairs, covariance, ranges_used, ranges_rejected, held_out_rms_m,
          held_out_robust_rms_m, mirror_ratio, verdict, advice, drive_to_m);
  }
};

// Whether the anchor has a finite position and a finite covariance of the full size.
[[nodiscard]] bool has_position(const AnchorCalibration& anchor) noexcept;

// Position and terms of the anchor's pairs: anchor_size(T).
[[nodiscard]] Eigen::VectorXd values_of(const AnchorCalibration& anchor);
// Sets them, with the sigmas of the pairs' terms.
void set_values(AnchorCalibration& anchor, const Eigen::VectorXd& values, const Eigen::MatrixXd& covariance);

// S, by which the anchor's values v and covariance C are S v and S C S^T for these tags: what the anchor
// lacks is zero.
[[nodiscard]] Eigen::MatrixXd selection(std::span<const NodeId> tags, const AnchorCalibration& anchor);

// In base_link. An axis that the drive does not determine keeps its configured value, with sigma NaN (null in
// files).
struct LeverArmCalibration {
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Vector3d sigma_m = Eigen::Vector3d::Constant(std::numeric_limits<double>::quiet_NaN());
};

// What a drive determined of a tag on the robot's body.
struct TagCalibration {
  NodeId id = 0;
  std::optional<LeverArmCalibration> lever_arm;  // none: as configured
  std::optional<PatternTerms> pattern_m;  // of its antenna, in base_link: coefficients of pattern_terms()
};

// Error of a LOS range beyond beta and gamma: white noise, and a range bias common to an anchor's tags
// (reflections, diffraction at near obstacles, survey errors). The bias is a first-order Gauss-Markov process
// of the way driven: it belongs to a place, and so stays as it is while the robot stands.
struct RangeNoise {
  double white_sigma_m = 0.0;
  double bias_sigma_m = 0.0;   // of the Gauss-Markov range bias
  double bias_length_m = 1.0;  // its correlation falls to 1/e over this way
};

struct Calibration {
  std::string frame = "map";
  std::vector<AnchorCalibration> anchors;  // by id, ascending
  std::vector<TagCalibration> tags;        // by id, ascending: those with a calibrated value
  // Covariance F (x, y, z, yaw about the map's origin) of the frame error that all anchors share through the
  // drive's poses: a + (x, y, z) + yaw (z axis x a). Each anchor's block already includes it: the covariance
  // between the positions a and b of two anchors is position_by_frame(a) F position_by_frame(b)^T, and
  // own_covariance() is a block without it. Zero: errors of anchors are independent.
  Eigen::Matrix4d common_frame_covariance = Eigen::Matrix4d::Zero();
  // Range timestamps are late by this delay, relative to the poses' timestamps; both zero: not observed.
  double range_delay_s = 0.0;
  double range_delay_sigma_s = 0.0;
  std::optional<RangeNoise> range_noise;  // none: not observed
  // Of the range timestamps: they are corrected by it before use, and range_delay_s is what then remains.
  std::optional<ClockError> range_clock;
  Verdict verdict = Verdict::kUnusable;
  std::string input_sha256;
  std::string program_version;

  void archive(StateArchive& state) {
    state(frame, anchors, tags, common_frame_covariance, range_delay_s, range_delay_sigma_s, range_noise,
          range_clock, verdict, input_sha256, program_version);
  }
};

// Null if the calibration has no anchor with this id.
[[nodiscard]] const AnchorCalibration* find_anchor(const Calibration& calibration, NodeId id) noexcept;

// Jacobian of a place by the common frame's (x, y, z, yaw): 3 x 4.
[[nodiscard]] Eigen::Matrix<double, 3, 4> position_by_frame(const Eigen::Vector3d& place_m) noexcept;

// The anchor's block without the common frame's covariance: the part that is independent of the other
// anchors. If the frame's covariance exceeds that of the position given the biases, only the latter is
// subtracted, so that the result stays positive semidefinite.
[[nodiscard]] Eigen::MatrixXd own_covariance(const AnchorCalibration& anchor,
                                             const Eigen::Matrix4d& common_frame_covariance);
// Adds the common frame's covariance to an anchor whose block is its own covariance.
void add_common_frame(AnchorCalibration& anchor, const Eigen::Matrix4d& common_frame_covariance);

// Positions as surveyed, with position_sigma_m on each axis; the terms of each pair at their priors; no
// common frame error.
[[nodiscard]] Calibration surveyed_calibration(std::span<const Anchor> anchors, std::span<const Tag> tags,
                                               const RangePriors& priors, double position_sigma_m);

}  // namespace groma::model
