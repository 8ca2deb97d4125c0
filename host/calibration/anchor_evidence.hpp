// Evidence for each anchor's verdict, from its ranges at the solution.
#pragma once

#include <span>
#include <vector>

#include "host/calibration/calibrate.hpp"
#include "host/calibration/site.hpp"

namespace groma::calibration {

// Scores the ranges after `from_s` with the solution of those before. A residual counts relative to its
// predicted sigma, which is large at places that the robot had not visited by then.
[[nodiscard]] HeldOut score_held_out(const AnchorFit& first, std::span<const Observation> rows,
                                     double from_s);

// Residual and LOS probability of each range at a solution.
[[nodiscard]] std::vector<FittedRange> fitted_ranges(const AnchorFit& fit, std::span<const model::Tag> tags);

// Completes the evidence of all anchors; the mirror tests have filled in theirs already.
void gather_anchor_evidence(Site& site, std::span<const std::vector<FittedRange>> fitted);

}  // namespace groma::calibration
