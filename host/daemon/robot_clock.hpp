// The robot's clock, by the t_s of its odometry and the time at which each sample arrives. It decides which
// timestamps fit that clock, which ones are wrong, and when the clock was set.
//
// The link is a FIFO that delays: it makes a sample late, never early, and it does not change the order. So a
// timestamp that is early, or that falls back, is not the link's doing. A single one is wrong; a run of them
// that agree on their offset, without a sample that fits between them, shows a clock that was set.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <string_view>

#include "host/clock/time_mapper.hpp"

namespace groma::daemon {

struct RobotClockConfig {
  // A t_s further from the clock than this is wrong, unless ...
  double max_error_s = 1.0;
  // ... all of them are so for this long: then the clock was set.
  double set_after_s = 1.0;
};

// What a sample's timestamp is.
enum class Timestamp : std::uint8_t {
  kGood,
  kEarly,       // ahead of the clock: drop the sample
  kFallenBack,  // not newer than a good one before, or of a run that fell back: drop the sample
  kWrong,       // further off than max_error_s: drop the sample
  kStepped,     // the clock was set by step_s(), no more than max_error_s; the sample is the first of the new
                // one
  kSet,         // the clock was set by more, or the robot restarted
};

// What is wrong with the robot's timestamps; causes by the names of a diagnosis.
struct TimestampFault {
  enum class Cause : std::uint8_t { kClockOffset, kTimeUnit };
  Cause cause = Cause::kClockOffset;
  double value =
      0.0;  // clock-offset: s, positive ahead of the clock; time-unit: rate of t_s by the host's clock
  double last_s = 0.0;  // host time
};

// "clock-offset", "time-unit".
[[nodiscard]] const char* cause_name(TimestampFault::Cause cause) noexcept;
// For a human: what shows it, and what to do.
[[nodiscard]] std::string evidence(const TimestampFault& fault);
[[nodiscard]] std::string_view remedy(const TimestampFault& fault) noexcept;

// Reads no clock, allocates nothing.
class RobotClock {
 public:
  // A t_s that is ahead by no more is taken, though it does not move the clock: software stamps unevenly.
  static constexpr double kSlack_s = 0.06;
  static constexpr std::uint32_t kRun = clock::TimeMapper::kJumpMessages;
  static constexpr std::uint32_t kSuspectRun = 3;  // odd samples that raise suspicion
  static constexpr double kConsistent_s =
      0.02;  // a sample no later than this shows that the clock is as before
  static constexpr double kAgree_s = clock::TimeMapper::kAgree_s;
  static constexpr double kLateAlike_s = 0.05;  // kRun samples that are this late alike raise suspicion
  static constexpr double kBehind_s = 0.2;      // no sample less late than this ...
  static constexpr double kBehindFor_s = 1.0;   // ... for so long: the input is behind
  static constexpr double kMaxRate = 4.0;       // a t_s that runs this much faster or slower is no clock's

  explicit RobotClock(const RobotClockConfig& config = {});

  // Of a sample of odometry that arrives at now_s, in the order of arrival.
  Timestamp judge(double t_s, double now_s) noexcept;

  // The robot's time at a time of the host; nothing before the first sample.
  [[nodiscard]] std::optional<double> robot_time_s(double host_s) const noexcept;

  // After kStepped: the new clock less the old one.
  [[nodiscard]] double step_s() const noexcept { return step_s_; }
  // And whether samples of the new clock were good by the old one before it was found.
  [[nodiscard]] bool step_found_late() const noexcept { return step_found_late_; }
  // A step is likely, or the input is behind: poses are not to be relied upon.
  [[nodiscard]] bool suspected() const noexcept;
  [[nodiscard]] bool is_late() const noexcept { return late_alike_ >= kRun || behind_; }
  // How late the last good sample was; negative where it was early.
  [[nodiscard]] double lateness_s() const noexcept { return lateness_s_; }
  // The last timestamp that was wrong, or the last step.
  [[nodiscard]] const std::optional<TimestampFault>& fault() const noexcept { return fault_; }

 private:
  // Odd samples without one between them that fits.
  struct Run {
    std::uint32_t samples = 0;  // all
    std::uint32_t alike = 0;    // the last ones, which agree
    double offset_s = 0.0;      // of the first of those
    double since_s = 0.0;       // host time
  };
  struct Far {
    std::uint32_t samples = 0;
    double t_s = 0.0;
    double since_s = 0.0;
  };

  void begin(double t_s, double now_s) noexcept;
  Timestamp judge_far(double t_s, double now_s, double offset_s) noexcept;
  Timestamp judge_fallen_back(double t_s, double now_s, double offset_s) noexcept;
  Timestamp step(double t_s, double now_s, double by_s) noexcept;
  void watch_lateness(double now_s, double offset_s) noexcept;

  RobotClockConfig config_;
  clock::TimeMapper mapper_;
  std::optional<double> last_s_;  // robot time: the newest that fits the clock
  Run run_;
  Far far_;
  std::uint32_t early_ = 0;       // in a row
  std::uint32_t late_alike_ = 0;  // in a row
  double late_by_s_ = 0.0;
  double on_time_s_ = 0.0;  // host time
  double lateness_s_ = 0.0;
  bool behind_ = false;
  double step_s_ = 0.0;
  bool step_found_late_ = false;
  std::optional<TimestampFault> fault_;
};

}  // namespace groma::daemon
