// The difference of two calibrations of a site.
#pragma once

#include "host/calibration/comparison.hpp"
#include "host/model/calibration.hpp"
#include "host/report/page.hpp"

namespace groma::report {

// Adds figures, a map of the anchors' positions in both, and the changes of positions and biases with their
// 95 % intervals.
void add_comparison(Page& page, const calibration::Comparison& comparison, const model::Calibration& a,
                    const model::Calibration& b);

}  // namespace groma::report
