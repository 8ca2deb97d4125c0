// A small Groma image as Intel HEX, and a probe's configuration for OpenOCD.
#pragma once

#include <fmt/format.h>

#include <cstdint>
#include <cstring>
#include <filesystem>
#include <numeric>
#include <random>
#include <span>
#include <string>
#include <vector>

#include "firmware/core/node/image_identity.hpp"

namespace groma::provision::test {

// Vector table, identity, then noise.
inline std::vector<std::uint8_t> small_image(std::size_t bytes, const char* version = "simulated",
                                             std::uint32_t git_hash = 0, const char* board = "dwm1001") {
  std::vector<std::uint8_t> image(bytes);
  std::minstd_rand random(1);
  for (std::uint8_t& byte : image) byte = static_cast<std::uint8_t>(random() >> 8);
  const std::uint32_t stack = 0x2000'1000;
  const std::uint32_t entry = 0x201;
  const node::ImageIdentity identity(version, git_hash, board);
  std::memcpy(image.data(), &stack, sizeof stack);
  std::memcpy(image.data() + 4, &entry, sizeof entry);
  std::memcpy(image.data() + 0x100, &identity, sizeof identity);
  return image;
}

inline std::string hex_record(std::uint8_t type, std::uint16_t address, std::span<const std::uint8_t> data) {
  std::vector<std::uint8_t> bytes{static_cast<std::uint8_t>(data.size()),
                                  static_cast<std::uint8_t>(address >> 8), static_cast<std::uint8_t>(address),
                                  type};
  bytes.insert(bytes.end(), data.begin(), data.end());
  const unsigned sum = std::accumulate(bytes.begin(), bytes.end(), 0U);
  bytes.push_back(static_cast<std::uint8_t>(0x100U - (sum & 0xFFU)));
  std::string line = ":";
  for (const std::uint8_t byte : bytes) line += fmt::format("{:02X}", byte);
  return line + '\n';
}

inline std::string hex_of(std::span<const std::uint8_t> image, std::uint32_t base = 0) {
  constexpr std::size_t kRow = 16;
  std::string text;
  for (std::size_t i = 0; i < image.size(); i += kRow) {
    const std::uint32_t address = base + static_cast<std::uint32_t>(i);
    if (i == 0 || address % 0x10000 == 0) {
      const std::vector<std::uint8_t> high{static_cast<std::uint8_t>(address >> 24),
                                           static_cast<std::uint8_t>(address >> 16)};
      text += hex_record(4, 0, high);
    }
    text += hex_record(0, static_cast<std::uint16_t>(address),
                       image.subspan(i, std::min(kRow, image.size() - i)));
  }
  return text;
}

inline const std::string kHexEnd = ":00000001FF\n";

// The probe listens at FOLDER/SERIAL.sock. The part has no work area, so the debugger itself writes and
// reads back the flash. OpenOCD drives remote_bitbang by JTAG only, for which nrf52.cfg gives no
// instruction length.
inline std::string probe_configuration(const std::filesystem::path& folder) {
  return fmt::format(
      "adapter driver remote_bitbang\n"
      "remote_bitbang host {}/$GROMA_PROBE.sock\n"
      "set WORKAREASIZE 0\n"
      "rename source read_script\n"
      "proc source {{path}} {{\n"
      "  uplevel #0 [list read_script $path]\n"
      "  proc swj_newdap {{chip tag args}} {{ eval jtag newtap $chip $tag $args -irlen 4 }}\n"
      "}}\n",
      folder.string());
}

}  // namespace groma::provision::test
