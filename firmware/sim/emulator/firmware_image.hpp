// The image as it is flashed: the contents of flash and UICR in the shipped .hex.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <string_view>
#include <vector>

namespace groma::sim {

// nRF52832 product specification, memory map.
inline constexpr std::uint32_t kFlashBytes = 512 * 1024;
inline constexpr std::uint32_t kFlashPageBytes = 4096;
inline constexpr std::uint32_t kRamAddress = 0x20000000;
inline constexpr std::uint32_t kRamBytes = 64 * 1024;
inline constexpr std::uint32_t kUicrAddress = 0x10001000;
inline constexpr std::uint32_t kUicrBytes = 0x300;

struct FirmwareImage {
  std::vector<std::uint8_t> flash = std::vector<std::uint8_t>(kFlashBytes, 0xFF);
  std::vector<std::uint8_t> uicr = std::vector<std::uint8_t>(kUicrBytes, 0xFF);
};

// Parses Intel HEX. Throws SimulationError if the text is invalid or has data outside flash and UICR.
[[nodiscard]] FirmwareImage firmware_image_of_hex(std::string_view text);

// The same for a file. Throws a SimulationError that names the file; if it is missing, also how to build it.
[[nodiscard]] FirmwareImage read_firmware_image(const std::filesystem::path& path);

}  // namespace groma::sim
