#include "firmware/board/dwm1001/leds.hpp"

#include "firmware/board/dwm1001/nrf52832.hpp"
#include "firmware/board/dwm1001/pins.hpp"

namespace groma::dwm1001 {
namespace {

namespace gpio = nrf52832::gpio;

constexpr std::uint32_t kRed = pin::mask(pin::kLedRed) | pin::mask(pin::kLedRed2);
constexpr std::uint32_t kGreen = pin::mask(pin::kLedGreen);
constexpr std::uint32_t kBlue = pin::mask(pin::kLedBlue);
constexpr std::uint32_t kAll = kRed | kGreen | kBlue;

struct Pattern {
  std::uint32_t pins;
  std::uint32_t lit_us;
  std::uint32_t dark_us;
};

constexpr Pattern pattern_of(node::Indicator indicator) noexcept {
  constexpr Pattern kRadioFault{kRed, 100'000, 100'000};
  switch (indicator) {
    case node::Indicator::kRadioFault:
      return kRadioFault;
    case node::Indicator::kUnconfigured:
      return {kBlue, 500'000, 500'000};
    case node::Indicator::kSearching:
      return {kGreen, 250'000, 250'000};
    case node::Indicator::kRanging:
      return {kGreen, 50'000, 950'000};
    case node::Indicator::kIdentify:
      return {kAll, 100'000, 100'000};
  }
  return kRadioFault;
}

}  // namespace

void Leds::start() noexcept {
  gpio::kBlock[gpio::kOutSet] = kAll;
  for (const std::uint32_t led : {pin::kLedRed, pin::kLedRed2, pin::kLedGreen, pin::kLedBlue}) {
    pin::configure(led, gpio::kOutput);
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
  gpio::kBlock[gpio::kOutSet] = lit_ ? kAll & ~pattern.pins : kAll;
  if (lit_) gpio::kBlock[gpio::kOutClear] = pattern.pins;
  next_change_us_ = now_us + (lit_ ? pattern.lit_us : pattern.dark_us);
}

}  // namespace groma::dwm1001
