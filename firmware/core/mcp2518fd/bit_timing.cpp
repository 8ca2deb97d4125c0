#include "firmware/core/mcp2518fd/bit_timing.hpp"

namespace groma::mcp2518fd {
namespace {

struct Limits {
  std::uint32_t slowest_bit_per_s;
  std::uint32_t fastest_bit_per_s;
  std::uint32_t longest_segment1;
  std::uint32_t longest_segment2;
};

constexpr Limits kNominal{10'000, 1'000'000, 256, 128};
constexpr Limits kData{500'000, 8'000'000, 32, 16};
constexpr std::uint32_t kLargestPrescaler = 256;
constexpr std::uint32_t kFewestQuanta = 4;
constexpr std::uint8_t kLargestOffset = 63;

std::optional<BitTiming> timing(std::uint32_t bit_per_s, std::uint32_t clock_hz,
                                const Limits& limits) noexcept {
  if (bit_per_s < limits.slowest_bit_per_s || bit_per_s > limits.fastest_bit_per_s) return std::nullopt;
  if (clock_hz % bit_per_s != 0) return std::nullopt;
  const std::uint32_t cycles = clock_hz / bit_per_s;
  for (std::uint32_t prescaler = 1; prescaler <= kLargestPrescaler; ++prescaler) {
    if (cycles % prescaler != 0) continue;
    const std::uint32_t quanta = cycles / prescaler;
    if (quanta < kFewestQuanta) break;
    const std::uint32_t segment2 = (quanta + 4) / 5;
    const std::uint32_t segment1 = quanta - 1 - segment2;
    if (segment1 > limits.longest_segment1 || segment2 > limits.longest_segment2) continue;
    if (4 * segment2 > quanta) continue;
    return BitTiming{.prescaler = static_cast<std::uint16_t>(prescaler),
                     .segment1 = static_cast<std::uint16_t>(segment1),
                     .segment2 = static_cast<std::uint16_t>(segment2),
                     .jump_width = static_cast<std::uint16_t>(segment2)};
  }
  return std::nullopt;
}

}  // namespace

std::optional<BitTiming> nominal_timing(std::uint32_t bit_per_s, std::uint32_t clock_hz) noexcept {
  return timing(bit_per_s, clock_hz, kNominal);
}

std::optional<BitTiming> data_timing(std::uint32_t bit_per_s, std::uint32_t clock_hz) noexcept {
  return timing(bit_per_s, clock_hz, kData);
}

std::uint8_t transmitter_delay_offset(const BitTiming& data) noexcept {
  const std::uint32_t cycles = std::uint32_t{data.prescaler} * data.segment1;
  return cycles < kLargestOffset ? static_cast<std::uint8_t>(cycles) : kLargestOffset;
}

}  // namespace groma::mcp2518fd
