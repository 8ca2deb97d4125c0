// Functions of the processor: interrupts and reset.
#pragma once

#include <cstdint>

#include "firmware/arch/cortex_m4/registers.hpp"

namespace groma::cortex_m4 {

// Enables an interrupt. `priority`: smaller is more urgent; a chip has only the upper bits of this byte.
inline void enable_interrupt(std::uint32_t number, std::uint8_t priority) noexcept {
  // The register is written as a word.
  const std::uint32_t shift = 8 * (number % 4);
  auto& priorities = scb::kBlock[scb::kNvicPriority + number / 4 * 4];
  priorities = (priorities & ~(0xFFU << shift)) | std::uint32_t{priority} << shift;
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

[[noreturn]] inline void reset_processor() noexcept {
  asm volatile("dsb" ::: "memory");
  scb::kBlock[scb::kResetControl] = scb::kResetRequest;
  for (;;) asm volatile("dsb" ::: "memory");
}

}  // namespace groma::cortex_m4
