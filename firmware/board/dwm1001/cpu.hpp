// Functions of the processor: interrupts, sleep, reset.
#pragma once

#include <cstdint>

#include "firmware/board/dwm1001/nrf52832.hpp"

namespace groma::dwm1001 {

// Smaller is more urgent; four of the eight levels are enough. Faults preempt all interrupts.
enum class Priority : std::uint8_t {
  kWatchdog = 0,
  kPeripheral = 2,
};

inline void enable_interrupt(nrf52832::Irq irq, Priority priority) noexcept {
  namespace scb = nrf52832::scb;
  const auto number = static_cast<std::uint32_t>(irq);
  // The priority is the byte's upper three bits; the register is written as a word.
  const std::uint32_t shift = 8 * (number % 4);
  auto& priorities = scb::kBlock[scb::kNvicPriority + number / 4 * 4];
  priorities = (priorities & ~(0xFFU << shift)) | static_cast<std::uint32_t>(priority) << (shift + 5);
  scb::kBlock[scb::kNvicEnable + number / 32 * 4] = 1U << (number % 32);
}

// Masks interrupts, but not faults, during its lifetime. Must not be nested.
class InterruptLock {
 public:
  InterruptLock() noexcept { asm volatile("cpsid i" ::: "memory"); }
  ~InterruptLock() noexcept { asm volatile("cpsie i\n isb" ::: "memory"); }
  InterruptLock(const InterruptLock&) = delete;
  InterruptLock& operator=(const InterruptLock&) = delete;
};

// Sleeps until an interrupt is pending. Only under an InterruptLock: the interrupt is taken when the lock
// ends, so a condition checked under the lock cannot change unnoticed before the sleep. Anomaly 220: RAM may
// not be written in the first cycle after the wake-up; Nordic's workaround is four NOPs before interrupts are
// unmasked.
inline void sleep() noexcept {
  asm volatile("dsb\n wfi\n nop\n nop\n nop\n nop" ::: "memory");
}

[[noreturn]] inline void reset_processor() noexcept {
  namespace scb = nrf52832::scb;
  asm volatile("dsb" ::: "memory");
  scb::kBlock[scb::kResetControl] = scb::kResetRequest;
  for (;;) asm volatile("dsb" ::: "memory");
}

}  // namespace groma::dwm1001
