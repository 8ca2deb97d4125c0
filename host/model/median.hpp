// Robust statistics of a sample.
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

namespace groma::model {

// Standard deviation of a normal distribution over its median absolute deviation: 1 / quantile(0.75).
inline constexpr double kSigmaOfMad = 1.482602218505602;

// Upper median; zero if empty.
[[nodiscard]] inline double median(std::vector<double> values) {
  if (values.empty()) return 0.0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

}  // namespace groma::model
