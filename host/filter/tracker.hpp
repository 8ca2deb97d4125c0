// The filter with somebody who watches it: finds the pose where none is given, says how far the estimate is
// to be trusted, and begins anew where the ranges tell of another place.
//
//   UNINITIALIZED --ranges--> CONVERGING --one hypothesis, ranges agree--> TRACKING
//   TRACKING <--> DEGRADED (with a reason) --> LOST --another place found--> CONVERGING
//   DEGRADED (no-odometry) --odometry, ranges agree--> TRACKING, by way of CONVERGING
//
// No clock, no allocation after construction. Inputs may come late as OrderedFilter allows.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>
#include <string_view>

#include "host/filter/config.hpp"
#include "host/filter/filter.hpp"
#include "host/filter/map_watch.hpp"
#include "host/filter/ordered_filter.hpp"
#include "host/filter/start_search.hpp"
#include "host/model/calibration.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

enum class State : std::uint8_t {
  kUninitialized,  // nothing is known of the pose
  kConverging,     // a pose is being looked for, or was just begun with
  kTracking,
  kDegraded,  // there is a pose, but: see the reason
  kLost,      // the pose is wrong or unknown, and no other was found yet
};

enum class Reason : std::uint8_t {
  kNone,
  kNoRanges,        // none was used of late: odometry alone
  kRangesDisagree,  // most ranges of late are refused
  kNoOdometry,      // the motion is a guess
  kTagSilent,       // a tag that ranged gives no ranges, while others do
  kUncertain,       // the covariance is too large
  kOffSurface,      // beyond what the surface tells of
  kMapMismatch,     // the calibration is not of this site, or no more: the pose goes on by odometry alone
  kOdometryTimes,   // odometry's timestamps are wrong or late; given by the daemon, not by Tracker
};

// "UNINITIALIZED", "CONVERGING", "TRACKING", "DEGRADED", "LOST".
[[nodiscard]] std::string_view state_name(State state) noexcept;
// "", "no-ranges", "ranges-disagree", "no-odometry", "tag-silent", "uncertain", "off-surface",
// "map-mismatch", "odometry-times".
[[nodiscard]] std::string_view reason_name(Reason reason) noexcept;

struct TrackerConfig {
  double window_s = 1.0;        // over which agreement is judged
  double disagree_share = 0.5;  // of the weight of ranges that is refused
  double few_ranges = 4.0;      // within the window: too few to judge by
  double silent_s = 1.0;        // without a range used, or without odometry
  double tag_silent_s = 2.0;    // without a range of one tag
  double lost_s = 3.0;          // of disagreement, until another place is looked for
  double agree_s = 0.5;         // of agreement, until a begun pose is tracked
  // A search costs some 10 ms: so many at this interval (twice of it where the map is in doubt), then one
  // each time that another is earned.
  double search_every_s = 0.5;
  double most_searches = 40.0;
  double search_earned_s = 5.0;
  double search_earned_on_wrong_map_s = 30.0;
  // From this share on other floors at the same place are looked at: a floor above differs by ranges to some
  // anchors only, and the position makes up for others.
  double floor_share = 0.1;
  double position_sigma_m = 1.0;  // from which the pose is uncertain
  double heading_sigma_rad = 0.3;
  double unknown_sigma_m = 3.0;  // from which, after a pause of odometry, the pose is searched for
  // A hypothesis is another place from so many sigmas and so much likelier, ln of the odds, by cautious cost:
  // of all places that the robot may have been carried to, that one is one of some ten thousand.
  double other_sigmas = 5.0;
  double other_odds = 25.0;
  // And where one is so much likelier, sure or not, the robot is lost.
  double lost_odds = 20.0;
  // Of floors at the same place there are few.
  double floor_odds = 15.0;
  // Inputs that all come so much before or after the newest one: the clock was set.
  double clock_step_s = 2.0;
  std::size_t clock_step_inputs = 5;
  // Whether another pose than the one told is looked for at all; without, it waits for a start.
  bool relocates = true;
  // Searches of which none explains half of the ranges, for so long and so many ranges: the map is wrong.
  double no_place_s = 25.0;
  double no_place_ranges = 150.0;
  // Where the clock was set back, or odometry paused, the robot is within this of where it was, beside what
  // the covariance of its pose has.
  double set_back_position_m = 0.5;
  double set_back_heading_rad = 0.2;
};

class Tracker {
 public:
  // As Filter's.
  Tracker(model::Surface surface, std::span<const model::Tag> tags, const model::Calibration& calibration,
          const Config& config, const TrackerConfig& tracker = {}, const StartSearchConfig& search = {});

  // Begins, or begins anew, at a pose that is known, in the state that it deserves. False, and nothing done,
  // where it comes too late.
  bool start(const Start& start, State state = State::kConverging) noexcept;
  // Goes on where another one is that has started, by another calibration, in its state; see Filter. How well
  // ranges agree is judged anew.
  void resume(const Tracker& other) noexcept;
  // The pose goes on, but is not tracked until the ranges have agreed with it again, as after a start.
  // widens: what moved it may have been wrong, so it is known less well.
  void prove_again(bool widens) noexcept;
  OdometryOutcome process(const model::OdometrySample& row) noexcept;
  RangeResult process(const model::RangeSample& range) noexcept;
  SensorResult process(const model::YawRateSample& sample) noexcept;
  SensorResult process(const model::PositionSample& sample) noexcept { return process_fix(sample); }
  // Begins there, if nothing has begun.
  SensorResult process(const model::PoseSample& sample) noexcept;
  SensorResult process(const model::ZeroVelocitySample& sample) noexcept { return process_sensor(sample); }

  [[nodiscard]] State state() const noexcept { return state_; }
  [[nodiscard]] Reason reason() const noexcept { return reason_; }
  // Whether a pose with that covariance (of x_m, y_m, theta_rad) is not `uncertain`.
  [[nodiscard]] bool is_certain(const Eigen::Matrix3d& covariance) const noexcept;
  // Of the newest odometry that was processed; -infinity before any.
  [[nodiscard]] double last_odometry_s() const noexcept { return last_row_s_; }
  // Whether there is an estimate; it is to be used in the states TRACKING and DEGRADED.
  [[nodiscard]] bool started() const noexcept { return filter_.started(); }
  [[nodiscard]] Estimate estimate() const noexcept;
  // As OrderedFilter's.
  [[nodiscard]] Estimate row_estimate() const noexcept;
  // The state to be carried on by inputs ahead.
  [[nodiscard]] Filter::Prediction prediction() const noexcept;
  // How well the ranges fit the calibration.
  [[nodiscard]] const MapWatch& map_watch() const noexcept { return map_watch_; }
  [[nodiscard]] const OrderedFilter& filter() const noexcept { return filter_; }
  // Times that another place was found than the filter's.
  [[nodiscard]] std::size_t relocations() const noexcept { return relocations_; }
  // Times that the inputs' clock was set.
  [[nodiscard]] std::size_t clock_steps() const noexcept { return clock_steps_; }

 private:
  struct TagWatch {
    model::NodeId id = 0;
    double last_s = -std::numeric_limits<double>::infinity();
    bool heard = false;
  };

  // As start(), by ranges alone.
  bool begin(const Start& start, State state) noexcept;
  [[nodiscard]] bool is_on_wrong_map() const noexcept { return map_watch_.is_wrong() && by_odometry_; }
  // The pose by odometry since the map last fitted, for where it turns out to be wrong.
  void carry_on(const MotionInput& input) noexcept;
  void go_on_alone_from(const Filter::Prediction& prediction) noexcept;
  void name_wrong_map() noexcept;
  // Nothing has begun, and no pose explains the ranges since then.
  [[nodiscard]] bool finds_no_place() const noexcept;
  template <class Sample>
  SensorResult process_sensor(const Sample& sample) noexcept;
  // Of a sensor that tells where the robot is, as ranges do.
  template <class Sample>
  SensorResult process_fix(const Sample& sample) noexcept;
  // False where the input is of a time that cannot be believed yet.
  bool believe(double t_s) noexcept;
  void set_back(double t_s) noexcept;
  // Begins where it was, known less well.
  void start_near(const Estimate& before, double t_s) noexcept;
  void watch(const model::RangeSample& range, const RangeResult& result) noexcept;
  void assess() noexcept;
  void search_when_due() noexcept;
  void compare_floors_when_due() noexcept;
  // Whether enough time went by since the last search, which it is then taken to begin.
  bool search_is_due() noexcept;
  // Whether there is a search left; takes it.
  bool earns_search() noexcept;
  // ln of the odds, by cautious cost, of the hypothesis against the estimate.
  [[nodiscard]] double likelier(const StartSearch::Hypothesis& hypothesis) noexcept;
  [[nodiscard]] bool is_elsewhere(const StartSearch::Hypothesis& hypothesis) const noexcept;
  [[nodiscard]] bool is_on_other_floor(const StartSearch::Hypothesis& hypothesis) const noexcept;
  void begin_at(const StartSearch::Hypothesis& hypothesis) noexcept;
  void judge_anew() noexcept;
  [[nodiscard]] Reason find_reason() const noexcept;

  TrackerConfig config_;
  model::Surface surface_;
  OrderedFilter filter_;
  StartSearch search_;
  MapWatch map_watch_;
  std::optional<Filter::Prediction> by_odometry_;  // none: the pose was never known but by ranges
  double reach_m_ = 0.0;                           // between the anchors that are farthest apart
  State state_ = State::kUninitialized;
  Reason reason_ = Reason::kNone;

  double newest_s_ = -std::numeric_limits<double>::infinity();
  double last_row_s_ = -std::numeric_limits<double>::infinity();
  double last_used_s_ = -std::numeric_limits<double>::infinity();
  double last_search_s_ = -std::numeric_limits<double>::infinity();
  double searches_left_ = 0.0;
  double earned_s_ = 0.0;                                                // until when searches were earned
  double no_place_since_s_ = std::numeric_limits<double>::quiet_NaN();   // NaN: there may be one
  double no_place_ranges_ = 0.0;                                         // since then
  double disagrees_since_s_ = std::numeric_limits<double>::quiet_NaN();  // NaN: ranges agree
  double agrees_since_s_ = std::numeric_limits<double>::quiet_NaN();     // NaN: tracked, or not begun
  bool proven_ = false;  // the ranges have agreed for agree_s since the start, or since odometry paused
  double judged_s_ = 0.0;
  double refused_ = 0.0;  // fading sums over window_s
  double judged_ = 0.0;
  double strange_s_ = 0.0;  // time of the last input that was not believed
  std::size_t strange_ = 0;
  std::array<TagWatch, kMaxTags> tags_{};
  std::size_t tag_count_ = 0;
  std::size_t relocations_ = 0;
  std::size_t clock_steps_ = 0;
};

template <class Sample>
SensorResult Tracker::process_sensor(const Sample& sample) noexcept {
  if (std::isfinite(sample.t_s) && !believe(sample.t_s)) return {.outcome = SensorOutcome::kOutOfOrder};
  const SensorResult result = filter_.process(sample);
  if (result.outcome != SensorOutcome::kUsed && result.outcome != SensorOutcome::kGated) return result;
  newest_s_ = std::max(newest_s_, sample.t_s);
  return result;
}

template <class Sample>
SensorResult Tracker::process_fix(const Sample& sample) noexcept {
  const SensorResult result = process_sensor(sample);
  if (result.outcome == SensorOutcome::kUsed) last_used_s_ = std::max(last_used_s_, sample.t_s);
  return result;
}

}  // namespace groma::filter
