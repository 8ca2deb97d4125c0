// The memory that EasyDMA reaches: RAM, and nothing else.
#pragma once

#include <cstdint>
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

}  // namespace groma::sim
