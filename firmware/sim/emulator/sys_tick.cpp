#include "firmware/sim/emulator/sys_tick.hpp"

namespace groma::sim {
namespace {

constexpr std::uint32_t kEnable = 1U << 0;
constexpr std::uint32_t kTickInterrupt = 1U << 1;
constexpr std::uint32_t kProcessorClock = 1U << 2;
constexpr std::uint32_t kCountFlag = 1U << 16;

}  // namespace

void SysTick::reset() noexcept {
  *this = SysTick(cycle_);
}

void SysTick::start(SimTime now, std::uint32_t from) noexcept {
  // At zero the next cycle loads the reload value; a reload value of zero stops the counter.
  const std::uint32_t cycles = from != 0 ? from : (reload_ != 0 ? reload_ + 1 : 0);
  zero_at_ = cycles != 0 ? now + static_cast<SimTime>(cycles) * cycle_ : kNever;
}

bool SysTick::advance(SimTime now) noexcept {
  if (!counting() || now < zero_at_) return false;
  count_flag_ = true;
  if (reload_ == 0) {
    stopped_at_ = 0;
    zero_at_ = kNever;
  } else {
    const SimTime period = (static_cast<SimTime>(reload_) + 1) * cycle_;
    zero_at_ += ((now - zero_at_) / period + 1) * period;
  }
  return interrupts_;
}

SimTime SysTick::next_interrupt() const noexcept {
  return counting() && interrupts_ ? zero_at_ : kNever;
}

std::uint32_t SysTick::read_control(SimTime) noexcept {
  const std::uint32_t value = (enabled_ ? kEnable : 0U) | (interrupts_ ? kTickInterrupt : 0U) |
                              kProcessorClock | (count_flag_ ? kCountFlag : 0U);
  count_flag_ = false;
  return value;
}

void SysTick::write_control(SimTime now, std::uint32_t value) noexcept {
  const bool enable = (value & kEnable) != 0;
  if (enabled_ && !enable) stopped_at_ = current(now);
  if (!enabled_ && enable) start(now, stopped_at_);
  enabled_ = enable;
  interrupts_ = (value & kTickInterrupt) != 0;
}

std::uint32_t SysTick::current(SimTime now) const noexcept {
  if (!counting()) return stopped_at_;
  const auto left = static_cast<std::uint32_t>((zero_at_ - now + cycle_ - 1) / cycle_);
  return left > reload_ && left == reload_ + 1 ? 0 : left;
}

void SysTick::clear_current(SimTime now) noexcept {
  count_flag_ = false;
  stopped_at_ = 0;
  if (enabled_) start(now, 0);
}

}  // namespace groma::sim
