#include "host/daemon/robot_clock.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <utility>

namespace groma::daemon {
namespace {

// TimeMapper sees the robot's clock as a counter in nanoseconds.
constexpr double kTicksPerSecond = 1e9;
// Whether t_s fits 64 bits in nanoseconds.
bool fits(double t_s) noexcept {
  constexpr double kMaxTime_s = 9e9;
  return std::abs(t_s) <= kMaxTime_s;
}

std::int64_t ticks_at(double t_s) noexcept {
  return std::llround(t_s * kTicksPerSecond);
}

// Whether the rate is near a power of 1000: ms, us or ns instead of seconds, or the reverse.
bool is_unit(double rate) noexcept {
  if (!(rate > 0.0)) return false;
  constexpr double kNear = 0.2;  // decades
  const double decades = std::log10(rate);
  const double power = 3.0 * std::round(decades / 3.0);
  return power != 0.0 && std::abs(decades - power) < kNear;
}

// Of a t_s that runs at this rate.
std::string_view unit_of(double rate) {
  switch (std::lround(std::log10(rate))) {
    case 3:
      return ", as in milliseconds";
    case 6:
      return ", as in microseconds";
    case 9:
      return ", as in nanoseconds";
    default:
      return "";
  }
}

}  // namespace

const char* cause_name(TimestampFault::Cause cause) noexcept {
  return cause == TimestampFault::Cause::kTimeUnit ? "time-unit" : "clock-offset";
}

std::string evidence(const TimestampFault& fault) {
  if (fault.cause == TimestampFault::Cause::kTimeUnit) {
    return fmt::format("t_s of odometry runs {:.3g} times as fast as this computer's clock{}", fault.value,
                       unit_of(fault.value));
  }
  const double by_s = std::abs(fault.value);
  constexpr double kLong_s = 1e6;
  return fmt::format("t_s of odometry was {} s {} the robot's clock",
                     by_s < kLong_s ? fmt::format("{:.3f}", by_s) : fmt::format("{:.3g}", by_s),
                     fault.value > 0.0 ? "ahead of" : "behind");
}

std::string_view remedy(const TimestampFault& fault) noexcept {
  if (fault.cause == TimestampFault::Cause::kTimeUnit) return "send t_s in seconds";
  return "take t_s of all messages from one clock that is not set while it runs";
}

RobotClock::RobotClock(const RobotClockConfig& config) : config_(config), mapper_(kTicksPerSecond) {}

std::optional<double> RobotClock::robot_time_s(double host_s) const noexcept {
  const auto ticks = mapper_.to_ticks(host_s);
  if (!ticks) return std::nullopt;
  return static_cast<double>(*ticks) / kTicksPerSecond;
}

bool RobotClock::suspected() const noexcept {
  return run_.alike >= kSuspectRun || run_.samples >= kRun || early_ >= kSuspectRun ||
         far_.samples >= kSuspectRun || is_late();
}

Timestamp RobotClock::judge(double t_s, double now_s) noexcept {
  if (!std::isfinite(t_s) || !fits(t_s)) step_run_ = {};
  if (!std::isfinite(t_s)) return Timestamp::kWrong;
  const std::optional<double> expected_s = robot_time_s(now_s);
  if (!fits(t_s)) return judge_far(t_s, now_s, t_s - expected_s.value_or(0.0));
  if (!expected_s) {
    begin(t_s, now_s);
    return Timestamp::kGood;
  }
  const double offset_s = t_s - *expected_s;
  if (shows_step(t_s, now_s, offset_s)) return step(t_s, now_s, offset_s);
  if (std::abs(offset_s) > config_.max_error_s) return judge_far(t_s, now_s, offset_s);
  far_ = {};

  if (last_s_ && t_s <= *last_s_) return judge_fallen_back(t_s, now_s, offset_s);
  const bool continues_run = run_.samples > 0 && std::abs(offset_s - run_.offset_s) <= kAgree_s;
  if (offset_s < -kConsistent_s && continues_run) return judge_fallen_back(t_s, now_s, offset_s);

  switch (mapper_.observe(ticks_at(t_s), now_s, 0.0)) {
    case clock::Observation::kRestarted:
      return step(t_s, now_s, offset_s);
    case clock::Observation::kEarly:
      if (offset_s <= kSlack_s) return Timestamp::kGood;
      ++early_;
      fault_ = {TimestampFault::Cause::kClockOffset, offset_s, now_s};
      return Timestamp::kEarly;
    case clock::Observation::kTaken:
      break;
  }
  early_ = 0;
  last_s_ = t_s;
  if (offset_s >= -kConsistent_s) run_ = {};
  watch_delay(now_s, offset_s);
  return Timestamp::kGood;
}

bool RobotClock::shows_step(double t_s, double now_s, double offset_s) noexcept {
  const double since_s = now_s - std::exchange(arrived_s_, now_s);
  jitter_s_ *= std::exp(-std::max(since_s, 0.0) / kForget_s);
  const bool is_good =
      offset_s >= -config_.max_error_s && offset_s <= kSlack_s && !(last_s_ && t_s <= *last_s_);
  if (is_good) jitter_s_ = std::max(jitter_s_, -offset_s);
  if (is_good || std::abs(offset_s) <= kSlack_s + jitter_s_) {
    step_run_ = {};
    return false;
  }
  const bool agrees =
      step_run_.samples > 0 && std::abs(offset_s - step_run_.offset_s) <= kAgree_s && t_s > step_run_.last_s;
  if (!agrees) step_run_ = {.offset_s = offset_s, .is_steady = since_s <= kLongestPause_s};
  ++step_run_.samples;
  step_run_.last_s = t_s;
  return step_run_.samples >= kStepRun && step_run_.is_steady;
}

void RobotClock::begin(double t_s, double now_s) noexcept {
  mapper_.reset();
  mapper_.observe(ticks_at(t_s), now_s, 0.0);
  last_s_ = t_s;
  run_ = {};
  far_ = {};
  step_run_ = {};
  arrived_s_ = now_s;
  jitter_s_ = 0.0;
  early_ = 0;
  late_alike_ = 0;
  on_time_s_ = now_s;
  behind_ = false;
}

Timestamp RobotClock::judge_far(double t_s, double now_s, double offset_s) noexcept {
  if (far_.samples++ == 0) {
    far_.t_s = t_s;
    far_.since_s = now_s;
  }
  if (!fault_ || fault_->cause != TimestampFault::Cause::kTimeUnit || far_.samples == 1) {
    fault_ = {TimestampFault::Cause::kClockOffset, offset_s, now_s};
  }
  fault_->last_s = now_s;
  const double for_s = now_s - far_.since_s;
  if (for_s < config_.set_after_s || far_.samples < kRun) return Timestamp::kWrong;
  const double rate = (t_s - far_.t_s) / for_s;
  if (fits(t_s) && rate > 1.0 / kMaxRate && rate < kMaxRate) {
    fault_ = {TimestampFault::Cause::kClockOffset, offset_s, now_s};
    begin(t_s, now_s);
    return Timestamp::kSet;
  }
  // No clock runs at this rate, so do not follow it. A stalled link looks alike, except at the rate of a unit
  // error.
  if (is_unit(rate)) fault_ = {TimestampFault::Cause::kTimeUnit, rate, now_s};
  far_ = {.samples = kRun, .t_s = t_s, .since_s = now_s};
  return Timestamp::kWrong;
}

Timestamp RobotClock::judge_fallen_back(double t_s, double now_s, double offset_s) noexcept {
  // A repeated or overtaken sample: the clock has not changed.
  if (offset_s >= -kConsistent_s) return Timestamp::kFallenBack;
  if (run_.samples++ == 0) run_.since_s = now_s;
  if (run_.samples == 1 || std::abs(offset_s - run_.offset_s) > kAgree_s) {
    run_.alike = 0;
    run_.offset_s = offset_s;
  }
  ++run_.alike;
  fault_ = {TimestampFault::Cause::kClockOffset, offset_s, now_s};
  // Offsets of samples that arrive in bursts do not agree. But without a clock step the last sample of each
  // burst would fit and end the run; so a run that lasts shows a step.
  const bool lasts = run_.samples >= kRun && now_s - run_.since_s >= config_.set_after_s;
  if (run_.alike < kRun && !lasts) return Timestamp::kFallenBack;
  return step(t_s, now_s, offset_s);
}

Timestamp RobotClock::step(double t_s, double now_s, double by_s) noexcept {
  step_s_ = by_s;
  // Otherwise a run of dropped samples has shown the step.
  step_found_late_ = by_s < 0.0 && run_.alike < kRun && step_run_.samples < kStepRun;
  fault_ = {TimestampFault::Cause::kClockOffset, by_s, now_s};
  begin(t_s, now_s);
  return Timestamp::kStepped;
}

void RobotClock::watch_delay(double now_s, double offset_s) noexcept {
  delay_s_ = -offset_s;
  if (offset_s >= -kLateAlike_s) {
    late_alike_ = 0;
  } else if (late_alike_ == 0 || std::abs(-offset_s - late_by_s_) > kAgree_s) {
    late_alike_ = 1;
    late_by_s_ = -offset_s;
  } else {
    ++late_alike_;
  }
  if (offset_s >= -kBehind_s) on_time_s_ = now_s;
  behind_ = now_s - on_time_s_ > kBehindFor_s;
  if (is_late()) fault_ = {TimestampFault::Cause::kClockOffset, offset_s, now_s};
}

}  // namespace groma::daemon
