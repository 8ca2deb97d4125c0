#include "firmware/soc/nrf52832/platform.hpp"

#include <algorithm>

#include "board.hpp"
#include "firmware/arch/cortex_m4/stack.hpp"
#include "firmware/core/storage/counter.hpp"
#include "firmware/soc/nrf52832/clock.hpp"
#include "firmware/soc/nrf52832/cpu.hpp"
#include "firmware/soc/nrf52832/gpio.hpp"
#include "firmware/soc/nrf52832/watchdog.hpp"

namespace groma::nrf52832 {

using board::kWiring;

void Platform::start() noexcept {
  reset_ = take_reset();
  clock::start(kWiring.slow_clock);
  watchdog::start();
  leds_.start();
  if constexpr (kWiring.radio.wake_up.has_value()) {
    pin::clear(*kWiring.radio.wake_up);
    pin::configure(*kWiring.radio.wake_up, gpio::kOutput);
  }
  radio_.start();
  uart_.start(kWiring.uart);
  ecb_.start();
  boot_count_ = storage::Counter(flash_).open_block();

  // Pulled down, so that the line is low also while the radio is in reset and does not drive it.
  pin::configure(kWiring.radio.interrupt, gpio::kInputPulledDown);
  gpiote::kBlock[gpiote::kConfig] =
      gpiote::kEventMode | kWiring.radio.interrupt << gpiote::kPinShift | gpiote::kRising;
  gpiote::kBlock[gpiote::kEventIn] = 0;
  gpiote::kBlock[gpiote::kInterruptSet] = 1U << 0;
  enable_interrupt(Irq::kGpiote, Priority::kPeripheral);
}

// DW1000 datasheet 5.6.1: low for at least 50 ns, then not driven; the chip drives the line itself. Its
// crystal runs and SPI answers at most 2 ms later (user manual 2.3).
void Platform::reset_radio() noexcept {
  constexpr std::uint32_t kLow_us = 10;
  constexpr std::uint32_t kWakeUp_us = 5'000;
  pin::clear(kWiring.radio.reset);
  pin::configure(kWiring.radio.reset, gpio::kOutput);
  delay_us(kLow_us);
  pin::configure(kWiring.radio.reset, gpio::kInput);
  delay_us(kWakeUp_us);
}

void Platform::delay_us(std::uint32_t duration_us) noexcept {
  clock::delay_us(duration_us);
}

std::uint64_t Platform::now_us() noexcept {
  return clock::now_us();
}

std::uint64_t Platform::radio_interrupt_us() noexcept {
  return clock::marked_us();
}

// Sends the bytes queued for the host first: they may hold the reply to the command that requested the
// restart.
void Platform::restart() noexcept {
  constexpr std::uint32_t kStep_us = 100;
  constexpr int kSteps = 1'000;
  can_.drain();
  for (int i = 0; i < kSteps && !uart_.idle(); ++i) delay_us(kStep_us);
  cortex_m4::reset_processor();
}

void Platform::proof_of_life() noexcept {
  watchdog::feed();
}

node::StackUse Platform::stack_use() noexcept {
  return cortex_m4::stack_use();
}

bool Platform::radio_interrupt() const noexcept {
  return pin::is_high(kWiring.radio.interrupt);
}

void Platform::sleep_until(std::uint64_t t_us) noexcept {
  const InterruptLock lock;
  if (uart_.starting()) return;
  const std::uint64_t wake_us =
      std::min({t_us, leds_.next_change_us(), uart_.next_poll_us(), can_.next_deadline_us()});
  if (!radio_interrupt() && !can_.waiting() && clock::wake_at(wake_us)) sleep();
}

}  // namespace groma::nrf52832
