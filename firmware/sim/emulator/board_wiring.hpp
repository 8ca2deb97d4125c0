// Where the pins of an emulated nRF52832 lead to. The values are those of a board's datasheet or schematic:
// the model shares no code with the image, so that a wrong pin in either fails the run.
#pragma once

#include <array>
#include <optional>

#include "firmware/sim/emulator/spim.hpp"
#include "firmware/sim/emulator/uarte.hpp"

namespace groma::sim {

// Numbers of pins of P0.
struct BoardWiring {
  // A chip on an SPI bus, selected by a low level.
  struct Chip {
    SpimPins spi;
    unsigned select;
    unsigned interrupt;
  };

  Chip radio;  // its interrupt is active high
  unsigned radio_reset;
  std::optional<Chip> can;  // its interrupt is active low; nullopt: the board has no controller
  UartePins host;
  std::array<unsigned, 4> lights;  // red, second red, green, blue; a board with one red LED repeats it
  bool lights_active_low;
  bool slow_crystal;  // 32.768 kHz
};

inline constexpr BoardWiring kDwm1001{
    .radio = {.spi = {.sck = 16, .mosi = 20, .miso = 18}, .select = 17, .interrupt = 19},
    .radio_reset = 24,
    .can = BoardWiring::Chip{.spi = {.sck = 4, .mosi = 6, .miso = 7}, .select = 3, .interrupt = 27},
    .host = {.txd = 5, .rxd = 11},
    .lights = {14, 22, 30, 31},
    .lights_active_low = true,
    .slow_crystal = true};

}  // namespace groma::sim
