// Noise of the ranges at a site's solution: white, and a slow bias of each pair.
#pragma once

#include <optional>
#include <span>

#include "host/calibration/anchor_solver.hpp"
#include "host/model/calibration.hpp"

namespace groma::calibration {

// White noise and Gauss-Markov bias of the ranges, from the residuals of every pair at the solution. Medians
// over pairs keep a few NLOS anchors from biasing them. None if fewer than three pairs have enough ranges.
[[nodiscard]] std::optional<model::RangeNoise> range_noise(std::span<const AnchorFit> fits);

}  // namespace groma::calibration
