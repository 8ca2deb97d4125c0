// Densities of a range's error.
#pragma once

namespace groma::filter {

// Of a Gaussian of that sigma, 1/m.
[[nodiscard]] double gaussian_density(double error_m, double sigma_m) noexcept;
// Of a Gaussian of that sigma plus an exponential excess of that mean, 1/m.
[[nodiscard]] double excess_density(double error_m, double sigma_m, double mean_m) noexcept;

}  // namespace groma::filter
