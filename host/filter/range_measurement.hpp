// The bias-aware range measurement, equation (12): the prediction, and its Jacobians w.r.t. the core state
// and the parameters of the pair.
#pragma once

#include <cmath>

#include <Eigen/Core>

#include "host/filter/site.hpp"
#include "host/filter/state.hpp"
#include "host/model/range_model.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// Whether a range is finite and in bounds. By hand: far beyond the size of a site.
inline constexpr double kMaxRange_m = 1000.0;
[[nodiscard]] inline bool is_usable(const model::RangeSample& range) noexcept {
  return std::isfinite(range.t_s) && range.range_m > 0.0 && range.range_m <= kMaxRange_m;
}

using ParameterRow = Eigen::Matrix<double, 1, kPairParameters>;

// Range of a tag to an anchor from the pose (x, y, theta) on that chart of the surface: range_m is the pair's
// terms (gamma d + beta), the slow range bias, and the tag's antenna pattern in that direction. The anchor's
// position is a + (frame x, y, z) + frame yaw * (z axis x a). The derivatives assume that the ground deviates
// from the surface by zero.
[[nodiscard]] model::SurfaceRange range_from(const model::Surface& surface, const Eigen::Vector3d& pose,
                                             const PairParameters& pair, int chart = 0) noexcept;
// J: the prediction's derivatives w.r.t. the pair's parameters.
[[nodiscard]] ParameterRow by_parameters(const PairParameters& pair,
                                         const model::SurfaceRange& prediction) noexcept;

struct RangeMeasurement {
  double range_m = 0.0;       // predicted, z_n of (17)
  CoreRow d_core;             // H: w.r.t. the core state
  ParameterRow d_parameters;  // J: w.r.t. the pair's parameters
};

// range_from() the core state's pose, kDelay earlier.
[[nodiscard]] RangeMeasurement measure_range(const model::Surface& surface, const CoreVector& core,
                                             const model::OdometrySample& row, const PairParameters& pair,
                                             int chart = 0) noexcept;

}  // namespace groma::filter
