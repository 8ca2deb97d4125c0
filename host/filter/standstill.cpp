#include "host/filter/standstill.hpp"

#include <cmath>

namespace groma::filter {

bool Standstill::observe(const model::OdometrySample& row, const model::OdometryNoise& noise) noexcept {
  const double gap_s = has_row_ ? row.t_s - last_s_ : 0.0;
  if (!has_row_ || gap_s > config_.window_s) {
    reset();
    has_row_ = true;
    last_s_ = row.t_s;
    mean_ = {row.vx_mps, row.vy_mps, row.omega_radps};
    return false;
  }
  last_s_ = row.t_s;
  seen_s_ += gap_s;
  const double share = gap_s / (config_.window_s + gap_s);
  const std::array<double, 3> values{row.vx_mps, row.vy_mps, row.omega_radps};
  const std::array<double, 3> sigmas{noise.sigma_vx_mps, noise.sigma_vy_mps, noise.sigma_omega_radps};
  const std::array<double, 3> slack{config_.velocity_mps, config_.velocity_mps, config_.turn_radps};
  // Of a mean that fades, over white draws.
  const double averaged = share / (2.0 - share);
  bool stands = seen_s_ >= config_.window_s;
  for (std::size_t axis = 0; axis < mean_.size(); ++axis) {
    const double variance = model::square(sigmas[axis]);
    const double slack_variance = model::square(slack[axis]);
    mean_[axis] += share * (values[axis] - mean_[axis]);
    mean_variances_[axis] = averaged * variance + slack_variance;
    stands = stands && model::square(mean_[axis]) <= model::square(config_.sigmas) * mean_variances_[axis] &&
             model::square(values[axis]) <= model::square(config_.row_sigmas) * (variance + slack_variance);
  }
  return stands;
}

model::OdometryNoise Standstill::noise() const noexcept {
  return {std::sqrt(mean_variances_[0]), std::sqrt(mean_variances_[1]), std::sqrt(mean_variances_[2])};
}

}  // namespace groma::filter
