// A slot report in the fewest bytes, for links on which the full one does not fit.
//
// CompactReport.ranges holds 11 bytes a range, little-endian:
//
//   bytes  0..1   anchor id
//   byte   2      RangeStatus
//   bytes  3..5   distance in steps of 0.1 mm, 0 to 1677.7215 m; 0 where there is none
//   bytes  6..8   microseconds from the range's instant to device_time_dtu
//   byte   9      first-path power in steps of -0.5 dBm, 0 to -127 dBm; 0xFF: not known
//   byte  10      receive power, the same
//
// CompactReport.traits holds 2 bytes a range, in the same order; a node from before there were any sends
// none:
//
//   byte   0      Range.flags
//   byte   1      Range.noise
//
// What lies outside is held at the end of the field. The rounding costs 0.05 mm, 0.5 us and 0.25 dB.
#pragma once

#include <cstddef>

#include "groma.pb.h"

namespace groma::wire {

inline constexpr std::size_t kCompactRangeBytes = 11;
inline constexpr std::size_t kCompactTraitBytes = 2;

void compact_report(const groma_SlotReport& report, groma_CompactReport& out) noexcept;

// False where the ranges are no whole number of records. Traits that are not of as many ranges are left out.
[[nodiscard]] bool expand_report(const groma_CompactReport& report, groma_SlotReport& out) noexcept;

}  // namespace groma::wire
