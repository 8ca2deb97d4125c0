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

// Of 1 to 65279 bytes. Takes 2 + (2 + bytes) / 16, rounded up, blocks of the cipher. Nothing where the
// cipher failed.
[[nodiscard]] std::optional<Code> code_of(BlockCipher& cipher, const Key& key, const Nonce& nonce,
                                          std::span<const std::uint8_t> bytes) noexcept;

// In a time that does not tell where they differ.
[[nodiscard]] bool equal(std::span<const std::uint8_t> a, std::span<const std::uint8_t> b) noexcept;

}  // namespace groma::security
