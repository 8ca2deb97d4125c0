#include "firmware/core/dw1000/receive_quality.hpp"

#include <cmath>
#include <cstdlib>

namespace groma::dw1000 {
namespace {

constexpr float kPrf64Constant_db = 121.74F;

// 10 log10(energy / count^2) - A, in hundredths.
std::int32_t power_cdbm(float energy, std::uint16_t count) noexcept {
  const auto n = static_cast<float>(count);
  const float power_dbm = 10.0F * std::log10(energy / (n * n)) - kPrf64Constant_db;
  return static_cast<std::int32_t>(std::lround(power_dbm * 100.0F));
}

constexpr float square(std::uint16_t value) noexcept {
  return static_cast<float>(value) * static_cast<float>(value);
}

}  // namespace

std::uint16_t corrected_preamble_count(std::uint16_t count, std::uint16_t unsaturated) noexcept {
  constexpr std::uint16_t kSfdShare = 5;
  if (count != unsaturated || count <= kSfdShare) return count;
  return static_cast<std::uint16_t>(count - kSfdShare);
}

std::optional<std::int32_t> first_path_power_cdbm(const ReceiveQuality& q) noexcept {
  const float energy = square(q.amplitude1) + square(q.amplitude2) + square(q.amplitude3);
  if (energy <= 0.0F || q.preamble_count == 0) return std::nullopt;
  return power_cdbm(energy, q.preamble_count);
}

std::optional<std::int32_t> receive_power_cdbm(const ReceiveQuality& q) noexcept {
  if (q.channel_power == 0 || q.preamble_count == 0) return std::nullopt;
  constexpr float kScale = 131072.0F;  // 2^17
  return power_cdbm(static_cast<float>(q.channel_power) * kScale, q.preamble_count);
}

std::int32_t peak_distance_64ths(const ReceiveQuality& quality) noexcept {
  return std::abs(std::int32_t{quality.peak_index} * 64 - std::int32_t{quality.first_path_index_64ths});
}

LineOfSight line_of_sight(std::optional<std::int32_t> first_path_power_cdbm,
                          std::optional<std::int32_t> receive_power_cdbm,
                          std::int32_t peak_distance_64ths) noexcept {
  constexpr std::int32_t kLikely_64ths = 211;  // 3.3 samples
  constexpr std::int32_t kUnlikely_64ths = 6 * 64;
  if (!first_path_power_cdbm || !receive_power_cdbm) return LineOfSight::kUnknown;
  const std::int32_t hidden_cdb = *receive_power_cdbm - *first_path_power_cdbm;
  if (hidden_cdb > kUnlikelyHidden_cdb || peak_distance_64ths > kUnlikely_64ths)
    return LineOfSight::kUnlikely;
  const bool likely = hidden_cdb < kLikelyHidden_cdb && peak_distance_64ths <= kLikely_64ths;
  return likely ? LineOfSight::kLikely : LineOfSight::kUncertain;
}

std::int32_t clock_offset_ppb(std::int32_t carrier_integral) noexcept {
  // -5.7312e-4 ppm per count: 998.4 MHz / 2 / 1024 / 2^17 over the carrier of 6489.6 MHz.
  return static_cast<std::int32_t>(std::int64_t{carrier_integral} * -57312 / 100'000);
}

}  // namespace groma::dw1000
