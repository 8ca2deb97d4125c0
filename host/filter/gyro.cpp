#include "host/filter/gyro.hpp"

#include <algorithm>
#include <cmath>

#include "host/model/plausible.hpp"

namespace groma::filter {

bool Gyro::follows(const model::YawRateSample& sample, double odometry_radps) const noexcept {
  if (!model::is_plausible(sample)) return false;
  const double gap_s = std::min(sample.t_s - used_s_, config_.gyro_hold_s);
  const double before_radps = gap_s < config_.gyro_hold_s ? used_radps_ : odometry_radps;
  return std::abs(sample.omega_radps - before_radps) <=
         config_.gyro_acceleration_radps2 * gap_s + config_.gyro_noise_sigmas * config_.gyro_sigma_radps;
}

void Gyro::use(const model::YawRateSample& sample) noexcept {
  used_s_ = sample.t_s;
  used_radps_ = sample.omega_radps;
  holds_ = true;
}

}  // namespace groma::filter
