// The nRF52832's AES-128 (ECB), which works on a buffer in RAM.
#pragma once

#include "firmware/core/security/block_cipher.hpp"

namespace groma::dwm1001 {

class Ecb final : public security::BlockCipher {
 public:
  // 7.2 us a block (nRF52832 PS v1.4, 28), polled. Nothing else on this board uses the AES engine that ECB,
  // CCM and AAR share.
  [[nodiscard]] bool encrypt(const security::Key& key, security::Block& block) noexcept override;

 private:
  // As the peripheral wants it.
  struct Data {
    security::Key key{};
    security::Block clear{};
    security::Block encrypted{};
  };
  alignas(4) Data data_;
};

}  // namespace groma::dwm1001
