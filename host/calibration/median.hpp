// The median, and what it tells of a normal's standard deviation.
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

namespace groma::calibration {

// Standard deviation of a normal over the median of its absolute deviation from its middle.
inline constexpr double kSigmaOfMad = 1.482602218505602;

// The upper one of two middles; zero of nothing.
[[nodiscard]] inline double median(std::vector<double> values) {
  if (values.empty()) return 0.0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

}  // namespace groma::calibration
