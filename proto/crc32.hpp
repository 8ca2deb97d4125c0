// The CRC of IEEE 802.3 (polynomial 0x04C11DB7 reflected, initial value and final XOR all ones; its published
// check value for "123456789" is 0xCBF43926): of frames on the wire and of records in flash.
#pragma once

#include <array>
#include <cstdint>
#include <span>

namespace groma::wire {

// What a byte does to the CRC.
extern const std::array<std::uint32_t, 256> kCrc32Table;

class Crc32 {
 public:
  void add(std::uint8_t byte) noexcept { state_ = state_ >> 8 ^ kCrc32Table[(state_ ^ byte) & 0xFFU]; }
  // Its bytes from the lowest to the highest.
  void add_word(std::uint32_t word) noexcept {
    for (unsigned shift = 0; shift < 32; shift += 8) add(static_cast<std::uint8_t>(word >> shift));
  }
  // Of all that was added so far.
  [[nodiscard]] std::uint32_t value() const noexcept { return ~state_; }

 private:
  std::uint32_t state_ = 0xFFFFFFFFU;
};

[[nodiscard]] std::uint32_t crc32(std::span<const std::uint8_t> bytes) noexcept;

}  // namespace groma::wire
