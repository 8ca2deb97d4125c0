#include "firmware/soc/nrf52832/ecb.hpp"

#include "firmware/arch/cortex_m4/memory.hpp"
#include "firmware/soc/nrf52832/cpu.hpp"
#include "firmware/soc/nrf52832/registers.hpp"

namespace groma::nrf52832 {

void Ecb::start() noexcept {
  ecb::kBlock[ecb::kDataPointer] = cortex_m4::address_of(&data_);
  ecb::kBlock[ecb::kEventEnd] = 0;
  ecb::kBlock[ecb::kEventError] = 0;
  ecb::kBlock[ecb::kInterruptSet] = ecb::kInterruptEnd | ecb::kInterruptError;
  enable_interrupt(Irq::kEcb, Priority::kPeripheral);
}

bool Ecb::encrypt(const security::Key& key, security::Block& block) noexcept {
  begin(key, block, {.filled = security::kBlockBytes});
  const auto encrypted = finish();
  if (encrypted) block = *encrypted;
  return encrypted.has_value();
}

void Ecb::begin(const security::Key& key, const security::Block& state, security::Chain chain) noexcept {
  (void)finish();
  data_.key = key;
  data_.encrypted = state;
  chain_ = chain;
  state_ = State::kBusy;
  encrypt_next();
}

void Ecb::encrypt_next() noexcept {
  data_.clear = data_.encrypted;
  chain_.absorb(data_.clear);
  asm volatile("" ::: "memory");
  ecb::kBlock[ecb::kStart] = 1;
}

void Ecb::on_interrupt() noexcept {
  const bool failed = ecb::kBlock[ecb::kEventError] != 0;
  ecb::kBlock[ecb::kEventError] = 0;
  clear_event(ecb::kBlock[ecb::kEventEnd]);
  asm volatile("" ::: "memory");
  if (state_ != State::kBusy) return;
  if (failed) {
    state_ = State::kFailed;
  } else if (chain_.rest.empty()) {
    state_ = State::kIdle;
  } else {
    encrypt_next();
  }
}

std::optional<security::Block> Ecb::finish() noexcept {
  // A frame of 127 bytes takes about a thousand polls; far more mean that the result will not come.
  constexpr int kPolls = 50'000;
  int polls = 0;
  while (state_ == State::kBusy) {
    if (++polls > kPolls) {
      ecb::kBlock[ecb::kStop] = 1;
      state_ = State::kFailed;
    }
  }
  if (state_ == State::kFailed) return std::nullopt;
  return data_.encrypted;
}

}  // namespace groma::nrf52832
