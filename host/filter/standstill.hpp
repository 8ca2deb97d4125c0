// Whether the robot stands, by its odometry: the mean of the rows of late is no more than their noise makes,
// and the last one is not that of a robot that moves off.
#pragma once

#include <array>
#include <cstddef>

#include "host/filter/config.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

class Standstill {
 public:
  explicit Standstill(const StandstillConfig& config) : config_(config) {}

  // Of the next row, whose white noise is that large. True where the robot stands.
  bool observe(const model::OdometrySample& row, const model::OdometryNoise& noise) noexcept;
  void reset() noexcept { *this = Standstill(config_); }

  // How well the mean tells that: the velocity of a robot that stands.
  [[nodiscard]] model::OdometryNoise noise() const noexcept;

 private:
  StandstillConfig config_;
  std::array<double, 3> mean_{};  // vx, vy, omega, fading over window_s
  std::array<double, 3> mean_variances_{};
  double last_s_ = 0.0;
  double seen_s_ = 0.0;
  bool has_row_ = false;
};

}  // namespace groma::filter
