// The description of a board with an nRF52832 and a DW1000. A board's folder defines groma::board::kWiring in
// its board.hpp, which only the include path of that board's image finds.
#pragma once

#include <cstdint>
#include <initializer_list>
#include <optional>

namespace groma::nrf52832 {

// The number of a pin of port 0.
using Pin = std::uint32_t;
inline constexpr Pin kPins = 32;

// A set of pins: bit n is pin n.
using PinSet = std::uint32_t;

[[nodiscard]] constexpr PinSet pin_set(std::initializer_list<Pin> pins) noexcept {
  PinSet set = 0;
  for (const Pin pin : pins) set |= PinSet{1} << pin;
  return set;
}

// The pins of an SPI master. `out` is MOSI, `in` is MISO, `select` is active low.
struct SpiPins {
  Pin clock;
  Pin out;
  Pin in;
  Pin select;
};

// The DW1000.
struct RadioWiring {
  SpiPins spi;
  Pin interrupt;  // IRQ, active high
  Pin reset;      // RSTn; driven low or not at all, never high
  // WAKEUP, if it leads to a pin. It is held low: the firmware wakes the chip by the select line.
  std::optional<Pin> wake_up = std::nullopt;
};

// The serial line to the host, 1 Mbaud.
struct UartPins {
  Pin transmit;
  Pin receive;
};

// The MCP2518FD, with a 40 MHz oscillator.
struct CanWiring {
  SpiPins spi;
  Pin interrupt;  // INT, active low
};

// The LEDs by colour, which light together; an empty set where the board has none. leds.hpp has their
// meaning.
struct LedWiring {
  PinSet red = 0;
  PinSet green = 0;
  PinSet blue = 0;
  bool active_low = true;
};

// The source of the 32.768 kHz clock, which only the watchdog uses. The value of LFCLKSRC.
enum class SlowClock : std::uint32_t { kRc = 0, kCrystal = 1 };

struct Wiring {
  RadioWiring radio;
  UartPins uart;
  std::optional<CanWiring> can = std::nullopt;  // without it a node refuses a configuration with a CAN link
  LedWiring leds{};
  SlowClock slow_clock;
};

// Whether each pin exists and has one use. P0.00 and P0.01 belong to the 32.768 kHz crystal if there is one.
// P0.09 and P0.10 are the NFC antenna's: the image does not change UICR.NFCPINS.
[[nodiscard]] constexpr bool is_valid(const Wiring& wiring) noexcept {
  bool valid = true;
  PinSet used = pin_set({9, 10});
  if (wiring.slow_clock == SlowClock::kCrystal) used |= pin_set({0, 1});
  const auto use_all = [&](PinSet pins) {
    valid = valid && (used & pins) == 0;
    used |= pins;
  };
  const auto use = [&](std::initializer_list<Pin> pins) {
    for (const Pin pin : pins) {
      valid = valid && pin < kPins;
      if (valid) use_all(pin_set({pin}));
    }
  };
  const auto use_spi = [&](const SpiPins& spi) { use({spi.clock, spi.out, spi.in, spi.select}); };
  use_spi(wiring.radio.spi);
  use({wiring.radio.interrupt, wiring.radio.reset, wiring.uart.transmit, wiring.uart.receive});
  if (wiring.radio.wake_up) use({*wiring.radio.wake_up});
  if (wiring.can) {
    use_spi(wiring.can->spi);
    use({wiring.can->interrupt});
  }
  use_all(wiring.leds.red | wiring.leds.green | wiring.leds.blue);
  return valid;
}

}  // namespace groma::nrf52832
