// Crystals, and time since boot by TIMER0: 32 bits at 1 MHz, carried on to 64 by whoever reads it.
#pragma once

#include <cstdint>

namespace groma::dwm1001::clock {

// Starts both crystals and the timer; returns when the 64 MHz are exact. The slow crystal takes a quarter of
// a second more, which nobody waits for.
void start() noexcept;

// From thread mode alone, at least once an hour.
[[nodiscard]] std::uint64_t now_us() noexcept;

// An interrupt wakes the processor at that time or before; the maximum: never. False: it has passed. From
// thread mode under an InterruptLock, so that the interrupt is not taken before the sleep.
[[nodiscard]] bool wake_at(std::uint64_t t_us) noexcept;

// Sleeps that long at least; interrupts are served.
void delay_us(std::uint32_t duration_us) noexcept;

// For its vector.
void on_interrupt() noexcept;

}  // namespace groma::dwm1001::clock
