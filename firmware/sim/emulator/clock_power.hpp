// CLOCK and POWER (0x40000000): crystals, reset reasons, retained registers.
#pragma once

#include <array>

#include "firmware/sim/emulator/peripheral.hpp"
#include "firmware/sim/emulator/silicon.hpp"

namespace groma::sim {

// RESETREAS (product specification 18.9.10). A power-on sets no bit.
enum class ResetCause : std::uint32_t {
  kPowerOn = 0,
  kPin = 1U << 0,
  kWatchdog = 1U << 1,
  kSoftware = 1U << 2,
  kLockup = 1U << 3,
};

class ClockPower final : public Peripheral {
 public:
  static constexpr SimTime kLfxoStart = 250 * kUnitsPerMillisecond;
  static constexpr SimTime kLfrcStart = 600 * kUnitsPerMicrosecond;
  // Anomaly 132: from a stop or reset to the next start.
  static constexpr SimTime kLfclkRestart = 330 * kUnitsPerMicrosecond;

  // `slow_crystal`: the board has a 32.768 kHz crystal; a start without it fails the run.
  explicit ClockPower(const SiliconQuirks& silicon, bool slow_crystal = true) noexcept
      : guards_restart_(silicon.lfclk_restart),
        hfxo_start_(silicon.hfxo_start),
        slow_crystal_(slow_crystal) {}

  // Registers that survive a soft reset keep their values; RESETREAS accumulates causes.
  void reset(ResetCause cause, SimTime t);

  [[nodiscard]] std::optional<std::uint32_t> read(SimTime t, std::uint32_t offset) override;
  [[nodiscard]] bool write(SimTime t, std::uint32_t offset, std::uint32_t value) override;
  [[nodiscard]] SimTime next_event() const noexcept override;
  void advance(SimTime t) override;
  [[nodiscard]] bool irq() const noexcept override { return events_.irq(); }

  // The high-frequency crystal runs, so timers and baud rates are exact.
  [[nodiscard]] bool crystal_runs() const noexcept { return hfxo_runs_; }

 private:
  static constexpr unsigned kHfclkStarted = 0;
  static constexpr unsigned kLfclkStarted = 1;

  bool guards_restart_;
  SimTime hfxo_start_;
  bool slow_crystal_;
  EventRegisters events_{1U << kHfclkStarted | 1U << kLfclkStarted};
  SimTime lfclk_stopped_at_ = 0;
  SimTime hfxo_at_ = kNever;
  SimTime lfclk_at_ = kNever;
  bool hfxo_requested_ = false;
  bool hfxo_runs_ = false;
  bool lfclk_requested_ = false;
  bool lfclk_runs_ = false;
  std::uint32_t lfclk_source_ = 0;       // LFCLKSRC
  std::uint32_t lfclk_source_copy_ = 0;  // LFCLKSRC when the clock was started
  std::uint32_t reset_reason_ = 0;
  std::uint32_t dcdc_ = 0;
  std::array<std::uint32_t, 2> retained_{};  // GPREGRET
  std::uint32_t approtect_ = 0;
};

}  // namespace groma::sim
