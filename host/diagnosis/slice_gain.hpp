// Whether one fit of a drive is better than another, by slices of the drive.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <span>

namespace groma::diagnosis {

// Vuong's statistic: the mean of the slices' gains in log likelihood over the other fit, in its standard
// errors. That of few slices is Student's t; returned is the normal deviate of the same probability
// (Wallace, 1959, within 0.02). A slice without data costs NaN.
[[nodiscard]] inline double gain_in_sigmas(std::span<const double> cost,
                                           std::span<const double> other) noexcept {
  double sum = 0.0;
  double squares = 0.0;
  double count = 0.0;
  for (std::size_t i = 0; i < cost.size(); ++i) {
    const double gain = other[i] - cost[i];
    if (!std::isfinite(gain)) continue;
    sum += gain;
    squares += gain * gain;
    count += 1.0;
  }
  if (count < 2.0) return 0.0;
  const double freedom = count - 1.0;
  const double variance = (squares - sum * sum / count) / freedom;
  const double t = sum / std::sqrt(std::max(variance * count, 1e-18));
  const double normal =
      (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0) * std::sqrt(freedom * std::log1p(t * t / freedom));
  return std::copysign(normal, t);
}

}  // namespace groma::diagnosis
