// CCM* (IEEE 802.15.4-2011, annex B.4; NIST SP 800-38C) for authentication only: nothing is encrypted, and
// the MIC has 8 bytes.
//
// No nonce may be used twice under one key for different bytes: the two MICs would allow forging a third one.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/security/block_cipher.hpp"

namespace groma::security {

using Nonce = std::array<std::uint8_t, 13>;
using Code = std::array<std::uint8_t, 8>;

// The parts of a MIC that do not depend on the frame's bytes: E(B0) without the length, and E(A0). Can be
// computed as soon as the nonce is known.
struct Prepared {
  Block first{};
  Block mask{};
};
[[nodiscard]] std::optional<Prepared> prepare(BlockCipher& cipher, const Key& key,
                                              const Nonce& nonce) noexcept;

// begin_code() starts the remainder, (2 + bytes) / 16 blocks, rounded up, for 1 to 65279 bytes. The bytes
// must not change until end_code(), which returns nothing if the cipher failed.
void begin_code(BlockCipher& cipher, const Key& key, const Block& first,
                std::span<const std::uint8_t> bytes) noexcept;
[[nodiscard]] std::optional<Code> end_code(BlockCipher& cipher, const Block& mask) noexcept;

// Computes a MIC in one call.
[[nodiscard]] std::optional<Code> code_of(BlockCipher& cipher, const Key& key, const Nonce& nonce,
                                          std::span<const std::uint8_t> bytes) noexcept;

// Compares in constant time.
[[nodiscard]] bool equal(std::span<const std::uint8_t> a, std::span<const std::uint8_t> b) noexcept;

}  // namespace groma::security
