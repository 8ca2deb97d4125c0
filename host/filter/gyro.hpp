// The yaw rate of an IMU in the place of odometry's: wheels slip, gyros do not.
#pragma once

#include <limits>

#include "host/filter/config.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

class Gyro {
 public:
  explicit Gyro(const SensorConfig& config) : config_(config) {}

  // Whether the sample can follow the last one that was used, or after a gap the rate that holds in its
  // place: no robot turns that much faster within that time. A rate that jumped away does not become right by
  // lasting: after the gap it has to be near odometry's.
  [[nodiscard]] bool follows(const model::YawRateSample& sample, double odometry_radps) const noexcept;
  // Whether the rate that holds is the gyro's, and since when.
  [[nodiscard]] bool holds() const noexcept { return holds_; }
  [[nodiscard]] bool is_silent(double t_s) const noexcept { return t_s - used_s_ > config_.gyro_hold_s; }
  [[nodiscard]] double radps() const noexcept { return used_radps_; }
  void use(const model::YawRateSample& sample) noexcept;
  // Odometry's rate holds again.
  void give_up() noexcept { holds_ = false; }

 private:
  SensorConfig config_;
  double used_s_ = -std::numeric_limits<double>::infinity();
  double used_radps_ = 0.0;
  bool holds_ = false;
};

}  // namespace groma::filter
