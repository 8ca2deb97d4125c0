#include "firmware/soc/nrf52832/leds.hpp"

#include "board.hpp"
#include "firmware/soc/nrf52832/gpio.hpp"
#include "firmware/soc/nrf52832/registers.hpp"

namespace groma::nrf52832 {
namespace {

constexpr const LedWiring& kLeds = board::kWiring.leds;
constexpr PinSet kAll = kLeds.red | kLeds.green | kLeds.blue;
constexpr std::uint32_t kLight = kLeds.active_low ? gpio::kOutClear : gpio::kOutSet;
constexpr std::uint32_t kDarken = kLeds.active_low ? gpio::kOutSet : gpio::kOutClear;

struct Pattern {
  PinSet pins;
  std::uint32_t lit_us;
  std::uint32_t dark_us;
};

constexpr Pattern pattern_of(node::Indicator indicator) noexcept {
  constexpr Pattern kRadioFault{kLeds.red, 100'000, 100'000};
  switch (indicator) {
    case node::Indicator::kRadioFault:
      return kRadioFault;
    case node::Indicator::kUnconfigured:
      return {kLeds.blue, 500'000, 500'000};
    case node::Indicator::kSearching:
      return {kLeds.green, 250'000, 250'000};
    case node::Indicator::kRanging:
      return {kLeds.green, 50'000, 950'000};
    case node::Indicator::kIdentify:
      return {kAll, 100'000, 100'000};
  }
  return kRadioFault;
}

}  // namespace

void Leds::start() noexcept {
  gpio::kBlock[kDarken] = kAll;
  for (Pin led = 0; led < kPins; ++led) {
    if ((kAll & pin_set({led})) != 0) pin::configure(led, gpio::kOutput);
  }
}

void Leds::show(node::Indicator indicator, std::uint64_t now_us) noexcept {
  if (indicator == indicator_ && next_change_us_ != 0) return;
  indicator_ = indicator;
  lit_ = false;
  next_change_us_ = now_us;
  update(now_us);
}

void Leds::update(std::uint64_t now_us) noexcept {
  if (now_us < next_change_us_) return;
  const Pattern pattern = pattern_of(indicator_);
  lit_ = !lit_;
  gpio::kBlock[kDarken] = lit_ ? kAll & ~pattern.pins : kAll;
  if (lit_) gpio::kBlock[kLight] = pattern.pins;
  next_change_us_ = now_us + (lit_ ? pattern.lit_us : pattern.dark_us);
}

}  // namespace groma::nrf52832
