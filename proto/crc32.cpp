#include "proto/crc32.hpp"

#include <array>

namespace groma::wire {
namespace {

constexpr std::uint32_t kPolynomialReflected = 0xEDB88320U;

constexpr std::array<std::uint32_t, 256> make_crc_table() {
  std::array<std::uint32_t, 256> table{};
  for (std::uint32_t i = 0; i < 256; ++i) {
    std::uint32_t value = i;
    for (int bit = 0; bit < 8; ++bit) {
      value = (value & 1U) != 0 ? (value >> 1) ^ kPolynomialReflected : value >> 1;
    }
    table[i] = value;
  }
  return table;
}

}  // namespace

constinit const std::array<std::uint32_t, 256> kCrc32Table = make_crc_table();

std::uint32_t crc32(std::span<const std::uint8_t> bytes) noexcept {
  Crc32 crc;
  for (const std::uint8_t byte : bytes) crc.add(byte);
  return crc.value();
}

}  // namespace groma::wire
