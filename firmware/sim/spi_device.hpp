// A chip on an SPI bus, driven by the model of the bus master.
#pragma once

#include <cstdint>
#include <span>

#include "firmware/sim/time.hpp"

namespace groma::sim {

// All times are world time.
class SpiDevice {
 public:
  SpiDevice() = default;
  SpiDevice(const SpiDevice&) = delete;
  SpiDevice& operator=(const SpiDevice&) = delete;
  virtual ~SpiDevice() = default;

  // One chip-select window whose last bit ends at `end`. Both spans have the same size. hz: the SPI clock.
  virtual void transfer(SimTime end, std::span<const std::uint8_t> mosi, std::span<std::uint8_t> miso,
                        std::uint32_t hz) = 0;
  // The select line is pulled low or released. Only for chips that it wakes.
  virtual void select(SimTime /*t*/, bool /*low*/) {}
  virtual void advance(SimTime t) = 0;
  // The next internal event, or kNever.
  [[nodiscard]] virtual SimTime next_event() const = 0;
  // The interrupt is asserted; the line's level depends on its polarity.
  [[nodiscard]] virtual bool irq() const = 0;
};

}  // namespace groma::sim
