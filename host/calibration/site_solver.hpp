// All anchors of a drive: each searched for and solved by itself, with kernels estimated from all of them;
// and the mirror sides of each.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/anchor_solver.hpp"
#include "host/calibration/association.hpp"
#include "host/calibration/robust_kernel.hpp"
#include "host/calibration/sight_chain.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// At most max_rows_per_tag of each tag's rows, spread evenly along the way that the tag went: a long stop
// counts no more than a short one.
[[nodiscard]] std::vector<Observation> spread_along_the_way(std::span<const Observation> rows,
                                                            std::size_t tag_count,
                                                            std::size_t max_rows_per_tag);

// Axes of TagSpread to mirror along.
inline constexpr int kAcrossLine = 1;
inline constexpr int kAcrossPlane = 2;

// The principal frame of the antennas' positions.
struct TagSpread {
  Eigen::Vector3d center_m = Eigen::Vector3d::Zero();
  Eigen::Matrix3d axes = Eigen::Matrix3d::Identity();  // columns: most spread first

  // The point on the other side of the tags along one axis, 0..2.
  [[nodiscard]] Eigen::Vector3d mirror(const Eigen::Vector3d& point_m, int axis) const noexcept;
};
[[nodiscard]] TagSpread tag_spread(std::span<const Observation> rows);

// The solution that lies in the same wide valley as the start, with kernels from its own residuals: nothing
// of it depends on a first guess of the noise. The cost is a negative log likelihood: comparable between
// kernels.
[[nodiscard]] AnchorFit descend(const AnchorProblem& problem, const AnchorVector& start);

// The best solution that the search finds, as descend() has it. The rows should be few and spread out.
[[nodiscard]] AnchorFit search(const AnchorProblem& problem);

// The best solution on the other side.
struct Rival {
  AnchorVector anchor;
  double cost_excess = 0.0;  // negative log likelihood over the solution's, as of independent residuals; >= 0
  double cost_ratio = 1.0;   // the solution's cost over its, 0..1; a cost counts from that of perfect ranges
};

// Looks for the other side along one axis; where it explains the ranges better, the fit moves there and its
// former place is the rival. The fit must have rows.
[[nodiscard]] Rival challenge(AnchorFit& fit, const TagSpread& spread, int axis);

// Across the line and across the plane of the tags; the rivals themselves are not of interest.
void challenge_both(AnchorFit& fit);

// Where an anchor was by an earlier calibration.
struct EarlierPlace {
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Matrix3d covariance_m2 = Eigen::Matrix3d::Identity();  // that of the drives' frames included
};
// Lets the earlier place decide between both sides, as far as an anchor that may have been moved allows: the
// excess becomes that of ranges and place together, over `inflation` independent; below zero both change
// parts.
void weigh_by_earlier(const EarlierPlace& earlier, double inflation, AnchorFit& fit, Rival& rival);

// The spread that a rival adds to the position's covariance: as were it the truth with the probability that
// its excess, over `inflation`, leaves it.
[[nodiscard]] Eigen::Matrix3d rival_spread(const Rival& rival, const AnchorFit& fit, double inflation);

struct SiteProblem {
  const Association* association = nullptr;
  model::RangePriors priors;
  std::span<const model::Anchor> known_anchors;
  double end_s = 0.0;  // rows later than this are left out
};

// Of each anchor with more rows than `most`, leaves those that together see it best: choose_measurements()
// from where few of them put it. The polls: of the association as it comes.
void bound_rows(Association& association, PollTable& polls, const SiteProblem& problem, std::size_t most);

// In the order of the association's anchors. Each starts from `earlier`, a solution from a part of the same
// rows, where that had enough of them and is not contradicted by the others; else it is searched for. An
// anchor without rows stays at its prior.
[[nodiscard]] std::vector<AnchorFit> solve_site(const SiteProblem& problem,
                                                std::span<const AnchorFit> earlier);

// Solution and kernels of one anchor from few of its rows, without a start: the fit's problem says all.
void find_start(AnchorFit& fit);

// Learns the kernels and solves each anchor anew from where it is, until a round moves none of them by a
// share of its sigma that counts.
void refine_site(std::span<AnchorFit> fits, int max_rounds);

}  // namespace groma::calibration
