// The frame check of IEEE 802.15.4: CRC-16 of the ITU-T, least significant bit first, from 0.
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
