#include "host/report/samples.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <string_view>

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

std::string base64(const std::vector<std::uint8_t>& bytes) {
  constexpr std::string_view kDigits = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string text;
  text.reserve((bytes.size() + 2) / 3 * 4);
  for (std::size_t i = 0; i < bytes.size(); i += 3) {
    const std::size_t left = std::min<std::size_t>(3, bytes.size() - i);
    std::uint32_t group = 0;
    for (std::size_t k = 0; k < 3; ++k) group = (group << 8U) | (k < left ? bytes[i + k] : 0U);
    for (std::size_t k = 0; k < 4; ++k)
      text += k <= left ? kDigits[(group >> (18U - 6U * static_cast<unsigned>(k))) & 63U] : '=';
  }
  return text;
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
  return base64(bytes);
}

}  // namespace groma::report
