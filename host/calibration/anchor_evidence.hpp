// What the ranges of each anchor say beside its solution: the grounds of its verdict.
#pragma once

#include <span>
#include <vector>

#include "host/calibration/calibrate.hpp"
#include "host/calibration/site.hpp"

namespace groma::calibration {

// The rows later than `from_s`, scored with the solution of what was before. Residuals count by what that
// solution knows of them: of places where the robot had not been till then, not much.
[[nodiscard]] HeldOut score_held_out(const AnchorFit& first, std::span<const Observation> rows,
                                     double from_s);

// Of each row of a solution its residual and how likely it is LOS.
[[nodiscard]] std::vector<FittedRange> fitted_ranges(const AnchorFit& fit, std::span<const model::Tag> tags);

// Completes the evidence of all anchors, which holds the mirror test's by then.
void gather_anchor_evidence(Site& site, std::span<const std::vector<FittedRange>> fitted,
                            std::span<const double> inflation);

}  // namespace groma::calibration
