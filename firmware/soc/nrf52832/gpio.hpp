// The pins of port 0 as inputs and outputs.
#pragma once

#include <cstdint>

#include "firmware/soc/nrf52832/registers.hpp"
#include "firmware/soc/nrf52832/wiring.hpp"

namespace groma::nrf52832::pin {

inline void set(Pin pin) noexcept {
  gpio::kBlock[gpio::kOutSet] = pin_set({pin});
}

inline void clear(Pin pin) noexcept {
  gpio::kBlock[gpio::kOutClear] = pin_set({pin});
}

[[nodiscard]] inline bool is_high(Pin pin) noexcept {
  return (gpio::kBlock[gpio::kIn] & pin_set({pin})) != 0;
}

// `configuration`: gpio::kOutput, kInput, ...
inline void configure(Pin pin, std::uint32_t configuration) noexcept {
  gpio::kBlock[gpio::kPinConfig + 4 * pin] = configuration;
}

}  // namespace groma::nrf52832::pin
