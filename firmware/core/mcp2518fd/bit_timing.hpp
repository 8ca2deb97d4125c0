// Bit timing on the bus, in the MCP2518FD's terms (data sheet DS20006027, 3.4: CiNBTCFG, CiDBTCFG, CiTDC).
//
// A bit is one quantum of synchronization, then segment 1, the sample point, then segment 2. A quantum is
// `prescaler` cycles of the controller's clock.
#pragma once

#include <cstdint>
#include <optional>

namespace groma::mcp2518fd {

// The oscillator on the controller board; the controller's PLL is off.
inline constexpr std::uint32_t kClock_hz = 40'000'000;

struct BitTiming {
  std::uint16_t prescaler = 1;   // 1 to 256
  std::uint16_t segment1 = 0;    // quanta; nominal 2 to 256, data 1 to 32
  std::uint16_t segment2 = 0;    // quanta; nominal 1 to 128, data 1 to 16
  std::uint16_t jump_width = 0;  // quanta; at most segment2

  [[nodiscard]] constexpr std::uint32_t quanta() const noexcept { return 1U + segment1 + segment2; }
  [[nodiscard]] constexpr std::uint32_t bit_per_s(std::uint32_t clock_hz) const noexcept {
    return clock_hz / (prescaler * quanta());
  }
  [[nodiscard]] constexpr double sample_point() const noexcept {
    return static_cast<double>(1U + segment1) / static_cast<double>(quanta());
  }
  friend constexpr bool operator==(const BitTiming&, const BitTiming&) noexcept = default;
};

// The timing of exactly this bit rate, with as many quanta as possible and its sample point at 80 % of the
// bit or as close below as the quanta allow, but at least 75 %. Nothing if there is none.
[[nodiscard]] std::optional<BitTiming> nominal_timing(std::uint32_t bit_per_s,
                                                      std::uint32_t clock_hz = kClock_hz) noexcept;
[[nodiscard]] std::optional<BitTiming> data_timing(std::uint32_t bit_per_s,
                                                   std::uint32_t clock_hz = kClock_hz) noexcept;

// The position at which a transmitter samples its own bit in the data phase, in clock cycles after the
// measured delay, which is where a receiver samples. At most 63.
[[nodiscard]] std::uint8_t transmitter_delay_offset(const BitTiming& data) noexcept;

}  // namespace groma::mcp2518fd
