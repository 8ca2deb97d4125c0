#include "firmware/sim/emulator/clock_power.hpp"

#include <algorithm>

#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

enum : std::uint32_t {
  kTasksHfclkstart = 0x000,
  kTasksHfclkstop = 0x004,
  kTasksLfclkstart = 0x008,
  kTasksLfclkstop = 0x00C,
  kHfclkrun = 0x408,
  kHfclkstat = 0x40C,
  kLfclkrun = 0x414,
  kLfclkstat = 0x418,
  kLfclksrccopy = 0x41C,
  kResetreas = 0x400,
  kGpregret = 0x51C,
  kGpregret2 = 0x520,
  kLfclksrc = 0x518,
  kApprotectDisable = 0x558,  // only in silicon revisions whose firmware opens the debug port
  kDcdcen = 0x578,
  kErratum108 = 0xEE4,  // RAM may lose its content in sleep unless FICR's value is copied here
};

constexpr std::uint32_t kStateRunning = 1U << 16;
constexpr std::uint32_t kSourceCrystal = 1;

}  // namespace

void ClockPower::reset(ResetCause cause, SimTime t) {
  events_ = EventRegisters{1U << kHfclkStarted | 1U << kLfclkStarted};
  lfclk_stopped_at_ = t;
  hfxo_at_ = lfclk_at_ = kNever;
  hfxo_requested_ = hfxo_runs_ = lfclk_requested_ = lfclk_runs_ = false;
  lfclk_source_ = lfclk_source_copy_ = 0;
  dcdc_ = 0;
  approtect_ = 0;
  if (cause == ResetCause::kPowerOn) reset_reason_ = 0;
  reset_reason_ |= static_cast<std::uint32_t>(cause);
  if (cause != ResetCause::kSoftware && cause != ResetCause::kLockup) retained_ = {};
}

std::optional<std::uint32_t> ClockPower::read(SimTime, std::uint32_t offset) {
  switch (offset) {
    case kHfclkrun:
      return hfxo_requested_ ? 1 : 0;
    case kHfclkstat:
      // The internal oscillator runs when the crystal does not.
      return hfxo_runs_ ? kStateRunning | kSourceCrystal : kStateRunning;
    case kLfclkrun:
      return lfclk_requested_ ? 1 : 0;
    case kLfclkstat:
      return lfclk_runs_ ? kStateRunning | lfclk_source_copy_ : 0;
    case kLfclksrccopy:
      return lfclk_source_copy_;
    case kLfclksrc:
      return lfclk_source_;
    case kResetreas:
      return reset_reason_;
    case kGpregret:
      return retained_[0];
    case kGpregret2:
      return retained_[1];
    case kDcdcen:
      return dcdc_;
    case kApprotectDisable:
      return approtect_;
    default:
      return events_.read(offset);
  }
}

bool ClockPower::write(SimTime t, std::uint32_t offset, std::uint32_t value) {
  switch (offset) {
    case kTasksHfclkstart:
      if (value == 0 || hfxo_requested_) return true;
      hfxo_requested_ = true;
      hfxo_at_ = t + hfxo_start_;
      return true;
    case kTasksHfclkstop:
      if (value == 0) return true;
      hfxo_requested_ = hfxo_runs_ = false;
      hfxo_at_ = kNever;
      return true;
    case kTasksLfclkstart:
      if (value == 0 || lfclk_requested_) return true;
      if (guards_restart_ && t - lfclk_stopped_at_ < kLfclkRestart)
        throw SimulationError("CLOCK: LFCLKSTART within 330 us of a reset or a stop (anomaly 132)");
      if (lfclk_source_ == kSourceCrystal && !slow_crystal_)
        throw SimulationError("CLOCK: LFCLKSTART by the crystal, which the board does not have");
      lfclk_requested_ = true;
      lfclk_source_copy_ = lfclk_source_;
      lfclk_at_ = t + (lfclk_source_ == kSourceCrystal ? kLfxoStart : kLfrcStart);
      return true;
    case kTasksLfclkstop:
      if (value == 0) return true;
      lfclk_requested_ = lfclk_runs_ = false;
      lfclk_at_ = kNever;
      lfclk_stopped_at_ = t;
      return true;
    case kLfclksrc:
      if (value > kSourceCrystal)
        throw SimulationError("CLOCK: LFCLKSRC " + hexadecimal(value) + " is not modelled");
      if (lfclk_requested_) throw SimulationError("CLOCK: LFCLKSRC written while the clock runs");
      lfclk_source_ = value;
      return true;
    case kResetreas:
      reset_reason_ &= ~value;
      return true;
    case kGpregret:
      retained_[0] = value & 0xFF;
      return true;
    case kGpregret2:
      retained_[1] = value & 0xFF;
      return true;
    case kDcdcen:
      dcdc_ = value & 1;
      return true;
    case kApprotectDisable:
      approtect_ = value;
      return true;
    case kErratum108:
      if (value != 0x4F)
        throw SimulationError("POWER: erratum 108 needs the bits of FICR 0x258, not " + hexadecimal(value));
      return true;
    default:
      return events_.write(offset, value);
  }
}

SimTime ClockPower::next_event() const noexcept {
  return std::min(hfxo_at_, lfclk_at_);
}

void ClockPower::advance(SimTime t) {
  if (hfxo_at_ <= t) {
    hfxo_at_ = kNever;
    hfxo_runs_ = true;
    events_.raise(kHfclkStarted);
  }
  if (lfclk_at_ <= t) {
    lfclk_at_ = kNever;
    lfclk_runs_ = true;
    events_.raise(kLfclkStarted);
  }
}

}  // namespace groma::sim
