// The board's LEDs. Each indicator is a blink pattern.
//
//   kRadioFault    red, fast             kSearching  green, slow
//   kUnconfigured  blue, slow            kRanging    green, a short flash each second
//   kIdentify      all, fast
#pragma once

#include <cstdint>

#include "firmware/core/node/platform.hpp"

namespace groma::nrf52832 {

class Leds {
 public:
  void start() noexcept;
  void show(node::Indicator indicator, std::uint64_t now_us) noexcept;
  // Call at or after next_change_us().
  void update(std::uint64_t now_us) noexcept;
  [[nodiscard]] std::uint64_t next_change_us() const noexcept { return next_change_us_; }

 private:
  node::Indicator indicator_ = node::Indicator::kUnconfigured;
  bool lit_ = false;
  std::uint64_t next_change_us_ = 0;
};

}  // namespace groma::nrf52832
