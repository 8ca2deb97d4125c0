// Verdict and advice for each anchor from statistics of its ranges at the solution, and the verdict on the
// site.
#pragma once

#include <cstddef>
#include <limits>
#include <optional>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/los_chain.hpp"
#include "host/calibration/mirror.hpp"
#include "host/calibration/moved.hpp"
#include "host/model/calibration.hpp"

namespace groma::calibration {

struct FittedRange;
struct Site;

// With fewer ranges an anchor has no data. By hand: some three for each of the nine unknowns with three tags;
// DegenerateDrive.WithOneRangeEachIsNoData holds with it.
inline constexpr std::size_t kMinRanges = 30;
// Largest horizontal sigma, m, of a position that is good enough for a filter. By hand.
inline constexpr double kWeakSigma_m = 0.30;
// Largest horizontal sigma of a position, along the axes of its ellipse.
[[nodiscard]] double horizontal_sigma_m(const Eigen::Matrix3d& covariance_m2);

// LOS and NLOS of one anchor, if the site was solved with NLOS states.
struct LosEvidence {
  LosVector polls = LosVector::Zero();  // share of its polls in each state
  bool counts_missed = false;           // `polls` includes missed replies
  double excess_m = 0.0;                // mean excess of long NLOS at the site
  double far_share = 0.0;               // share of ranges longer than NLOS explains
  double short_share = 0.0;             // share of ranges shorter than NLOS explains
};

// Score of the last part of the drive against the solution of the part before it.
struct HeldOut {
  std::optional<double> rms_m;
  std::optional<double> robust_rms_m;
  std::optional<double> share_of_scale;  // robust rms over its prediction; none if the fit cannot predict it
  double height_variance_m2 = std::numeric_limits<double>::infinity();  // of the fit's height
};

// Statistics of one anchor beside its solution.
struct AnchorEvidence {
  TagSpread spread;                        // of the antennas that ranged to it
  bool surveyed = false;                   // its position is known, and only its biases are estimated
  std::size_t rows = 0;                    // ranges with a pose
  double nearest_m = 0.0;                  // closest antenna
  std::optional<MirrorHypothesis> mirror;  // across the plane of the tags
  std::optional<MirrorHypothesis> side;    // across the line of the drive
  double los_share = 0.0;                  // LOS share of its ranges
  double ignored_share = 0.0;              // share of its ranges with too weak a first path
  HeldOut held_out;
  double scale_ratio = 1.0;  // its noise over the site's median
  double count_ratio = 1.0;  // its ranges over the site's median
  double inflation = 1.0;    // estimate_inflation(): residuals correlated in time
  double flicker = 1.0;      // range-to-range scatter over the site's noise
  AnchorPath path;
  std::optional<model::NodeId> stand_in;  // another anchor whose place it took by a move
  std::optional<LosEvidence> los_states;
};

// Scores the ranges after those of a fit. A residual counts relative to its predicted sigma, which is large
// at places that the robot had not visited by then.
[[nodiscard]] HeldOut score_held_out(const AnchorFit& first, std::span<const Observation> later);

// Residual and LOS probability of each range at a solution.
[[nodiscard]] std::vector<FittedRange> fitted_ranges(const AnchorFit& fit, std::span<const model::Tag> tags);

// Completes the evidence of all anchors; held-out scores and mirror tests have filled in theirs already.
void gather_anchor_evidence(Site& site, std::span<const std::vector<FittedRange>> fitted);

// Whether all or nearly all of its ranges are NLOS. Such ranges are noisier and fewer than those of other
// anchors, and their common excess looks like a bias.
[[nodiscard]] bool is_never_los(const AnchorEvidence& evidence) noexcept;
[[nodiscard]] bool is_hardly_los(const AnchorEvidence& evidence) noexcept;
// Whether more of its ranges are too long or too short than NLOS explains, as with reflections.
[[nodiscard]] bool contradicts_itself(const AnchorEvidence& evidence) noexcept;

// Fills verdict and advice from the anchor's covariance and the evidence.
void judge_anchor(const AnchorEvidence& evidence, model::AnchorCalibration& anchor);

[[nodiscard]] model::Verdict judge_site(std::span<const model::AnchorCalibration> anchors);

}  // namespace groma::calibration
