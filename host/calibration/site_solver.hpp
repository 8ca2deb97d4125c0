// All anchors of a drive: each solved by itself, with kernels that learn from all of them.
#pragma once

#include <cstddef>
#include <limits>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/anchor_solver.hpp"
#include "host/calibration/association.hpp"
#include "host/calibration/robust_kernel.hpp"
#include "host/calibration/sight_chain.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

struct SiteProblem {
  const Association* association = nullptr;
  model::RangePriors priors;
  std::span<const model::Anchor> known_anchors;
  double known_anchor_sigma_m = 0.02;
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

// From the first row of all fits to the last; the end is before the begin where there are none.
struct RowSpan {
  double begin_s = std::numeric_limits<double>::infinity();
  double end_s = -std::numeric_limits<double>::infinity();
};
[[nodiscard]] RowSpan row_span(std::span<const AnchorFit> fits) noexcept;

// Solution and kernels of one anchor from few of its rows, without a start: the fit's problem says all.
void find_start(AnchorFit& fit);

// Learns the kernels and solves each anchor anew from where it is, until a round moves none of them by a
// share of its sigma that counts.
void refine_site(std::span<AnchorFit> fits, int max_rounds);

}  // namespace groma::calibration
