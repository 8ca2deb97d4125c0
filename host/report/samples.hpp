// The points of a series as text for report.js.
#pragma once

#include <span>
#include <string>
#include <vector>

namespace groma::report {

// Lower and upper bound of a column.
struct Bounds {
  double low = 0.0;
  double high = 0.0;
};

// Base64 of the columns' values, row by row, as little-endian 16-bit shares of their bounds: 0 is low, 65534
// is high, 65535 is not finite. Values beyond the bounds are clamped. All columns have the same length.
[[nodiscard]] std::string encode_samples(std::span<const std::vector<double>> columns,
                                         std::span<const Bounds> bounds);

}  // namespace groma::report
