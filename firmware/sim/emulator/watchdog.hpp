// WDT (0x40010000): once started nothing but a reset that includes it stops it.
#pragma once

#include <cstdint>

#include "firmware/sim/emulator/peripheral.hpp"

namespace groma::sim {

class Watchdog final : public Peripheral {
 public:
  // A tick of the 32.768 kHz clock, which is taken to run by the processor's crystal.
  static constexpr SimTime kTick = kUnitsPerSecond / 32'768;

  // By a power-on, pin or watchdog reset; a soft reset or a lockup leaves it running.
  void reset();
  [[nodiscard]] bool running() const noexcept { return running_; }
  // The reset has come: two ticks after TIMEOUT where its interrupt is enabled, else with it.
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
