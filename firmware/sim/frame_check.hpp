// The frame check sequence of IEEE 802.15.4: the ITU-T CRC-16, least significant bit first, initial value 0.
#pragma once

#include <cstdint>
#include <span>

namespace groma::sim {

[[nodiscard]] constexpr std::uint16_t frame_check(std::span<const std::uint8_t> bytes) noexcept {
  std::uint16_t crc = 0;
  for (const std::uint8_t byte : bytes) {
    crc = static_cast<std::uint16_t>(crc ^ byte);
    for (int bit = 0; bit < 8; ++bit)
      crc = static_cast<std::uint16_t>((crc & 1) != 0 ? (crc >> 1) ^ 0x8408 : crc >> 1);
  }
  return crc;
}

}  // namespace groma::sim
