// Solves all anchors of a drive, each by itself but with kernels estimated from all of them.
#pragma once

#include <cstddef>
#include <limits>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/anchor_solver.hpp"
#include "host/calibration/association.hpp"
#include "host/calibration/los_chain.hpp"
#include "host/calibration/robust_kernel.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// Search without a start: the best of several solutions, each with kernels estimated from its own residuals.
// The observations should be few and spread out.
[[nodiscard]] AnchorFit search(const AnchorProblem& problem);

struct SiteProblem {
  const Association* association = nullptr;
  model::RangePriors priors;
  std::span<const model::Anchor> known_anchors;
  double end_s = std::numeric_limits<double>::infinity();  // later ranges are left out
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
