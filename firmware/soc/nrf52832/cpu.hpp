// What the nRF52832 adds to the functions of the processor: its interrupts and its sleep.
#pragma once

#include <cstdint>

#include "firmware/arch/cortex_m4/cpu.hpp"
#include "firmware/soc/nrf52832/registers.hpp"

namespace groma::nrf52832 {

using cortex_m4::InterruptLock;

// Of the eight levels, the upper three bits of the register's byte, two are enough. Faults preempt all
// interrupts.
enum class Priority : std::uint8_t {
  kWatchdog = 0 << 5,
  kPeripheral = 2 << 5,
};

inline void enable_interrupt(Irq irq, Priority priority) noexcept {
  cortex_m4::enable_interrupt(static_cast<std::uint32_t>(irq), static_cast<std::uint8_t>(priority));
}

// Sleeps until an interrupt is pending. Only under an InterruptLock: the interrupt is taken when the lock
// ends, so a condition checked under the lock cannot change unnoticed before the sleep. Anomaly 220: RAM may
// not be written in the first cycle after the wake-up; Nordic's workaround is four NOPs before interrupts are
// unmasked.
inline void sleep() noexcept {
  asm volatile("dsb\n wfi\n nop\n nop\n nop\n nop" ::: "memory");
}

}  // namespace groma::nrf52832
