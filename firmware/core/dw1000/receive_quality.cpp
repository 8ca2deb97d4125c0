#include "firmware/core/dw1000/receive_quality.hpp"

#include <algorithm>
#include <cstdlib>

namespace groma::dw1000 {
namespace {

constexpr float square(std::uint16_t value) noexcept {
  return static_cast<float>(value) * static_cast<float>(value);
}

}  // namespace

std::uint16_t corrected_preamble_count(std::uint16_t count, std::uint16_t unsaturated) noexcept {
  constexpr std::uint16_t kSfdShare = 5;
  if (count != unsaturated || count <= kSfdShare) return count;
  return static_cast<std::uint16_t>(count - kSfdShare);
}

radio::LinkQuality link_quality(const ReceiveQuality& q) noexcept {
  constexpr float kScale = 131072.0F;  // 2^17
  const float first_path = square(q.amplitude1) + square(q.amplitude2) + square(q.amplitude3);
  const float count2 = square(q.preamble_count);
  const bool known = q.preamble_count != 0;
  const std::int32_t peak_distance = std::int32_t{q.peak_index} * 64 - std::int32_t{q.first_path_index_64ths};
  return {.receive_power = known ? static_cast<float>(q.channel_power) * kScale / count2 : 0.0F,
          .first_path_power = known ? first_path / count2 : 0.0F,
          .clock_offset_ppb = clock_offset_ppb(q.carrier_integral),
          .peak_distance_64ths =
              static_cast<std::uint16_t>(std::min<std::int32_t>(std::abs(peak_distance), 0xFFFF)),
          .noise = q.noise};
}

std::int32_t clock_offset_ppb(std::int32_t carrier_integral) noexcept {
  // -5.7312e-4 ppm per count: 998.4 MHz / 2 / 1024 / 2^17 over the carrier of 6489.6 MHz. 57312 / 100000 in
  // lowest terms, so that the product of 21 bits fits into 32.
  return carrier_integral * -1791 / 3125;
}

}  // namespace groma::dw1000
