// How many bits a CAN frame has on the bus.
#pragma once

#include <cstdint>

#include "proto/can_segment.hpp"

namespace groma::sim {

// Interframe space, and what a transmitter that is error passive waits on top.
inline constexpr unsigned kIntermissionBits = 3;
inline constexpr unsigned kSuspendBits = 8;
// From the acknowledge delimiter to the end of frame, all recessive.
inline constexpr unsigned kRecessiveEndBits = 8;

// From the start of frame to the end of frame, stuff bits counted from the frame's own pattern (ISO
// 11898-1:2015, 10.4 and 10.5). With a bit-rate switch the bit BRS counts as nominal and the CRC delimiter as
// data: each is divided at its sample point, and the two parts of either sort make one whole bit.
struct CanBits {
  unsigned nominal = 0;
  unsigned data = 0;   // at the data bit rate
  unsigned stuff = 0;  // of both, inserted by the coding
  [[nodiscard]] unsigned total() const noexcept { return nominal + data; }
};

// error_passive: the transmitter's, told by the bit ESI.
[[nodiscard]] CanBits can_bits(const wire::CanFrame& frame, bool error_passive = false) noexcept;

}  // namespace groma::sim
