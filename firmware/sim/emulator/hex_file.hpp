// A parser for Intel HEX.
#pragma once

#include <cstdint>
#include <string_view>
#include <vector>

namespace groma::sim {

// Consecutive bytes of memory.
struct HexSegment {
  std::uint32_t address = 0;
  std::vector<std::uint8_t> bytes;
};

// Reads data (00), end of file (01), extended segment (02), extended linear (04) and start address (03, 05)
// records. Segments are in the file's order; consecutive records without a gap form one segment. Throws a
// SimulationError that names the line and the error. A file without an end-of-file record is an error.
[[nodiscard]] std::vector<HexSegment> parse_hex(std::string_view text);

}  // namespace groma::sim
