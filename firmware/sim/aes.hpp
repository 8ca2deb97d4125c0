// AES-128 (FIPS 197) for simulated nodes. It replaces the nRF52832's ECB peripheral.
#pragma once

#include "firmware/core/security/block_cipher.hpp"

namespace groma::sim {

class Aes final : public security::BlockCipher {
 public:
  constexpr Aes() = default;
  [[nodiscard]] bool encrypt(const security::Key& key, security::Block& block) noexcept override;
};

}  // namespace groma::sim
