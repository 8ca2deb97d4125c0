// The filter under supervision: finds the pose where none is given, judges how far the estimate can be
// trusted, and starts again where the ranges agree with another place.
//
//   UNINITIALIZED --ranges--> CONVERGING --one hypothesis, ranges agree--> TRACKING
//   TRACKING <--> DEGRADED (with a reason) --> LOST --another place found--> CONVERGING
//   DEGRADED (no-odometry) --odometry, ranges agree--> TRACKING, by way of CONVERGING
//
// No clock, no allocation after construction. Inputs may come late as OrderedFilter allows.
#pragma once

#include <string_view>

#include "host/filter/map_watch.hpp"
#include "host/filter/ordered_filter.hpp"
#include "host/filter/start_search.hpp"

namespace groma::filter {

enum class State : std::uint8_t {
  kUninitialized,  // nothing is known of the pose
  kConverging,     // a pose is being searched for, or was just started with
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
  kOffSurface,      // beyond the surface
  kMapMismatch,     // the calibration is not of this site, or no more: the pose goes on by odometry alone
  kOdometryTimes,   // odometry's timestamps are wrong or late; given by the daemon, not by Tracker
};

// "UNINITIALIZED", "CONVERGING", "TRACKING", "DEGRADED", "LOST".
[[nodiscard]] std::string_view state_name(State state) noexcept;
// "", "no-ranges", "ranges-disagree", "no-odometry", "tag-silent", "uncertain", "off-surface",
// "map-mismatch", "odometry-times".
[[nodiscard]] std::string_view reason_name(Reason reason) noexcept;

struct TrackerConfig {
  // Whether a pose is searched for; without, it waits for a start and keeps to it.
  bool relocates = true;
  // Several inputs that all come so much before or after the newest one: the clock was set.
  double clock_step_s = 2.0;
};

class Tracker {
 public:
  static constexpr double kSilent_s = 1.0;  // without a range used, or without odometry

  // As Filter's.
  Tracker(model::Surface surface, std::span<const model::Tag> tags, const model::Calibration& calibration,
          const Config& config, const TrackerConfig& tracker = {});

  // Starts at a known pose, in that state. False, and nothing done, where it comes too late.
  bool start(const Start& start, State state = State::kConverging) noexcept;
  // Continues another tracker that has started, with another calibration, in its state; see Filter. How well
  // ranges agree is judged from then on.
  void resume(const Tracker& other) noexcept;
  // The pose goes on, but is not tracked until the ranges have agreed with it again, as after a start.
  // widens: with a larger covariance.
  void prove_again(bool widens) noexcept;
  OdometryOutcome process(const model::OdometrySample& row) noexcept;
  RangeResult process(const model::RangeSample& range) noexcept;
  // A pose is the start, if nothing has started.
  SensorResult process(const model::SensorSample& sample) noexcept;

  [[nodiscard]] State state() const noexcept { return state_; }
  [[nodiscard]] Reason reason() const noexcept { return reason_; }
  // Whether a pose with that covariance (of x_m, y_m, theta_rad) is not `uncertain`.
  [[nodiscard]] bool is_certain(const Eigen::Matrix3d& covariance) const noexcept;
  // Time of the newest odometry that was processed; -infinity before any.
  [[nodiscard]] double last_odometry_s() const noexcept { return last_row_s_; }
  // Whether there is an estimate; it is to be used in the states TRACKING and DEGRADED.
  [[nodiscard]] bool started() const noexcept { return filter_.started(); }
  [[nodiscard]] Estimate estimate() const noexcept;
  // As OrderedFilter's.
  [[nodiscard]] Estimate row_estimate() const noexcept;
  // The state to be carried on by inputs ahead.
  [[nodiscard]] Filter::Prediction prediction() const noexcept;
  [[nodiscard]] const MapWatch& map_watch() const noexcept { return map_watch_; }
  [[nodiscard]] const OrderedFilter& filter() const noexcept { return filter_; }
  // Times that another place was found than the filter's.
  [[nodiscard]] std::size_t relocations() const noexcept { return relocations_; }
  // Times that the inputs' clock was set.
  [[nodiscard]] std::size_t clock_steps() const noexcept { return clock_steps_; }

 private:
  static constexpr double kNotYet_s = -std::numeric_limits<double>::infinity();

  struct TagWatch {
    model::NodeId id = 0;
    double last_s = kNotYet_s;  // its last range
  };

  // As start(), by ranges alone.
  bool begin(const Start& start, State state) noexcept;
  [[nodiscard]] bool is_on_wrong_map() const noexcept { return map_watch_.is_wrong() && by_odometry_; }
  // The pose by odometry since the map last fitted, for where it turns out to be wrong.
  void carry_on(const MotionInput& input) noexcept;
  void go_on_alone_from(const Filter::Prediction& prediction) noexcept;
  void name_wrong_map() noexcept;
  SensorResult start_at(const model::PoseSample& sample) noexcept;
  // False where the input is of a time that cannot be believed yet.
  bool believe(double t_s) noexcept;
  void set_back(double t_s) noexcept;
  // Starts where it was, with a larger covariance.
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
  [[nodiscard]] double odds(const StartSearch::Hypothesis& hypothesis) noexcept;
  [[nodiscard]] bool is_elsewhere(const StartSearch::Hypothesis& hypothesis) const noexcept;
  [[nodiscard]] bool is_on_other_floor(const StartSearch::Hypothesis& hypothesis) const noexcept;
  void begin_at(const StartSearch::Hypothesis& hypothesis) noexcept;
  void judge_again() noexcept;
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

  double newest_s_ = kNotYet_s;
  double last_row_s_ = kNotYet_s;
  double last_used_s_ = kNotYet_s;
  double last_search_s_ = kNotYet_s;
  double searches_left_;
  double earned_s_ = 0.0;         // until when searches were earned
  Since no_place_;                // no search found a place that explains half of the ranges
  double no_place_ranges_ = 0.0;  // since then
  Since disagrees_;               // ranges refused
  Since agrees_;                  // while converging
  bool proven_ = false;           // the ranges have agreed for long enough since the start
  double judged_s_ = 0.0;
  double refused_ = 0.0;  // fading sums
  double judged_ = 0.0;
  double strange_s_ = 0.0;  // time of the last input that was not believed
  std::size_t strange_ = 0;
  std::vector<TagWatch> tags_;
  std::size_t relocations_ = 0;
  std::size_t clock_steps_ = 0;
};

}  // namespace groma::filter
