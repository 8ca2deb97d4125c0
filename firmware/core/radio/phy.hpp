// The frames of a network on the air: their sizes, and how long a radio sends them.
#pragma once

#include <cstddef>
#include <cstdint>

#include "firmware/core/ranging/device_time.hpp"

namespace groma::radio {

enum class Preamble : std::uint8_t { k64, k128, k256 };

// Sizes of IEEE 802.15.4 frames, including the two bytes of the frame check.
inline constexpr std::size_t kMaxFrameBytes = 127;
inline constexpr std::size_t kFrameCheckBytes = 2;

// What the MAC has to know of a radio's mode. All durations are exact in ticks.
class Phy {
 public:
  struct Timing {
    ranging::Ticks synchronization{};  // from the start of the preamble to the RMARKER
    ranging::Ticks header{};           // from the RMARKER to the first bit of the data
    ranging::Ticks data_bit{};
    ranging::Ticks receiver_start{};  // from the receiver's start to its hunt for preambles
    // A power of two up to kTransmitGrid; 1: the radio transmits at any instant, to its own resolution.
    ranging::Ticks transmit_grid{ranging::kTransmitGrid};
  };

  constexpr Phy(Preamble preamble, const Timing& timing) noexcept : preamble_(preamble), timing_(timing) {}

  [[nodiscard]] constexpr Preamble preamble() const noexcept { return preamble_; }
  [[nodiscard]] constexpr ranging::Ticks receiver_start() const noexcept { return timing_.receiver_start; }
  [[nodiscard]] constexpr ranging::Ticks transmit_grid() const noexcept { return timing_.transmit_grid; }

  // From the start of the preamble to the RMARKER, the instant that timestamps refer to.
  [[nodiscard]] constexpr ranging::Ticks before_rmarker() const noexcept { return timing_.synchronization; }
  // From the RMARKER to the end of a frame of `bytes`, frame check included. Reed-Solomon adds 48 bits for
  // each 330 begun.
  [[nodiscard]] constexpr ranging::Ticks after_rmarker(std::size_t bytes) const noexcept {
    const auto bits = static_cast<std::uint32_t>(8 * bytes);
    return timing_.header + std::int64_t{bits + 48 * ((bits + 329) / 330)} * timing_.data_bit;
  }
  [[nodiscard]] constexpr ranging::Ticks air_time(std::size_t bytes) const noexcept {
    return before_rmarker() + after_rmarker(bytes);
  }

 private:
  Preamble preamble_;
  Timing timing_;
};

}  // namespace groma::radio
