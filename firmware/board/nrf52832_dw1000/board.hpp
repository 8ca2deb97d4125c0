// An nRF52832 and a DW1000 without a module: no CAN controller, no 32.768 kHz crystal, LEDs from pin to
// ground. Copy this folder for a board of your own.
#pragma once

#include "firmware/soc/nrf52832/wiring.hpp"

namespace groma::board {

inline constexpr nrf52832::Wiring kWiring{.radio = {.spi = {.clock = 12, .out = 13, .in = 15, .select = 14},
                                                    .interrupt = 16,
                                                    .reset = 11,
                                                    .wake_up = 17},
                                          .uart = {.transmit = 6, .receive = 8},
                                          .leds = {.red = nrf52832::pin_set({25}),
                                                   .green = nrf52832::pin_set({26}),
                                                   .blue = nrf52832::pin_set({27}),
                                                   .active_low = false},
                                          .slow_clock = nrf52832::SlowClock::kRc};

}  // namespace groma::board
