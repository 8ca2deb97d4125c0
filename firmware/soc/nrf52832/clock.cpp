#include "firmware/soc/nrf52832/clock.hpp"

#include <algorithm>

#include "firmware/soc/nrf52832/cpu.hpp"
#include "firmware/soc/nrf52832/registers.hpp"

namespace groma::nrf52832::clock {
namespace {

constexpr std::uint32_t kDeadlineChannel = 0;
constexpr std::uint32_t kNowChannel = 1;
constexpr std::uint32_t kMarkChannel = 2;

// At most half the timer's range, so that the compare value is not taken for a past time.
constexpr std::uint64_t kLongestSleep_us = std::uint64_t{1} << 31;

std::uint32_t last_count_us = 0;
std::uint32_t wraps = 0;

constexpr std::uint64_t kNothing = 0;
// The time that the compare register is set to; kNothing after its interrupt.
std::uint64_t awaited_us = kNothing;  // changed only under an InterruptLock or by the interrupt

}  // namespace

void start(SlowClock slow_clock) noexcept {
  const auto& registers = timer::kBlock0;
  registers[timer::kMode] = timer::kTimerMode;
  registers[timer::kBitMode] = timer::k32Bits;
  registers[timer::kPrescaler] = timer::k1MHz;
  registers[timer::kClear] = 1;
  registers[timer::kInterruptSet] = timer::kInterruptCompare0;
  enable_interrupt(Irq::kTimer0, Priority::kPeripheral);
  registers[timer::kStart] = 1;

  power::kBlock[power::kHfclkStarted] = 0;
  power::kBlock[power::kHfclkStart] = 1;
  while (power::kBlock[power::kHfclkStarted] == 0) {
  }

  // Anomaly 132: the slow clock may not start sooner than 330 us after a reset. The timer has run for a part
  // of the time since, by the internal oscillator at first, so a margin is left.
  constexpr std::uint32_t kAfterReset_us = 400;
  while (now_us() < kAfterReset_us) {
  }
  power::kBlock[power::kLfclkSource] = static_cast<std::uint32_t>(slow_clock);
  power::kBlock[power::kLfclkStart] = 1;
}

std::uint64_t now_us() noexcept {
  timer::kBlock0[timer::kCapture + 4 * kNowChannel] = 1;
  const std::uint32_t count_us = timer::kBlock0[timer::kCompare + 4 * kNowChannel];
  if (count_us < last_count_us) ++wraps;
  last_count_us = count_us;
  return std::uint64_t{wraps} << 32 | count_us;
}

void mark() noexcept {
  timer::kBlock0[timer::kCapture + 4 * kMarkChannel] = 1;
}

std::uint64_t marked_us() noexcept {
  const std::uint64_t now = now_us();
  const std::uint32_t mark = timer::kBlock0[timer::kCompare + 4 * kMarkChannel];
  return now - (static_cast<std::uint32_t>(now) - mark);
}

bool wake_at(std::uint64_t t_us) noexcept {
  if (t_us == awaited_us) return t_us != kNothing;
  const std::uint64_t latest_us = now_us() + kLongestSleep_us;
  timer::kBlock0[timer::kCompare + 4 * kDeadlineChannel] =
      static_cast<std::uint32_t>(std::min(t_us, latest_us));
  awaited_us = t_us;
  // The counter may have passed the value before it was set.
  if (now_us() < t_us) return true;
  awaited_us = kNothing;
  return false;
}

void on_interrupt() noexcept {
  clear_event(timer::kBlock0[timer::kEventCompare + 4 * kDeadlineChannel]);
  awaited_us = kNothing;
}

void delay_us(std::uint32_t duration_us) noexcept {
  // One more for the elapsed part of the present microsecond.
  const std::uint64_t end_us = now_us() + duration_us + 1;
  while (now_us() < end_us) {
  }
}

}  // namespace groma::nrf52832::clock

extern "C" void timer0_entry() {
  groma::nrf52832::clock::on_interrupt();
}
