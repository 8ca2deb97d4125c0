// A calibration's results, for a user who has to decide whether to trust it.
#pragma once

#include <string>

#include "host/calibration/calibrate.hpp"
#include "host/report/page.hpp"
#include "host/report/site.hpp"

namespace groma::report {

// Adds verdict, map with 95 % ellipses, anchors, biases, and residuals over time. `walls`: as far as known.
void add_calibration(Page& page, const calibration::Drive& drive, const calibration::Result& result,
                     const Walls& walls = {});

[[nodiscard]] Tone tone(model::AnchorVerdict verdict);
[[nodiscard]] Tone tone(model::Verdict verdict);

}  // namespace groma::report
