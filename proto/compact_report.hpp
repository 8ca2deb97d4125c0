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
// What lies outside is held at the end of the field. The rounding costs 0.05 mm, 0.5 us and 0.25 dB.
#pragma once

#include <cstddef>

#include "groma.pb.h"

namespace groma::wire {

inline constexpr std::size_t kCompactRangeBytes = 11;

void compact_report(const groma_SlotReport& report, groma_CompactReport& out) noexcept;

// False where the ranges are no whole number of records.
[[nodiscard]] bool expand_report(const groma_CompactReport& report, groma_SlotReport& out) noexcept;

}  // namespace groma::wire
