// The DWM1001's pins, all of port 0 (DWM1001 datasheet, table 2; DWM1001-DEV schematic for the LEDs).
#pragma once

#include <array>
#include <cstdint>

#include "firmware/board/dwm1001/nrf52832.hpp"

namespace groma::dwm1001::pin {

// DW1000
inline constexpr std::uint32_t kRadioClock = 16;
inline constexpr std::uint32_t kRadioSelect = 17;
inline constexpr std::uint32_t kRadioIn = 18;
inline constexpr std::uint32_t kRadioOut = 20;
inline constexpr std::uint32_t kRadioInterrupt = 19;  // active high
inline constexpr std::uint32_t kRadioReset = 24;      // driven low or not at all, never high

// UART to the on-board debugger's virtual serial port
inline constexpr std::uint32_t kUartTransmit = 5;
inline constexpr std::uint32_t kUartReceive = 11;

// MCP2518FD on the header
inline constexpr std::uint32_t kCanSelect = 3;
inline constexpr std::uint32_t kCanClock = 4;
inline constexpr std::uint32_t kCanOut = 6;
inline constexpr std::uint32_t kCanIn = 7;
inline constexpr std::uint32_t kCanInterrupt = 27;  // active low

// LEDs, active low
inline constexpr std::uint32_t kLedRed = 14;
inline constexpr std::uint32_t kLedRed2 = 22;
inline constexpr std::uint32_t kLedGreen = 30;
inline constexpr std::uint32_t kLedBlue = 31;

[[nodiscard]] constexpr std::uint32_t mask(std::uint32_t pin) noexcept {
  return std::uint32_t{1} << pin;
}

inline void set(std::uint32_t pin) noexcept {
  nrf52832::gpio::kBlock[nrf52832::gpio::kOutSet] = mask(pin);
}

inline void clear(std::uint32_t pin) noexcept {
  nrf52832::gpio::kBlock[nrf52832::gpio::kOutClear] = mask(pin);
}

[[nodiscard]] inline bool is_high(std::uint32_t pin) noexcept {
  return (nrf52832::gpio::kBlock[nrf52832::gpio::kIn] & mask(pin)) != 0;
}

// `configuration`: gpio::kOutput, kInput, ...
inline void configure(std::uint32_t pin, std::uint32_t configuration) noexcept {
  nrf52832::gpio::kBlock[nrf52832::gpio::kPinConfig + 4 * pin] = configuration;
}

}  // namespace groma::dwm1001::pin
