// A pose that another localization tells, such as one by LiDAR: in the map frame, base_link itself.
#pragma once

#include "host/filter/core_measurement.hpp"
#include "host/filter/present_pose.hpp"
#include "host/model/pose.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// Whether all of the pose and its covariance are there and can be.
[[nodiscard]] bool tells_pose(const model::PoseSample& sample) noexcept;

// z = x, y, heading at the pose now, of a sample that tells_pose(); its heading is that of place_on().
[[nodiscard]] CoreMeasurement<3> measure_pose(const model::Surface& surface, const PresentPose& now,
                                              const model::PoseSample& sample) noexcept;

// A pose's place on the surface: the chart nearest to its height, and its heading there. Where it tells roll
// and pitch, that is taken from its attitude.
[[nodiscard]] model::PlanarPose place_on(const model::Surface& surface,
                                         const model::PoseSample& pose) noexcept;

}  // namespace groma::filter
