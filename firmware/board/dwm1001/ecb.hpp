// The nRF52832's AES-128 (ECB), which works on a buffer in RAM.
#pragma once

#include <atomic>
#include <cstdint>
#include <optional>

#include "firmware/core/security/block_cipher.hpp"

namespace groma::dwm1001 {

class Ecb final : public security::BlockCipher {
 public:
  // 7.2 us a block (nRF52832 PS v1.4, 28), each of a chain begun by the interrupt of the one before. Nothing
  // else on this board uses the AES engine that ECB, CCM and AAR share.
  void start() noexcept;

  [[nodiscard]] bool encrypt(const security::Key& key, security::Block& block) noexcept override;
  void begin(const security::Key& key, const security::Block& state, security::Chain chain) noexcept override;
  [[nodiscard]] std::optional<security::Block> finish() noexcept override;

  // For its vector.
  void on_interrupt() noexcept;

 private:
  enum class State : std::uint8_t { kIdle, kBusy, kFailed };

  void encrypt_next() noexcept;

  // As the peripheral wants it.
  struct Data {
    security::Key key{};
    security::Block clear{};
    security::Block encrypted{};
  };
  alignas(4) Data data_;
  security::Chain chain_;
  std::atomic<State> state_ = State::kIdle;
};

}  // namespace groma::dwm1001
