// The bias-aware range as the filter sees it: what is predicted, and its derivatives by the core state and
// by the parameters of the one pair.
#pragma once

#include <Eigen/Core>

#include "host/filter/site.hpp"
#include "host/filter/state.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

struct RangeMeasurement {
  double range_m = 0.0;                                    // predicted
  double distance_m = 0.0;                                 // between the antennas
  CoreRow d_core;                                          // by the core state
  Eigen::Matrix<double, 1, kPairParameters> d_parameters;  // by those of the pair
};

// Range of a tag to an anchor, z = gamma d + beta and what the tag's antenna adds in that direction, at the
// pose that the core state had a delay ago, on that chart of the surface. The anchor stands at
// a + (frame x, y, z) + frame yaw * (z axis x a). The derivatives are those where the ground differs from the
// surface by nothing.
[[nodiscard]] RangeMeasurement measure_range(const model::Surface& surface, const CoreVector& core,
                                             const model::OdometrySample& row, const PairParameters& pair,
                                             int chart = 0) noexcept;

// The pure distance of the original model: beta 0, gamma 1.
[[nodiscard]] RangeMeasurement measure_distance(const model::Surface& surface, const CoreVector& core,
                                                const model::OdometrySample& row, const PairParameters& pair,
                                                int chart = 0) noexcept;

}  // namespace groma::filter
