// Densities of a range's error.
#pragma once

#include "host/filter/config.hpp"

namespace groma::filter {

// Of a Gaussian of that sigma, 1/m.
[[nodiscard]] double gaussian_density(double error_m, double sigma_m) noexcept;
// Of a Gaussian of that sigma plus an exponential excess of that mean, 1/m.
[[nodiscard]] double excess_density(double error_m, double sigma_m, double mean_m) noexcept;
// And the mean square of the excess, given such an error, m^2.
[[nodiscard]] double excess_square(double error_m, double sigma_m, double mean_m) noexcept;

// The kinds of error that the gate separates, 1/m. The first two: of a range that is not garbage; blocked
// ones are too long, or by short_share too short.
struct RangeDensities {
  double in_sight = 0.0;
  double blocked = 0.0;
  double far = 0.0;            // the part of blocked with the larger excess of a pair that misses polls
  double garbage = 0.0;        // with its share,
  double garbage_share = 0.0;  // which is this
};
// missed: the share of its polls that the pair missed of late.
[[nodiscard]] RangeDensities range_densities(double error_m, double sigma_m, const GateConfig& config,
                                             double missed = 0.0) noexcept;

}  // namespace groma::filter
