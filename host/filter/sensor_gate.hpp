// What weight a sample of a sensor beside odometry and ranges deserves.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>

#include "host/filter/config.hpp"

namespace groma::filter {

enum class Sensor : std::uint8_t { kYawRate, kPosition, kPose, kZeroVelocity };
inline constexpr std::size_t kSensors = 4;

class SensorGate {
 public:
  explicit SensorGate(const SensorConfig& config) : config_(config) { reset(); }

  // Weight in [0, 1] by the mean square of the innovation's components in their own sigmas; 0 turns it away.
  // A sensor that was turned away for the whole of patience_s is heard again, if softly: it may be the state
  // that is wrong.
  [[nodiscard]] double weigh(Sensor sensor, double t_s, double mean_square) noexcept;
  // Forgets the time.
  void reset() noexcept;

 private:
  static constexpr double kNotYet_s = -std::numeric_limits<double>::infinity();

  SensorConfig config_;
  std::array<double, kSensors> seen_s_;
  std::array<double, kSensors> heard_s_;  // used, or the first turned away after a silence
};

}  // namespace groma::filter
