// CCM* (IEEE 802.15.4-2011, annex B.4; NIST SP 800-38C) for authentication alone: nothing is encrypted, and
// the code is 8 bytes.
//
// No nonce may serve twice under one key for different bytes: who has seen both codes could forge a third.
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

// What a code takes that does not hang on the frame's bytes: two blocks, E(B0) without the length and E(A0).
// Can be made as soon as the nonce is known.
struct Prepared {
  Block first{};
  Block mask{};
};
[[nodiscard]] std::optional<Prepared> prepare(BlockCipher& cipher, const Key& key,
                                              const Nonce& nonce) noexcept;

// Begins what is left, (2 + bytes) / 16 blocks, rounded up, of 1 to 65279 bytes that stay as they are until
// end_code(). Nothing where the cipher failed.
void begin_code(BlockCipher& cipher, const Key& key, const Block& first,
                std::span<const std::uint8_t> bytes) noexcept;
[[nodiscard]] std::optional<Code> end_code(BlockCipher& cipher, const Block& mask) noexcept;

// All of it at once.
[[nodiscard]] std::optional<Code> code_of(BlockCipher& cipher, const Key& key, const Nonce& nonce,
                                          std::span<const std::uint8_t> bytes) noexcept;

// In a time that does not tell where they differ.
[[nodiscard]] bool equal(std::span<const std::uint8_t> a, std::span<const std::uint8_t> b) noexcept;

}  // namespace groma::security
