// Sensors other than odometry and ranges: measurement models on the core state, and the weights of samples.
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
  const model::OdometrySample& odometry;  // the sample held
  PresentPose now;
};

// A measurement that depends on the core state alone.
template <int kSize>
struct CoreMeasurement {
  Eigen::Matrix<double, kSize, 1> innovation;      // measured minus predicted
  Eigen::Matrix<double, kSize, kCoreSize> d_core;  // Jacobian of the prediction
  Eigen::Matrix<double, kSize, kSize> noise;       // covariance of all errors that are not in the core
};

// Position of an antenna in the map frame (GNSS): z = (x, y) of p + R_WR l at the present pose, with l the
// antenna's lever arm. m.
[[nodiscard]] CoreMeasurement<2> measure(const SensorView& state,
                                         const model::PositionSample& sample) noexcept;

// Pose of base_link in the map frame (LiDAR localization): z = x, y (m), heading (rad) of the present pose.
// The measured heading is that of place_on(). Requires is_usable(sample).
[[nodiscard]] CoreMeasurement<3> measure(const SensorView& state, const model::PoseSample& sample) noexcept;
// A pose on the surface: the chart nearest to its height, and the heading on it. If the pose has roll and
// pitch, the heading is computed from its attitude, R_WTᵀ R_WR of (3).
[[nodiscard]] model::PlanarPose place_on(const model::Surface& surface,
                                         const model::PoseSample& pose) noexcept;

// Zero-velocity update: v_x = 0, v_y = 0 (m/s), omega = 0 (rad/s) in base_link.
[[nodiscard]] CoreMeasurement<3> measure(const SensorView& state,
                                         const model::ZeroVelocitySample& sample) noexcept;

// Whether a sample is finite, plausible and has the fields that measure() needs.
[[nodiscard]] bool is_usable(const model::YawRateSample& sample) noexcept;
[[nodiscard]] bool is_usable(const model::PositionSample& sample) noexcept;
[[nodiscard]] bool is_usable(const model::PoseSample& sample) noexcept;
[[nodiscard]] bool is_usable(const model::ZeroVelocitySample& sample) noexcept;

// Sort key of one sensor's samples: time, then values.
using SampleKey = std::array<double, 4>;
[[nodiscard]] SampleKey key_of(const model::YawRateSample& sample) noexcept;
[[nodiscard]] SampleKey key_of(const model::PositionSample& sample) noexcept;
[[nodiscard]] SampleKey key_of(const model::PoseSample& sample) noexcept;
[[nodiscard]] SampleKey key_of(const model::ZeroVelocitySample& sample) noexcept;

class SensorGate {
 public:
  // Huber weight in [0, 1]; 0 rejects the sample. mean_square: squared Mahalanobis distance of the innovation
  // over its dimension. A sensor rejected for two seconds is used again with a small weight, because the
  // state may be wrong. sensor: its index in model::SensorSample.
  [[nodiscard]] double weigh(std::size_t sensor, double t_s, double mean_square) noexcept;

 private:
  struct Times {
    double seen_s = -std::numeric_limits<double>::infinity();
    double heard_s = -std::numeric_limits<double>::infinity();  // last in the gate, or first after a silence
  };
  std::array<Times, model::kSensors> times_{};
};

}  // namespace groma::filter
