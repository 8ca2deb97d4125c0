// The clocks, and time since boot from TIMER0: 32 bits at 1 MHz, which now_us() extends to 64.
#pragma once

#include <cstdint>

#include "firmware/soc/nrf52832/wiring.hpp"

namespace groma::nrf52832::clock {

// Starts the timer, the 64 MHz crystal and the slow clock; at most 0.5 ms. Returns when the 64 MHz clock is
// exact; it does not wait another quarter of a second for a slow crystal.
void start(SlowClock slow_clock) noexcept;

// Call from thread mode only, at least once an hour.
[[nodiscard]] std::uint64_t now_us() noexcept;

// Marks the present time, from an interrupt handler; the processor's cycle counter would stand still in
// sleep.
void mark() noexcept;
// now_us() at the last mark(), at most an hour ago. Call from thread mode only.
[[nodiscard]] std::uint64_t marked_us() noexcept;

// Arranges an interrupt at t_us or before; the maximum: never. False: t_us has passed. Call from thread mode
// under an InterruptLock, so that the interrupt is not taken before the sleep.
[[nodiscard]] bool wake_at(std::uint64_t t_us) noexcept;

// Waits for at least this time, awake; interrupts are served.
void delay_us(std::uint32_t duration_us) noexcept;

// TIMER0's interrupt handler.
void on_interrupt() noexcept;

}  // namespace groma::nrf52832::clock
