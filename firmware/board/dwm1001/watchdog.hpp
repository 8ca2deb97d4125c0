// Resets the node when it has not been fed for kPeriod_s. Its interrupt comes two ticks of 32.768 kHz (61 us)
// before the reset and keeps where the program was (fault.hpp).
#pragma once

#include <cstdint>

namespace groma::dwm1001::watchdog {

inline constexpr std::uint32_t kPeriod_s = 8;

// Gives it a whole period; from here on it runs until the next reset.
void start() noexcept;
void feed() noexcept;

}  // namespace groma::dwm1001::watchdog
