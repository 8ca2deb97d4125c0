// The DW1000 as an SPI device with a reset line.
#pragma once

#include "firmware/sim/dw1000_chip.hpp"
#include "firmware/sim/spi_device.hpp"

namespace groma::sim {

class RadioDevice final : public SpiDevice {
 public:
  explicit RadioDevice(Dw1000Chip& chip) noexcept : chip_(chip) {}

  void transfer(SimTime end, std::span<const std::uint8_t> mosi, std::span<std::uint8_t> miso,
                std::uint32_t hz) override;
  void select(SimTime t, bool low) override { chip_.select(t, low); }
  void advance(SimTime t) override { chip_.advance(t); }
  [[nodiscard]] SimTime next_event() const override { return chip_.next_event(); }
  [[nodiscard]] bool irq() const override { return !held_ && chip_.irq(); }

  // The reset line is pulled low, and released.
  void hold_in_reset(SimTime t);
  void release_reset(SimTime t);

 private:
  Dw1000Chip& chip_;
  bool held_ = false;
};

}  // namespace groma::sim
