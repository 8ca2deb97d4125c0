// Sensors beside odometry and ranges: what a sample says of the core state, and how much weight it deserves.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>

#include <Eigen/Core>

#include "host/filter/config.hpp"
#include "host/filter/dead_reckoning.hpp"
#include "host/filter/state.hpp"
#include "host/model/pose.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// The state at the time of a sample.
struct SensorView {
  const model::Surface& surface;
  const SensorConfig& config;
  const CoreVector& core;
  const model::OdometrySample& row;  // that holds
  PresentPose now;
};

// A measurement that depends on the core state alone.
template <int kSize>
struct CoreMeasurement {
  Eigen::Matrix<double, kSize, 1> innovation;      // measured less predicted
  Eigen::Matrix<double, kSize, kCoreSize> d_core;  // of what is predicted
  Eigen::Matrix<double, kSize, kSize> noise;       // covariance of all that is not in the core
};

// An antenna's position in the map frame, as by GNSS: z = (x, y) of p + R_WR l at the pose now, l the
// antenna's lever arm.
[[nodiscard]] CoreMeasurement<2> measure(const SensorView& state,
                                         const model::PositionSample& sample) noexcept;

// The pose of base_link in the map frame, as by LiDAR localization: z = x, y, heading at the pose now, of a
// sample that is usable; its heading is that of place_on().
[[nodiscard]] CoreMeasurement<3> measure(const SensorView& state, const model::PoseSample& sample) noexcept;
// A pose's place on the surface: the chart nearest to its height, and its heading there. Where it has roll
// and pitch, that is taken from its attitude.
[[nodiscard]] model::PlanarPose place_on(const model::Surface& surface,
                                         const model::PoseSample& pose) noexcept;

// A stationary robot, whatever its odometry says: 0 = v_x, 0 = v_y, 0 = omega, in base_link.
[[nodiscard]] CoreMeasurement<3> measure(const SensorView& state,
                                         const model::ZeroVelocitySample& sample) noexcept;

// Whether a sample can be one: finite, plausible, with what its measurement needs.
[[nodiscard]] bool is_usable(const model::YawRateSample& sample) noexcept;
[[nodiscard]] bool is_usable(const model::PositionSample& sample) noexcept;
[[nodiscard]] bool is_usable(const model::PoseSample& sample) noexcept;
[[nodiscard]] bool is_usable(const model::ZeroVelocitySample& sample) noexcept;

// What samples of one sensor are sorted by: time, then values.
using SampleKey = std::array<double, 4>;
[[nodiscard]] SampleKey key_of(const model::YawRateSample& sample) noexcept;
[[nodiscard]] SampleKey key_of(const model::PositionSample& sample) noexcept;
[[nodiscard]] SampleKey key_of(const model::PoseSample& sample) noexcept;
[[nodiscard]] SampleKey key_of(const model::ZeroVelocitySample& sample) noexcept;

class SensorGate {
 public:
  // Weight in [0, 1] by the mean square of the innovation's components in their own sigmas; 0 turns it away.
  // A sensor that was turned away for two seconds is used again, if softly: the state may be what is wrong.
  // sensor: its place in model::SensorSample.
  [[nodiscard]] double weigh(std::size_t sensor, double t_s, double mean_square) noexcept;

 private:
  struct Times {
    double seen_s = -std::numeric_limits<double>::infinity();
    double heard_s = -std::numeric_limits<double>::infinity();  // used, or first turned away after a silence
  };
  std::array<Times, model::kSensors> times_{};
};

}  // namespace groma::filter
