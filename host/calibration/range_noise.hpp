// White noise and slow error of ranges in sight, from how residuals of a pair agree over time.
#pragma once

#include <optional>
#include <span>

#include "host/calibration/site_solver.hpp"
#include "host/model/calibration.hpp"

namespace groma::calibration {

// From the residuals of every pair at the solution; each pair counts alike and the median decides, so that a
// few anchors behind walls do not. None where fewer than three pairs have rows enough.
[[nodiscard]] std::optional<model::RangeNoise> range_noise(std::span<const AnchorFit> fits,
                                                           std::size_t tag_count);

}  // namespace groma::calibration
