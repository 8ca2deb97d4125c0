// The Qorvo DWM1001 (its datasheet, table 2; the DWM1001-DEV's schematic for UART and LEDs).
#pragma once

#include "firmware/soc/nrf52832/wiring.hpp"

namespace groma::board {

inline constexpr nrf52832::Wiring kWiring{
    .radio = {.spi = {.clock = 16, .out = 20, .in = 18, .select = 17}, .interrupt = 19, .reset = 24},
    // To the on-board debugger's virtual serial port.
    .uart = {.transmit = 5, .receive = 11},
    // On the header.
    .can = nrf52832::CanWiring{.spi = {.clock = 4, .out = 6, .in = 7, .select = 3}, .interrupt = 27},
    .leds = {.red = nrf52832::pin_set({14, 22}),
             .green = nrf52832::pin_set({30}),
             .blue = nrf52832::pin_set({31})},
    .slow_clock = nrf52832::SlowClock::kCrystal};

}  // namespace groma::board
