#include "host/filter/range_density.hpp"

#include <cmath>
#include <numbers>

namespace groma::filter {

double gaussian_density(double error_m, double sigma_m) noexcept {
  const double e = error_m / sigma_m;
  return std::exp(-0.5 * e * e) / (sigma_m * std::sqrt(2.0 * std::numbers::pi));
}

double excess_density(double error_m, double sigma_m, double mean_m) noexcept {
  const double ratio = sigma_m / mean_m;
  // For a wide sigma the product of a huge and a tiny factor; it then is the Gaussian's own.
  if (ratio > 8.0) return gaussian_density(error_m, sigma_m);
  const double below = 0.5 * std::erfc((ratio - error_m / sigma_m) * std::numbers::sqrt2 / 2.0);
  if (!(below > 0.0)) return 0.0;
  return std::exp(0.5 * ratio * ratio - error_m / mean_m) * below / mean_m;
}

RangeDensities range_densities(double error_m, double sigma_m, const GateConfig& config) noexcept {
  return {.in_sight = gaussian_density(error_m, sigma_m),
          .blocked = (1.0 - config.short_share) * excess_density(error_m, sigma_m, config.excess_m) +
                     config.short_share * excess_density(-error_m, sigma_m, config.excess_m),
          .garbage = config.garbage_share / config.garbage_width_m};
}

}  // namespace groma::filter
