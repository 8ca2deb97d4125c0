// Calibrations as far off as the source paper's were.
#pragma once

#include <cstdint>
#include <span>

#include "firmware/sim/world/world.hpp"
#include "host/io/dataset.hpp"
#include "host/model/calibration.hpp"

namespace groma::reproduce {

// Each anchor as far from its true place as Table I says, mostly in height, with the table's covariance. The
// biases are what such a calibration takes for them: the median of range less distance to the wrong place
// over the drive that calibrates; gamma is 1.
[[nodiscard]] model::Calibration drawn_calibration(const sim::World& world, const io::Dataset& drive,
                                                   std::span<const model::Anchor> anchors,
                                                   std::uint64_t seed);

// Of the forklift: each anchor within most_m of its true place, the biases the mean of range less distance
// over the drive itself, gamma 1.
[[nodiscard]] model::Calibration pre_calibration(const sim::World& world, const io::Dataset& drive,
                                                 std::span<const model::Anchor> anchors, double most_m,
                                                 std::uint64_t seed);

}  // namespace groma::reproduce
