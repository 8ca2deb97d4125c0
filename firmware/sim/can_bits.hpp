// The number of bits of a CAN frame on the bus.
#pragma once

#include <cstdint>

#include "proto/can_segment.hpp"

namespace groma::sim {

// Interframe space, and the additional wait of an error-passive transmitter.
inline constexpr unsigned kIntermissionBits = 3;
inline constexpr unsigned kSuspendBits = 8;
// From the acknowledge delimiter to the end of frame; all are recessive.
inline constexpr unsigned kRecessiveEndBits = 8;

// From the start of frame to the end of frame, with the stuff bits that the frame's content requires (ISO
// 11898-1:2015, 10.4 and 10.5). With a bit-rate switch, BRS counts as nominal and the CRC delimiter as data:
// the rate changes at the sample point of each, and the partial bits of each rate add up to one whole bit.
struct CanBits {
  unsigned nominal = 0;
  unsigned data = 0;   // at the data bit rate
  unsigned stuff = 0;  // of both, inserted by the coding
  [[nodiscard]] unsigned total() const noexcept { return nominal + data; }
};

// error_passive: the transmitter's error state, which the ESI bit carries.
[[nodiscard]] CanBits can_bits(const wire::CanFrame& frame, bool error_passive = false) noexcept;

}  // namespace groma::sim
