// The watchdog resets the node if it was not fed for kPeriod_s. Its interrupt comes two ticks of 32.768 kHz
// (61 us) before the reset and records where the program was (fault.hpp).
#pragma once

#include <cstdint>

namespace groma::nrf52832::watchdog {

inline constexpr std::uint32_t kPeriod_s = 8;

// Starts the watchdog with a whole period. It cannot be stopped until the next reset.
void start() noexcept;
void feed() noexcept;

}  // namespace groma::nrf52832::watchdog
