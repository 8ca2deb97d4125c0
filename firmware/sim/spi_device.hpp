// A chip at the end of an SPI bus, as the master's model drives it.
#pragma once

#include <cstdint>
#include <span>

#include "firmware/sim/time.hpp"

namespace groma::sim {

// World time throughout.
class SpiDevice {
 public:
  SpiDevice() = default;
  SpiDevice(const SpiDevice&) = delete;
  SpiDevice& operator=(const SpiDevice&) = delete;
  virtual ~SpiDevice() = default;

  // One chip-select window whose last bit passed at `end`; both spans have the same size.
  virtual void transfer(SimTime end, std::span<const std::uint8_t> mosi, std::span<std::uint8_t> miso,
                        std::uint32_t hz) = 0;
  virtual void advance(SimTime t) = 0;
  // The next instant at which something changes by itself.
  [[nodiscard]] virtual SimTime next_event() const = 0;
  // The interrupt is asserted, whatever level that is on the line.
  [[nodiscard]] virtual bool irq() const = 0;
};

}  // namespace groma::sim
