// Durations of the parts of a frame, in ticks of the transmitter's clock: PRF 64 MHz, 6.8 Mbit/s
// (user manual 2.12, chapter 10). All are whole numbers of ticks.
#pragma once

#include <cstdint>

namespace groma::sim {

inline constexpr std::int64_t kPreambleSymbolTicks = std::int64_t{508} * 128;  // 1.01763 us
inline constexpr std::int64_t kSfdSymbols = 8;
inline constexpr std::int64_t kHeaderTicks = std::int64_t{21} * 512 * 128;  // 21 symbols of 1.02564 us
inline constexpr std::int64_t kDataBitTicks = std::int64_t{64} * 128;       // 128.205 ns
inline constexpr std::int64_t kTicksPerUus =
    std::int64_t{512} * 128;  // the unit of RX_FWTO and W4R_TIM, 1.02564 us

// Preamble and start-of-frame delimiter: from the first symbol to the RMARKER. `symbols`: preamble length.
[[nodiscard]] constexpr std::int64_t preamble_ticks(std::int64_t symbols) noexcept {
  return (symbols + kSfdSymbols) * kPreambleSymbolTicks;
}

// The data part of `length` bytes, with 48 parity bits for every 330 bits or fraction of them.
[[nodiscard]] constexpr std::int64_t data_ticks(std::int64_t length) noexcept {
  const std::int64_t bits = 8 * length;
  return (bits + 48 * ((bits + 329) / 330)) * kDataBitTicks;
}

}  // namespace groma::sim
