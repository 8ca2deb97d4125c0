// WDT (0x40010000): once started, only a reset that includes it stops it.
#pragma once

#include <cstdint>

#include "firmware/sim/emulator/peripheral.hpp"

namespace groma::sim {

class Watchdog final : public Peripheral {
 public:
  // A tick of the 32.768 kHz clock, which the model derives from the processor's crystal.
  static constexpr SimTime kTick = kUnitsPerSecond / 32'768;

  // Called for a power-on, pin or watchdog reset; a soft reset or a lockup does not stop the watchdog.
  void reset();
  [[nodiscard]] bool running() const noexcept { return running_; }
  // The reset is due: two ticks after TIMEOUT if its interrupt is enabled, else with TIMEOUT.
  [[nodiscard]] bool bites() const noexcept { return bites_; }

  [[nodiscard]] std::optional<std::uint32_t> read(SimTime t, std::uint32_t offset) override;
  [[nodiscard]] bool write(SimTime t, std::uint32_t offset, std::uint32_t value) override;
  [[nodiscard]] SimTime next_event() const noexcept override;
  void advance(SimTime t) override;
  [[nodiscard]] bool irq() const noexcept override { return events_.irq(); }

 private:
  void reload(SimTime t) noexcept;

  EventRegisters events_{1};
  bool running_ = false;
  bool bites_ = false;
  SimTime timeout_at_ = kNever;
  SimTime reset_at_ = kNever;
  std::uint32_t reload_value_ = 0xFFFFFFFF;  // CRV
  std::uint32_t enabled_requests_ = 1;       // RREN
  std::uint32_t requested_ = 0;
  std::uint32_t configuration_ = 1;
};

}  // namespace groma::sim
