#pragma once

#include <concepts>
#include <cstdint>
#include <span>

namespace groma::dw1000 {

// kSlow: at most 3 MHz, until the chip's PLL has locked, and for OTP, LDE and crystal trim. kFast: at most 20
// MHz.
enum class SpiSpeed : std::uint8_t { kSlow, kFast };

// The bus to one DW1000: mode 0, most significant bit first. Each call is one chip-select window and returns
// when the transfer is over. `header` is the chip's transaction header as sent, 1 to 3 bytes (user manual
// 2.2.1); the payload follows in the same window. select(true) pulls the chip-select line low without a
// transfer, select(false) releases it.
template <class S>
concept Spi = requires(S& spi, std::span<const std::uint8_t> header, std::span<const std::uint8_t> out,
                       std::span<std::uint8_t> in, SpiSpeed speed, bool low) {
  { spi.write(header, out) }
  noexcept->std::same_as<void>;
  { spi.read(header, in) }
  noexcept->std::same_as<void>;
  { spi.set_speed(speed) }
  noexcept->std::same_as<void>;
  { spi.select(low) }
  noexcept->std::same_as<void>;
};

}  // namespace groma::dw1000
