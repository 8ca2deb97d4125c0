// A robot that is known to stand: its velocity is zero, whatever its odometry says.
#pragma once

#include "host/filter/config.hpp"
#include "host/filter/core_measurement.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// 0 = v_x, 0 = v_y, 0 = omega, in base_link.
[[nodiscard]] CoreMeasurement<3> measure_zero_velocity(const CoreVector& core,
                                                       const model::OdometrySample& row,
                                                       const SensorConfig& config) noexcept;

}  // namespace groma::filter
