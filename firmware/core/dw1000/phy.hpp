// The only PHY configuration in use: channel 5, PRF 64 MHz, 6.8 Mbit/s, preamble code 9, standard SFD of 8
// symbols, with three preamble lengths.
#pragma once

#include "firmware/core/radio/phy.hpp"
#include "firmware/core/ranging/device_time.hpp"

namespace groma::dw1000 {

using radio::kFrameCheckBytes;
using radio::kMaxFrameBytes;
using radio::Preamble;

inline constexpr ranging::Ticks kPreambleSymbol{std::int64_t{508} * 128};  // 508 chips of 499.2 MHz
inline constexpr ranging::Ticks kHeaderSymbol{std::int64_t{512} * 128};
inline constexpr ranging::Ticks kDataBit{std::int64_t{64} * 128};
inline constexpr int kSfdSymbols = 8;
inline constexpr int kHeaderSymbols = 21;

[[nodiscard]] constexpr int preamble_symbols(Preamble preamble) noexcept {
  return preamble == Preamble::k64 ? 64 : preamble == Preamble::k128 ? 128 : 256;
}
// Symbols that the receiver correlates at a time.
[[nodiscard]] constexpr int acquisition_chunk_symbols(Preamble preamble) noexcept {
  return preamble == Preamble::k256 ? 16 : 8;
}

[[nodiscard]] constexpr radio::Phy phy_of(Preamble preamble) noexcept {
  return {preamble,
          {.synchronization = (preamble_symbols(preamble) + kSfdSymbols) * kPreambleSymbol,
           .header = kHeaderSymbols * kHeaderSymbol,
           .data_bit = kDataBit,
           // 16 us (user manual 7.2.15).
           .receiver_start = ranging::round_up_to_grid(ranging::Ticks::from_us(16)),
           // DX_TIME ignores its low 9 bits (user manual 3.3).
           .transmit_grid = ranging::Ticks(512)}};
}

}  // namespace groma::dw1000
