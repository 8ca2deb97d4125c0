// The CRC-32 of IEEE 802.3 for frames on the wire and records in flash. Polynomial 0x04C11DB7 reflected,
// initial value and final XOR all ones; the published check value for "123456789" is 0xCBF43926.
#pragma once

#include <array>
#include <cstdint>
#include <span>

namespace groma::wire {

// The change of the CRC state for each byte value.
extern const std::array<std::uint32_t, 256> kCrc32Table;

class Crc32 {
 public:
  void add(std::uint8_t byte) noexcept { state_ = state_ >> 8 ^ kCrc32Table[(state_ ^ byte) & 0xFFU]; }
  // Adds the word's bytes, lowest first.
  void add_word(std::uint32_t word) noexcept {
    for (unsigned shift = 0; shift < 32; shift += 8) add(static_cast<std::uint8_t>(word >> shift));
  }
  // The CRC of all bytes added so far.
  [[nodiscard]] std::uint32_t value() const noexcept { return ~state_; }

 private:
  std::uint32_t state_ = 0xFFFFFFFFU;
};

[[nodiscard]] std::uint32_t crc32(std::span<const std::uint8_t> bytes) noexcept;

}  // namespace groma::wire
