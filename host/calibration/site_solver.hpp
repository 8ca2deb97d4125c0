// Solves all anchors of a drive, each by itself but with kernels estimated from all of them, and tests the
// mirror positions of each.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/anchor_solver.hpp"
#include "host/calibration/association.hpp"
#include "host/calibration/los_chain.hpp"
#include "host/calibration/robust_kernel.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// At most max_rows_per_tag observations of each tag, spread evenly along the tag's path: a long stop counts
// no more than a short one.
[[nodiscard]] std::vector<Observation> spread_along_the_way(std::span<const Observation> rows,
                                                            std::size_t tag_count,
                                                            std::size_t max_rows_per_tag);

// Axes of TagSpread to mirror along: across the line of the drive, across the plane of the tags.
inline constexpr int kAcrossLine = 1;
inline constexpr int kAcrossPlane = 2;

// Principal axes of the antennas' positions, map frame.
struct TagSpread {
  Eigen::Vector3d center_m = Eigen::Vector3d::Zero();
  Eigen::Matrix3d axes = Eigen::Matrix3d::Identity();  // columns: largest spread first

  // Mirror image of a point along one axis, 0..2.
  [[nodiscard]] Eigen::Vector3d mirror(const Eigen::Vector3d& point_m, int axis) const noexcept;
};
[[nodiscard]] TagSpread tag_spread(std::span<const Observation> rows);

// The solution in the basin of the start, with kernels estimated from its own residuals: it does not depend
// on a first guess of the noise. The cost is a negative log likelihood, so costs with different kernels are
// comparable.
[[nodiscard]] AnchorFit descend(const AnchorProblem& problem, const AnchorVector& start);

// Search without a start: the best of several descend() solutions. The observations should be few and spread
// out.
[[nodiscard]] AnchorFit search(const AnchorProblem& problem);

// Mirror hypothesis: the best solution on the other side.
struct MirrorHypothesis {
  AnchorVector anchor;
  double cost_excess = 0.0;  // negative log likelihood above the solution's, for independent residuals; >= 0
  double cost_ratio = 1.0;   // the solution's cost over this one's, 0..1, above those of perfect ranges
};

// Tests the mirror hypothesis along one axis. If it explains the ranges better, the fit moves there and its
// former place becomes the mirror hypothesis. The fit must have ranges.
[[nodiscard]] MirrorHypothesis test_mirror(AnchorFit& fit, const TagSpread& spread, int axis);

// Tests across the line and across the plane of the tags, only for what they do to the fit.
void test_both_mirrors(AnchorFit& fit);

// An anchor's position in an earlier calibration.
struct EarlierPlace {
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Matrix3d covariance_m2 = Eigen::Matrix3d::Identity();  // includes the drives' frames
};
// Adds the cost of the earlier position to the hypothesis' excess; it is limited, because the anchor may have
// been moved, and multiplied by `inflation`, because the excess is for independent residuals. If the excess
// becomes negative, fit and hypothesis swap places.
void weigh_by_earlier(const EarlierPlace& earlier, double inflation, AnchorFit& fit,
                      MirrorHypothesis& mirror);

// What the mirror hypothesis adds to the position's covariance, m^2: the second moment about the fit if the
// hypothesis is true with the probability that its excess divided by `inflation` gives.
[[nodiscard]] Eigen::Matrix3d mirror_covariance(const MirrorHypothesis& mirror, const AnchorFit& fit,
                                                double inflation);

struct SiteProblem {
  const Association* association = nullptr;
  model::RangePriors priors;
  std::span<const model::Anchor> known_anchors;
  double end_s = 0.0;  // later ranges are left out
};

// Reduces each anchor with more than `most` ranges to those that together determine it best, by
// choose_measurements() about a position from few of them. `polls` is of the same association and follows.
void bound_rows(Association& association, PollTable& polls, const SiteProblem& problem, std::size_t most);

// One fit per anchor of the association, in its order. A fit starts from `earlier`, a solution from part of
// the same ranges, if that had more than half of them and the others do not contradict it; else from a
// search. An anchor without ranges stays at its prior.
[[nodiscard]] std::vector<AnchorFit> solve_site(const SiteProblem& problem,
                                                std::span<const AnchorFit> earlier);

// Sets solution and kernels of one anchor from few of its ranges, without a start; reads fit.problem alone.
void find_start(AnchorFit& fit);

// Alternates between estimating the kernels and solving each anchor from where it is, until a round moves no
// anchor by 0.1 sigma or more.
void refine_site(std::span<AnchorFit> fits, int max_rounds);

}  // namespace groma::calibration
