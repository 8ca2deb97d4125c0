// The only PHY configuration in use: channel 5, PRF 64 MHz, 6.8 Mbit/s, preamble code 9, standard SFD of 8
// symbols, with three preamble lengths. All durations are exact in ticks.
#pragma once

#include <cstddef>
#include <cstdint>

#include "firmware/core/ranging/device_time.hpp"

namespace groma::dw1000 {

enum class Preamble : std::uint8_t { k64, k128, k256 };

// Sizes of IEEE 802.15.4 frames, including the two bytes of the frame check.
inline constexpr std::size_t kMaxFrameBytes = 127;
inline constexpr std::size_t kFrameCheckBytes = 2;

class Phy {
 public:
  constexpr explicit Phy(Preamble preamble) noexcept : preamble_(preamble) {}

  [[nodiscard]] constexpr Preamble preamble() const noexcept { return preamble_; }
  [[nodiscard]] constexpr int preamble_symbols() const noexcept {
    return preamble_ == Preamble::k64 ? 64 : preamble_ == Preamble::k128 ? 128 : 256;
  }
  // Symbols that the receiver correlates at a time.
  [[nodiscard]] constexpr int acquisition_chunk_symbols() const noexcept {
    return preamble_ == Preamble::k256 ? 16 : 8;
  }

  // From the start of the preamble to the RMARKER, the instant that timestamps refer to.
  [[nodiscard]] constexpr ranging::Ticks before_rmarker() const noexcept {
    return (preamble_symbols() + kSfdSymbols) * kPreambleSymbol;
  }
  // From the RMARKER to the end of a frame of `bytes`, frame check included. Reed-Solomon adds 48 bits for
  // each 330 begun.
  [[nodiscard]] static constexpr ranging::Ticks after_rmarker(std::size_t bytes) noexcept {
    const std::int64_t bits = 8 * static_cast<std::int64_t>(bytes);
    return kHeaderSymbols * kHeaderSymbol + (bits + 48 * ((bits + 329) / 330)) * kDataBit;
  }
  [[nodiscard]] constexpr ranging::Ticks air_time(std::size_t bytes) const noexcept {
    return before_rmarker() + after_rmarker(bytes);
  }

  static constexpr ranging::Ticks kPreambleSymbol{std::int64_t{508} * 128};  // 508 chips of 499.2 MHz
  static constexpr ranging::Ticks kHeaderSymbol{std::int64_t{512} * 128};
  static constexpr ranging::Ticks kDataBit{std::int64_t{64} * 128};
  // From the receiver's start to its hunt for preambles: 16 us (user manual 7.2.15).
  static constexpr ranging::Ticks kReceiverStart = ranging::round_up_to_grid(ranging::Ticks::from_us(16));
  static constexpr int kSfdSymbols = 8;
  static constexpr int kHeaderSymbols = 21;

 private:
  Preamble preamble_;
};

}  // namespace groma::dw1000
