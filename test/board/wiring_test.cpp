// The checks that the compiler makes of a board's description.
#include "firmware/soc/nrf52832/wiring.hpp"

#include <gtest/gtest.h>

namespace groma::nrf52832 {
namespace {

constexpr Wiring kPlain{
    .radio = {.spi = {.clock = 2, .out = 3, .in = 4, .select = 5}, .interrupt = 6, .reset = 7},
    .uart = {.transmit = 8, .receive = 11},
    .leds = {.red = pin_set({12}), .green = pin_set({13}), .blue = pin_set({31})},
    .slow_clock = SlowClock::kRc};
static_assert(is_valid(kPlain));

TEST(Wiring, RefusesAPinWithTwoUses) {
  Wiring wiring = kPlain;
  wiring.radio.reset = kPlain.radio.spi.select;
  EXPECT_FALSE(is_valid(wiring));
  wiring = kPlain;
  wiring.radio.wake_up = kPlain.uart.receive;
  EXPECT_FALSE(is_valid(wiring));
  wiring = kPlain;
  wiring.leds.blue = pin_set({30}) | pin_set({kPlain.radio.interrupt});
  EXPECT_FALSE(is_valid(wiring));
  wiring = kPlain;
  wiring.can = CanWiring{.spi = {.clock = 20, .out = 21, .in = 22, .select = 23}, .interrupt = 24};
  EXPECT_TRUE(is_valid(wiring));
  wiring.can->spi.in = kPlain.radio.spi.in;
  EXPECT_FALSE(is_valid(wiring));
}

TEST(Wiring, RefusesAPinThatTheChipDoesNotHave) {
  Wiring wiring = kPlain;
  wiring.uart.transmit = 32;
  EXPECT_FALSE(is_valid(wiring));
}

TEST(Wiring, RefusesThePinsOfNfcAndOfTheSlowCrystal) {
  Wiring wiring = kPlain;
  wiring.radio.interrupt = 10;
  EXPECT_FALSE(is_valid(wiring));
  wiring.radio.interrupt = 1;
  EXPECT_TRUE(is_valid(wiring));
  wiring.slow_clock = SlowClock::kCrystal;
  EXPECT_FALSE(is_valid(wiring));
}

TEST(Wiring, TakesABoardWithOneLedOrNone) {
  Wiring wiring = kPlain;
  wiring.leds = {.red = pin_set({12}), .green = pin_set({12}), .blue = pin_set({12})};
  EXPECT_TRUE(is_valid(wiring));
  wiring.leds = {};
  EXPECT_TRUE(is_valid(wiring));
}

}  // namespace
}  // namespace groma::nrf52832
