#include "host/report/series.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace groma::report {

using Eigen::Vector2d;

double quantile(std::vector<double> values, double share) {
  if (values.empty()) return std::numeric_limits<double>::quiet_NaN();
  const auto at =
      values.begin() + static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), at, values.end());
  return *at;
}

std::vector<Vector2d> medians(const std::vector<Vector2d>& values, double from, double to, std::size_t bins) {
  std::vector<std::vector<double>> binned(bins);
  for (const Vector2d& value : values) {
    const double share = (value.x() - from) / (to - from);
    const auto bin = static_cast<std::size_t>(
        std::clamp(share * static_cast<double>(bins), 0.0, static_cast<double>(bins) - 1.0));
    binned[bin].push_back(value.y());
  }
  std::vector<Vector2d> points;
  points.reserve(bins);
  for (std::size_t i = 0; i < bins; ++i) {
    const double x = from + (static_cast<double>(i) + 0.5) * (to - from) / static_cast<double>(bins);
    points.emplace_back(x, quantile(std::move(binned[i]), 0.5));
  }
  return points;
}

}  // namespace groma::report
