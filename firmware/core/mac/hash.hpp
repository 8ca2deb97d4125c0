#pragma once

#include <cstdint>

namespace groma::mac {

// The finalizer of MurmurHash3: each bit of the input changes each of the output with probability 1/2. Draws
// that are such hashes need no source of randomness and are equal in each replay.
[[nodiscard]] constexpr std::uint32_t mix(std::uint32_t h) noexcept {
  h ^= h >> 16;
  h *= 0x85EB'CA6BU;
  h ^= h >> 13;
  h *= 0xC2B2'AE35U;
  return h ^ h >> 16;
}

}  // namespace groma::mac
