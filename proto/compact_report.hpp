// A compact encoding of a slot report, for links too slow for the full one.
//
// CompactReport.ranges holds 11 bytes per range, little-endian:
//
//   bytes  0..1   anchor id
//   byte   2      RangeStatus
//   bytes  3..5   distance in steps of 0.1 mm, 0 to 1677.7215 m; 0 if there is none
//   bytes  6..8   microseconds from the range's instant to device_time_dtu
//   byte   9      first-path power in steps of -0.5 dBm, 0 to -127 dBm; 0xFF: not known
//   byte  10      receive power, encoded as byte 9
//
// CompactReport.traits holds 2 bytes per range, in the same order. Older nodes send no traits:
//
//   byte   0      Range.flags
//   byte   1      Range.noise
//
// Values out of bounds are clamped. The rounding error is at most 0.05 mm, 0.5 us and 0.25 dB.
#pragma once

#include <cstddef>

#include "groma.pb.h"

namespace groma::wire {

inline constexpr std::size_t kCompactRangeBytes = 11;
inline constexpr std::size_t kCompactTraitBytes = 2;

void compact_report(const groma_SlotReport& report, groma_CompactReport& out) noexcept;

// Returns false if `ranges` is not a whole number of records. Ignores `traits` if its size does not match
// `ranges`.
[[nodiscard]] bool expand_report(const groma_CompactReport& report, groma_SlotReport& out) noexcept;

}  // namespace groma::wire
