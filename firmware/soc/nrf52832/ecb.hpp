// The nRF52832's AES-128 peripheral (ECB), which works on a buffer in RAM.
#pragma once

#include <atomic>
#include <cstdint>
#include <optional>

#include "firmware/core/security/block_cipher.hpp"

namespace groma::nrf52832 {

class Ecb final : public security::BlockCipher {
 public:
  // A block takes 7.2 us (nRF52832 PS v1.4, 28). In a chain the interrupt of each block starts the next one.
  // The image does not use CCM and AAR, which share the AES engine with ECB.
  void start() noexcept;

  [[nodiscard]] bool encrypt(const security::Key& key, security::Block& block) noexcept override;
  void begin(const security::Key& key, const security::Block& state, security::Chain chain) noexcept override;
  // Stays awake, because of anomaly 109. Nothing sleeps between begin() and finish().
  [[nodiscard]] std::optional<security::Block> finish() noexcept override;

  // ECB's interrupt handler.
  void on_interrupt() noexcept;

 private:
  enum class State : std::uint8_t { kIdle, kBusy, kFailed };

  void encrypt_next() noexcept;

  // The peripheral's data structure.
  struct Data {
    security::Key key{};
    security::Block clear{};
    security::Block encrypted{};
  };
  alignas(4) Data data_;
  security::Chain chain_;
  std::atomic<State> state_ = State::kIdle;
};

}  // namespace groma::nrf52832
