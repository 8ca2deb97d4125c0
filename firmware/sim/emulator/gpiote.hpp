// GPIOTE (0x40006000): eight channels in event mode (edges). Task mode and PORT are not modelled.
#pragma once

#include <array>

#include "firmware/sim/emulator/peripheral.hpp"

namespace groma::sim {

class Gpiote final : public Peripheral {
 public:
  void reset();
  void level_changed(unsigned pin, bool high);

  [[nodiscard]] std::optional<std::uint32_t> read(SimTime t, std::uint32_t offset) override;
  [[nodiscard]] bool write(SimTime t, std::uint32_t offset, std::uint32_t value) override;
  [[nodiscard]] bool irq() const noexcept override { return events_.irq(); }

 private:
  static constexpr unsigned kChannels = 8;

  EventRegisters events_{(1U << kChannels) - 1};
  std::array<std::uint32_t, kChannels> configuration_{};
};

}  // namespace groma::sim
