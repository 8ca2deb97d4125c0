// An antenna's position in the map frame, as GNSS tells it outdoors.
#pragma once

#include "host/filter/config.hpp"
#include "host/filter/core_measurement.hpp"
#include "host/filter/present_pose.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// z = (x, y) of p + R_WR l at the pose now, l the antenna's lever arm.
[[nodiscard]] CoreMeasurement<2> measure_position(const model::Surface& surface, const PresentPose& now,
                                                  const SensorConfig& config,
                                                  const model::PositionSample& sample) noexcept;

}  // namespace groma::filter
