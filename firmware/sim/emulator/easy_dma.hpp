// EasyDMA: the memory that it reaches, RAM and nothing else, and its registers in a serial peripheral.
#pragma once

#include <cstdint>
#include <optional>
#include <span>

namespace groma::sim {

class EasyDma {
 public:
  explicit EasyDma(std::span<std::uint8_t> ram) noexcept : ram_(ram) {}

  // `count` bytes of RAM at `address`. Throws SimulationError that names the register where they are not all
  // in RAM, or more than the 8 bits of a MAXCNT register can say.
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

// RXD and TXD with PTR, MAXCNT and AMOUNT, which SPIM and UARTE have at the same offsets.
struct DmaRegisters {
  DmaBuffer receive;
  DmaBuffer transmit;

  // Nothing, or false: none of these registers. AMOUNT cannot be written.
  [[nodiscard]] std::optional<std::uint32_t> read(std::uint32_t offset) const noexcept;
  [[nodiscard]] bool write(std::uint32_t offset, std::uint32_t value) noexcept;
};

}  // namespace groma::sim
