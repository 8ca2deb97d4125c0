#include "firmware/sim/emulator/firmware_image.hpp"

#include <algorithm>
#include <array>
#include <cstdio>
#include <fstream>
#include <sstream>
#include <string>

#include "firmware/sim/emulator/hex_file.hpp"
#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

FirmwareImage firmware_image_of_hex(std::string_view text) {
  FirmwareImage image;
  for (const HexSegment& segment : parse_hex(text)) {
    const auto copy_into = [&](std::vector<std::uint8_t>& memory, std::uint32_t base) {
      if (segment.address < base || segment.address - base > memory.size() ||
          segment.bytes.size() > memory.size() - (segment.address - base))
        return false;
      std::copy(segment.bytes.begin(), segment.bytes.end(),
                memory.begin() + static_cast<std::ptrdiff_t>(segment.address - base));
      return true;
    };
    if (copy_into(image.flash, 0) || copy_into(image.uicr, kUicrAddress)) continue;
    std::array<char, 96> where{};
    std::snprintf(where.data(), where.size(), "%zu bytes at 0x%08X lie in neither flash nor UICR",
                  segment.bytes.size(), static_cast<unsigned>(segment.address));
    throw SimulationError(where.data());
  }
  return image;
}

FirmwareImage read_firmware_image(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) {
    throw SimulationError("no firmware image at " + path.string() +
                          "; build it: cmake --preset dwm1001 && cmake --build --preset dwm1001");
  }
  std::ostringstream text;
  text << file.rdbuf();
  try {
    return firmware_image_of_hex(text.str());
  } catch (const SimulationError& error) {
    throw SimulationError(path.string() + ": " + error.what());
  }
}

}  // namespace groma::sim
