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

enum class Sensor : std::uint8_t { kYawRate, kPosition, kPose, kZeroVelocity };
inline constexpr std::size_t kSensors = 4;

// A measurement that depends on the core state alone.
template <int kSize>
struct CoreMeasurement {
  Eigen::Matrix<double, kSize, 1> innovation;      // measured less predicted
  Eigen::Matrix<double, kSize, kCoreSize> d_core;  // of what is predicted
  Eigen::Matrix<double, kSize, kSize> noise;       // covariance of all that is not in the core
};

// An antenna's position in the map frame, as by GNSS: z = (x, y) of p + R_WR l at the pose now, l the
// antenna's lever arm.
[[nodiscard]] CoreMeasurement<2> measure_position(const model::Surface& surface, const PresentPose& now,
                                                  const SensorConfig& config,
                                                  const model::PositionSample& sample) noexcept;

// Whether all of the pose and its covariance are there and can be.
[[nodiscard]] bool tells_pose(const model::PoseSample& sample) noexcept;
// The pose of base_link in the map frame, as by LiDAR localization: z = x, y, heading at the pose now, of a
// sample that tells_pose(); its heading is that of place_on().
[[nodiscard]] CoreMeasurement<3> measure_pose(const model::Surface& surface, const PresentPose& now,
                                              const model::PoseSample& sample) noexcept;
// A pose's place on the surface: the chart nearest to its height, and its heading there. Where it has roll
// and pitch, that is taken from its attitude.
[[nodiscard]] model::PlanarPose place_on(const model::Surface& surface,
                                         const model::PoseSample& pose) noexcept;

// A stationary robot, whatever its odometry says: 0 = v_x, 0 = v_y, 0 = omega, in base_link.
[[nodiscard]] CoreMeasurement<3> measure_zero_velocity(const CoreVector& core,
                                                       const model::OdometrySample& row,
                                                       const SensorConfig& config) noexcept;

class SensorGate {
 public:
  // Weight in [0, 1] by the mean square of the innovation's components in their own sigmas; 0 turns it away.
  // A sensor that was turned away for two seconds is used again, if softly: the state may be what is wrong.
  [[nodiscard]] double weigh(Sensor sensor, double t_s, double mean_square) noexcept;

 private:
  struct Times {
    double seen_s = -std::numeric_limits<double>::infinity();
    double heard_s = -std::numeric_limits<double>::infinity();  // used, or first turned away after a silence
  };
  std::array<Times, kSensors> times_{};
};

}  // namespace groma::filter
