#include "host/report/samples.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <string_view>

#include "host/io/base64.hpp"

namespace groma::report {

namespace {

constexpr double kMost = 65534.0;
constexpr std::uint16_t kNotFinite = 65535;

std::uint16_t share_of(double value, const Bounds& bounds) {
  if (!std::isfinite(value)) return kNotFinite;
  const double span = bounds.high - bounds.low;
  const double share = span > 0.0 ? (value - bounds.low) / span : 0.0;
  return static_cast<std::uint16_t>(std::lround(kMost * std::clamp(share, 0.0, 1.0)));
}

}  // namespace

std::string encode_samples(std::span<const std::vector<double>> columns, std::span<const Bounds> bounds) {
  std::vector<std::uint8_t> bytes;
  const std::size_t rows = columns.empty() ? 0 : columns.front().size();
  bytes.reserve(2 * rows * columns.size());
  for (std::size_t row = 0; row < rows; ++row) {
    for (std::size_t column = 0; column < columns.size(); ++column) {
      const std::uint16_t share = share_of(columns[column][row], bounds[column]);
      bytes.push_back(static_cast<std::uint8_t>(share & 255U));
      bytes.push_back(static_cast<std::uint8_t>(share >> 8U));
    }
  }
  return io::base64(bytes);
}

}  // namespace groma::report
