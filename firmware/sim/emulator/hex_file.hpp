// Intel HEX, as linkers and flashing tools exchange it.
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
// records. Segments come in the file's order; what follows without a gap is one. Throws SimulationError that
// names the line and what is wrong with it; a file without its end record is cut short, and so wrong too.
[[nodiscard]] std::vector<HexSegment> parse_hex(std::string_view text);

}  // namespace groma::sim
