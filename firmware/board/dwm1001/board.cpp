#include "firmware/board/dwm1001/board.hpp"

#include <algorithm>

#include "firmware/board/dwm1001/clock.hpp"
#include "firmware/board/dwm1001/cpu.hpp"
#include "firmware/board/dwm1001/pins.hpp"
#include "firmware/board/dwm1001/stack.hpp"
#include "firmware/board/dwm1001/watchdog.hpp"
#include "firmware/core/storage/counter.hpp"

namespace groma::dwm1001 {
namespace {

namespace gpio = nrf52832::gpio;
namespace gpiote = nrf52832::gpiote;

}  // namespace

void Board::start() noexcept {
  reset_ = take_reset();
  clock::start();
  watchdog::start();
  leds_.start();
  radio_.start();
  uart_.start();
  ecb_.start();
  boot_count_ = storage::Counter(flash_).open_block();

  // Pulled down, so that the line is low also while the radio is in reset and does not drive it.
  pin::configure(pin::kRadioInterrupt, gpio::kInputPulledDown);
  gpiote::kBlock[gpiote::kConfig] =
      gpiote::kEventMode | pin::kRadioInterrupt << gpiote::kPinShift | gpiote::kRising;
  gpiote::kBlock[gpiote::kEventIn] = 0;
  gpiote::kBlock[gpiote::kInterruptSet] = 1U << 0;
  enable_interrupt(nrf52832::Irq::kGpiote, Priority::kPeripheral);
}

// DW1000 datasheet 5.6.1: low for at least 50 ns, then not driven; the chip drives the line itself. Its
// crystal runs and SPI answers at most 2 ms later (user manual 2.3).
void Board::reset_radio() noexcept {
  constexpr std::uint32_t kLow_us = 10;
  constexpr std::uint32_t kWakeUp_us = 5'000;
  pin::clear(pin::kRadioReset);
  pin::configure(pin::kRadioReset, gpio::kOutput);
  delay_us(kLow_us);
  pin::configure(pin::kRadioReset, gpio::kInput);
  delay_us(kWakeUp_us);
}

void Board::delay_us(std::uint32_t duration_us) noexcept {
  clock::delay_us(duration_us);
}

std::uint64_t Board::now_us() noexcept {
  return clock::now_us();
}

std::uint64_t Board::radio_interrupt_us() noexcept {
  return clock::marked_us();
}

// Sends the bytes queued for the host first: they may hold the reply to the command that requested the
// restart.
void Board::restart() noexcept {
  constexpr std::uint32_t kStep_us = 100;
  constexpr int kSteps = 1'000;
  can_.drain();
  for (int i = 0; i < kSteps && !uart_.idle(); ++i) delay_us(kStep_us);
  reset_processor();
}

void Board::proof_of_life() noexcept {
  watchdog::feed();
}

node::StackUse Board::stack_use() noexcept {
  return dwm1001::stack_use();
}

bool Board::radio_interrupt() const noexcept {
  return pin::is_high(pin::kRadioInterrupt);
}

void Board::sleep_until(std::uint64_t t_us) noexcept {
  const InterruptLock lock;
  if (uart_.starting() || ecb_.busy()) return;
  const std::uint64_t wake_us =
      std::min({t_us, leds_.next_change_us(), uart_.next_poll_us(), can_.next_deadline_us()});
  if (!radio_interrupt() && !can_.waiting() && clock::wake_at(wake_us)) sleep();
}

}  // namespace groma::dwm1001
