// Estimates the robot's clock from the t_s of its odometry and the arrival time of each sample. It decides
// which timestamps fit that clock, which ones are wrong, and when the clock was set.
//
// The link is a FIFO that delays: it makes a sample late, never early, and keeps the order. So the link
// does not explain a timestamp that is early or falls back. A single such timestamp is wrong. A run of them
// with the same offset, without a fitting sample between them, shows that the clock was set. kStepRun are
// enough while samples keep coming; after a pause the robot may have restarted elsewhere.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <string_view>

#include "host/clock/time_mapper.hpp"

namespace groma::daemon {

struct RobotClockConfig {
  // A t_s further from the clock than this is wrong ...
  double max_error_s = 1.0;
  // ... unless all are, for this long: then the clock was set.
  double set_after_s = 1.0;
};

// The judgement of one sample's timestamp.
enum class Timestamp : std::uint8_t {
  kGood,
  kEarly,       // ahead of the clock: drop the sample
  kFallenBack,  // not newer than a good one before, or in a run that fell back: drop the sample
  kWrong,       // off by more than max_error_s: drop the sample
  kStepped,     // the clock was set by step_s() while the robot went on; waiting() samples before fit it too
  kSet,         // the clock was set, or the robot restarted
};

// A fault of the robot's timestamps; causes as in a diagnosis.
struct TimestampFault {
  enum class Cause : std::uint8_t { kClockOffset, kTimeUnit };
  Cause cause = Cause::kClockOffset;
  double value =
      0.0;  // clock-offset: s, positive: ahead of the clock; time-unit: rate of t_s over the host's clock
  double last_s = 0.0;  // host time
};

// "clock-offset", "time-unit".
[[nodiscard]] const char* cause_name(TimestampFault::Cause cause) noexcept;
// For the user: what shows the fault, and what to do.
[[nodiscard]] std::string evidence(const TimestampFault& fault);
[[nodiscard]] std::string_view remedy(const TimestampFault& fault) noexcept;

// Reads no clock, allocates nothing.
class RobotClock {
 public:
  // A t_s that is ahead by at most this is accepted without moving the clock: software timestamps jitter.
  static constexpr double kSlack_s = 0.06;
  static constexpr std::uint32_t kStepRun = 3;  // if they are off by more than the link's jitter and kSlack_s
  static constexpr double kLongestPause_s = 0.5;  // in arrivals
  static constexpr double kForget_s = 10.0;
  static constexpr std::uint32_t kRun = clock::TimeMapper::kJumpMessages;
  static constexpr std::uint32_t kSuspectRun = 3;  // misfitting samples that raise suspicion
  static constexpr double kConsistent_s =
      0.02;  // a sample at most this late shows that the clock was not set
  static constexpr double kAgree_s = clock::TimeMapper::kAgree_s;
  static constexpr double kLateAlike_s = 0.05;  // kRun samples equally late by more than this: suspicion
  static constexpr double kBehind_s = 0.2;      // every sample later than this ...
  static constexpr double kBehindFor_s = 1.0;   // ... for this long: the input is behind
  static constexpr double kMaxRate = 4.0;       // a t_s this many times faster or slower is not a clock

  explicit RobotClock(const RobotClockConfig& config = {});

  // Judges an odometry sample that arrives at now_s (host time); call in the order of arrival.
  Timestamp judge(double t_s, double now_s) noexcept;

  // Host time to robot time; nothing before the first sample.
  [[nodiscard]] std::optional<double> robot_time_s(double host_s) const noexcept;

  // Samples that were judged as wrong, and that the next ones may show to be of a clock that was set.
  [[nodiscard]] std::uint32_t waiting() const noexcept { return step_run_.samples; }
  // After kStepped: the new clock less the old one.
  [[nodiscard]] double step_s() const noexcept { return step_s_; }
  // After kStepped: whether samples of the new clock had been taken as good before the step was found.
  [[nodiscard]] bool step_found_late() const noexcept { return step_found_late_; }
  // A clock step is likely, or the input is behind: do not rely on poses.
  [[nodiscard]] bool suspected() const noexcept;
  [[nodiscard]] bool is_late() const noexcept { return late_alike_ >= kRun || behind_; }
  // How late the last good sample was; negative: early.
  [[nodiscard]] double delay_s() const noexcept { return delay_s_; }
  // The last wrong timestamp or clock step.
  [[nodiscard]] const std::optional<TimestampFault>& fault() const noexcept { return fault_; }

 private:
  // Consecutive samples that do not fit the clock.
  struct Run {
    std::uint32_t samples = 0;  // all
    std::uint32_t alike = 0;    // the last ones, whose offsets agree
    double offset_s = 0.0;      // of the first of the latter
    double since_s = 0.0;       // host time
  };
  struct Far {
    std::uint32_t samples = 0;
    double t_s = 0.0;
    double since_s = 0.0;
  };

  // The last samples, whose offsets agree and do not fit the clock.
  struct StepRun {
    std::uint32_t samples = 0;
    double offset_s = 0.0;   // of the first
    double last_s = 0.0;     // t_s
    bool is_steady = false;  // without a pause before the first
  };

  void begin(double t_s, double now_s) noexcept;
  // Whether the sample completes a run that shows a clock step.
  [[nodiscard]] bool shows_step(double t_s, double now_s, double offset_s) noexcept;
  Timestamp judge_far(double t_s, double now_s, double offset_s) noexcept;
  Timestamp judge_fallen_back(double t_s, double now_s, double offset_s) noexcept;
  Timestamp step(double t_s, double now_s, double by_s) noexcept;
  void watch_delay(double now_s, double offset_s) noexcept;

  RobotClockConfig config_;
  clock::TimeMapper mapper_;
  std::optional<double> last_s_;  // robot time of the newest sample that fits the clock
  Run run_;
  Far far_;
  StepRun step_run_;
  double arrived_s_ = 0.0;        // host time of the last sample
  double jitter_s_ = 0.0;         // the largest delay of good samples, forgotten within kForget_s
  std::uint32_t early_ = 0;       // in a row
  std::uint32_t late_alike_ = 0;  // in a row
  double late_by_s_ = 0.0;
  double on_time_s_ = 0.0;  // host time
  double delay_s_ = 0.0;
  bool behind_ = false;
  double step_s_ = 0.0;
  bool step_found_late_ = false;
  std::optional<TimestampFault> fault_;
};

}  // namespace groma::daemon
