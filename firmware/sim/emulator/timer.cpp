#include "firmware/sim/emulator/timer.hpp"

#include <algorithm>

#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

enum : std::uint32_t {
  kTasksStart = 0x000,
  kTasksStop = 0x004,
  kTasksClear = 0x00C,
  kTasksCapture = 0x040,
  kShorts = 0x200,
  kMode = 0x504,
  kBitmode = 0x508,
  kPrescaler = 0x510,
  kCc = 0x540,
};

constexpr std::uint32_t kLargestPrescaler = 9;
constexpr unsigned kStopShorts = 8;  // COMPAREn_CLEAR at bit n, COMPAREn_STOP at bit 8 + n

}  // namespace

void Timer::reset() {
  events_ = EventRegisters{0x3FU << kFirstCompare};
  compare_ = {};
  match_at_.fill(kNever);
  next_match_ = kNever;
  running_ = false;
  since_ = 0;
  count_ = 0;
  shorts_ = 0;
  bit_mode_ = 0;
  prescaler_ = 4;
}

std::uint64_t Timer::period() const noexcept {
  constexpr std::array<unsigned, 4> kBits = {16, 8, 24, 32};
  return std::uint64_t{1} << kBits[bit_mode_];
}

std::uint64_t Timer::count(SimTime t) const noexcept {
  if (!running_) return count_;
  return (count_ + static_cast<std::uint64_t>((t - since_) / tick())) % period();
}

void Timer::hold(SimTime t, std::uint64_t count) noexcept {
  since_ = t;
  count_ = count;
  schedule_all(t);
}

// A compare register that equals the counter matches only after the counter has wrapped around.
void Timer::schedule(SimTime t, unsigned channel) noexcept {
  match_at_[channel] = kNever;
  if (running_) {
    const std::uint64_t now = count(t);
    const std::uint64_t ahead = (compare_[channel] + period() - now - 1) % period() + 1;
    // Whole ticks from the start of the present tick.
    const SimTime began = since_ + (t - since_) / tick() * tick();
    if (compare_[channel] < period()) match_at_[channel] = began + static_cast<SimTime>(ahead) * tick();
  }
  next_match_ = *std::min_element(match_at_.begin(), match_at_.end());
}

void Timer::schedule_all(SimTime t) noexcept {
  for (unsigned channel = 0; channel < kChannels; ++channel) schedule(t, channel);
}

void Timer::advance(SimTime t) {
  for (unsigned channel = 0; channel < kChannels; ++channel) {
    if (match_at_[channel] > t) continue;
    const SimTime at = match_at_[channel];
    events_.raise(kFirstCompare + channel);
    if ((shorts_ >> (kStopShorts + channel) & 1U) != 0) {
      count_ = compare_[channel];
      running_ = false;
    }
    if ((shorts_ >> channel & 1U) != 0) {
      hold(at, 0);
    } else if (running_) {
      schedule(at, channel);
    } else {
      hold(at, count_);
    }
  }
}

std::optional<std::uint32_t> Timer::read(SimTime, std::uint32_t offset) {
  switch (offset) {
    case kShorts:
      return shorts_;
    case kMode:
      return 0;
    case kBitmode:
      return bit_mode_;
    case kPrescaler:
      return prescaler_;
    default:
      if (offset >= kCc && offset < kCc + 4 * kChannels) return compare_[(offset - kCc) / 4];
      return events_.read(offset);
  }
}

bool Timer::write(SimTime t, std::uint32_t offset, std::uint32_t value) {
  const auto when_stopped = [&](const char* name) {
    if (running_) throw SimulationError(std::string("TIMER0: ") + name + " written while the timer runs");
  };
  switch (offset) {
    case kTasksStart:
      if (value == 0 || running_) return true;
      running_ = true;
      hold(t, count_);
      return true;
    case kTasksStop: {
      if (value == 0 || !running_) return true;
      const std::uint64_t now = count(t);
      running_ = false;
      hold(t, now);
      return true;
    }
    case kTasksClear:
      if (value != 0) hold(t, 0);
      return true;
    case kShorts:
      if ((value & ~0x3F3FU) != 0) throw SimulationError("TIMER0: SHORTS " + hexadecimal(value));
      shorts_ = value;
      return true;
    case kMode:
      if (value != 0) throw SimulationError("TIMER0: counter mode is not modelled");
      return true;
    case kBitmode:
      when_stopped("BITMODE");
      if (value > 3) throw SimulationError("TIMER0: BITMODE " + hexadecimal(value));
      bit_mode_ = value;
      return true;
    case kPrescaler:
      when_stopped("PRESCALER");
      if (value > kLargestPrescaler) throw SimulationError("TIMER0: PRESCALER " + hexadecimal(value));
      prescaler_ = value;
      return true;
    default:
      break;
  }
  if (offset >= kTasksCapture && offset < kTasksCapture + 4 * kChannels) {
    const unsigned channel = (offset - kTasksCapture) / 4;
    if (value != 0) compare_[channel] = static_cast<std::uint32_t>(count(t));
    schedule(t, channel);
    return true;
  }
  if (offset >= kCc && offset < kCc + 4 * kChannels) {
    const unsigned channel = (offset - kCc) / 4;
    compare_[channel] = value;
    schedule(t, channel);
    return true;
  }
  return events_.write(offset, value);
}

}  // namespace groma::sim
