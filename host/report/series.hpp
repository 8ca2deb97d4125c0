// Series that charts are made of.
#pragma once

#include <cstddef>
#include <limits>
#include <vector>

#include <Eigen/Core>

namespace groma::report {

// A value that is not there: it breaks a line.
inline constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
// 95 % quantile of the chi-square distribution with 2 degrees of freedom: of an ellipse.
inline constexpr double kChiSquare95 = 5.991;

// Median of each of `bins` equal intervals of x within [from, to]; a break where an interval is empty.
[[nodiscard]] std::vector<Eigen::Vector2d> medians(const std::vector<Eigen::Vector2d>& values, double from,
                                                   double to, std::size_t bins);

// The value below which this share of the values lies; NaN without values.
[[nodiscard]] double quantile(std::vector<double> values, double share);

}  // namespace groma::report
