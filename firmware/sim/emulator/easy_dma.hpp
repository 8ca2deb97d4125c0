// EasyDMA: access to RAM, the only memory that it reaches, and its registers in a serial peripheral.
#pragma once

#include <cstdint>
#include <optional>
#include <span>

#include "firmware/sim/time.hpp"

namespace groma::sim {

// Anomaly 109: how long after the start of a transfer the processor must stay awake. No source states the
// time.
inline constexpr SimTime kDmaStart = 2 * kUnitsPerMicrosecond;

class EasyDma {
 public:
  explicit EasyDma(std::span<std::uint8_t> ram) noexcept : ram_(ram) {}

  // `count` bytes of RAM at `address`. Throws a SimulationError that names the register if they are not all
  // in RAM, or are more than the 255 of an 8-bit MAXCNT register.
  [[nodiscard]] std::span<std::uint8_t> at(std::uint32_t address, std::uint32_t count,
                                           const char* name) const;

 private:
  std::span<std::uint8_t> ram_;
};

struct DmaBuffer {
  std::uint32_t pointer = 0;
  std::uint32_t maximum = 0;
  std::uint32_t amount = 0;
};

// RXD and TXD with PTR, MAXCNT and AMOUNT; SPIM and UARTE have them at the same offsets.
struct DmaRegisters {
  DmaBuffer receive;
  DmaBuffer transmit;

  // nullopt, or false: not one of these registers. AMOUNT cannot be written.
  [[nodiscard]] std::optional<std::uint32_t> read(std::uint32_t offset) const noexcept;
  [[nodiscard]] bool write(std::uint32_t offset, std::uint32_t value) noexcept;
};

}  // namespace groma::sim
