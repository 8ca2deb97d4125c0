// An SPI master with EasyDMA: mode 0, most significant bit first, chip select by GPIO.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

#include "firmware/soc/nrf52832/registers.hpp"
#include "firmware/soc/nrf52832/wiring.hpp"

namespace groma::nrf52832 {

// Values of the FREQUENCY register.
enum class SpiFrequency : std::uint32_t { k2MHz = 0x2000'0000, k4MHz = 0x4000'0000, k8MHz = 0x8000'0000 };

class Spim {
 public:
  // EasyDMA's limit for one transfer, bytes.
  static constexpr std::size_t kMaxTransfer = 255;

  // `base`: spim::kBase1 or kBase2.
  constexpr Spim(std::uint32_t base, const SpiPins& pins) noexcept : registers_(base), pins_(pins) {}

  // Configures pins and controller and deselects the chip.
  void start(SpiFrequency frequency) noexcept;
  void set_frequency(SpiFrequency frequency) noexcept;

  // One chip-select window of the longer of the two sizes. Sends `out`, then zeros; receives `in` from the
  // first byte on. Returns at the end; interrupts are served. Both spans are in RAM, may be the same bytes,
  // and have at most kMaxTransfer bytes. Not for a single received byte, for which the chip clocks two
  // (erratum 58).
  void transfer(std::span<const std::uint8_t> out, std::span<std::uint8_t> in) noexcept;
  // Pulls the select line low without a transfer, or releases it.
  void select(bool low) noexcept;

 private:
  Block registers_;
  SpiPins pins_;
};

}  // namespace groma::nrf52832
