#include "host/filter/range_density.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "host/model/ablation.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

namespace {

constexpr double kExponentialTail = 8.0;
// From this share of polls missed on, what is off is off by regained_m.
constexpr double kFarMissed = 0.5;

}  // namespace

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

double excess_square(double error_m, double sigma_m, double mean_m) noexcept {
  // Given the error, the excess is a Gaussian's part above zero.
  const double sigmas = error_m / sigma_m - sigma_m / mean_m;
  // So far below, what is left of it falls like an exponential.
  if (sigmas < -kExponentialTail) return 2.0 * model::square(sigma_m / sigmas);
  const double below = 0.5 * std::erfc(-sigmas * std::numbers::sqrt2 / 2.0);
  const double at_zero = gaussian_density(sigmas, 1.0) / below;
  return std::max(model::square(sigma_m) * (1.0 + sigmas * (sigmas + at_zero)), 0.0);
}

RangeDensities range_densities(double error_m, double sigma_m, const GateConfig& config,
                               double missed) noexcept {
  const double far_share = std::min(missed / kFarMissed, 1.0);
  const double garbage_share = config.garbage_share + config.regained_garbage * missed;
  const double short_share = model::is_ablated(model::Mechanism::kGateShort) ? 0.0 : config.short_share;
  const double near = (1.0 - short_share) * excess_density(error_m, sigma_m, config.excess_m) +
                      short_share * excess_density(-error_m, sigma_m, config.excess_m);
  const double far = far_share > 0.0 ? far_share * excess_density(error_m, sigma_m, config.regained_m) : 0.0;
  return {.in_sight = gaussian_density(error_m, sigma_m),
          .blocked = (1.0 - far_share) * near + far,
          .far = far,
          .garbage = garbage_share / config.garbage_width_m,
          .garbage_share = garbage_share};
}

}  // namespace groma::filter
