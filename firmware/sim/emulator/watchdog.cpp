#include "firmware/sim/emulator/watchdog.hpp"

#include <algorithm>

#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

enum : std::uint32_t {
  kTasksStart = 0x000,
  kRunstatus = 0x400,
  kReqstatus = 0x404,
  kCrv = 0x504,
  kRren = 0x508,
  kConfig = 0x50C,
  kRr = 0x600,
};

constexpr unsigned kTimeout = 0;
constexpr unsigned kRequests = 8;
constexpr std::uint32_t kReloadKey = 0x6E524635;
constexpr std::uint32_t kRunsInSleep = 1U << 0;
constexpr std::uint32_t kRunsInHalt = 1U << 3;
constexpr SimTime kTicksToReset = 2;

}  // namespace

void Watchdog::reset() {
  events_ = EventRegisters{1};
  running_ = bites_ = false;
  timeout_at_ = reset_at_ = kNever;
  reload_value_ = 0xFFFFFFFF;
  enabled_requests_ = 1;
  requested_ = 0;
  configuration_ = 1;
}

void Watchdog::reload(SimTime t) noexcept {
  requested_ = 0;
  timeout_at_ = t + (SimTime{reload_value_} + 1) * kTick;
}

SimTime Watchdog::next_event() const noexcept {
  return std::min(timeout_at_, reset_at_);
}

void Watchdog::advance(SimTime t) {
  if (timeout_at_ <= t) {
    const SimTime at = timeout_at_;
    timeout_at_ = kNever;
    events_.raise(kTimeout);
    reset_at_ = events_.enabled() != 0 ? at + kTicksToReset * kTick : at;
  }
  if (reset_at_ <= t) {
    reset_at_ = kNever;
    bites_ = true;
  }
}

std::optional<std::uint32_t> Watchdog::read(SimTime, std::uint32_t offset) {
  switch (offset) {
    case kRunstatus:
      return running_ ? 1 : 0;
    case kReqstatus:
      return enabled_requests_ & ~requested_;
    case kCrv:
      return reload_value_;
    case kRren:
      return enabled_requests_;
    case kConfig:
      return configuration_;
    default:
      return events_.read(offset);
  }
}

bool Watchdog::write(SimTime t, std::uint32_t offset, std::uint32_t value) {
  switch (offset) {
    case kTasksStart:
      if (value == 0 || running_) return true;
      running_ = true;
      reload(t);
      return true;
    // These registers are locked while the watchdog runs.
    case kCrv:
      if (value < 0xF) throw SimulationError("WDT: CRV is at least 15");
      if (!running_) reload_value_ = value;
      return true;
    case kRren:
      if (!running_) enabled_requests_ = value & 0xFF;
      return true;
    case kConfig:
      if ((value & kRunsInSleep) == 0)
        throw SimulationError("WDT: a watchdog that pauses while the processor sleeps is not modelled");
      if (!running_) configuration_ = value & (kRunsInSleep | kRunsInHalt);
      return true;
    default:
      break;
  }
  if (offset >= kRr && offset < kRr + 4 * kRequests) {
    if (value != kReloadKey || !running_ || timeout_at_ == kNever) return true;
    requested_ |= 1U << ((offset - kRr) / 4);
    if ((enabled_requests_ & ~requested_) == 0) reload(t);
    return true;
  }
  return events_.write(offset, value);
}

}  // namespace groma::sim
