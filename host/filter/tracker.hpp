// Supervises the filter: initializes the pose if none is given, monitors the estimate's integrity, and
// re-initializes the filter if the ranges fit another pose.
//
//   UNINITIALIZED --ranges--> CONVERGING --one hypothesis, ranges agree--> TRACKING
//   TRACKING <--> DEGRADED (with a reason) --> LOST --another place found--> CONVERGING
//   DEGRADED (no-odometry) --odometry, ranges agree--> TRACKING, through CONVERGING
//
// No clock, no allocation after construction. Inputs may be out of order within OrderedFilter's window.
#pragma once

#include <string_view>

#include "host/filter/map_watch.hpp"
#include "host/filter/ordered_filter.hpp"
#include "host/filter/start_search.hpp"

namespace groma::filter {

enum class State : std::uint8_t {
  kUninitialized,  // no pose
  kConverging,     // searching for a pose, or just initialized
  kTracking,
  kDegraded,  // there is a pose, with reduced trust: see the reason
  kLost,      // the pose is wrong or unknown, and no other one is found yet
};

enum class Reason : std::uint8_t {
  kNone,
  kNoRanges,        // none was used recently: odometry only
  kRangesDisagree,  // most recent ranges are refused
  kNoOdometry,      // the motion is extrapolated
  kTagSilent,       // a tag that ranged before gives no ranges, while others do
  kUncertain,       // the covariance is too large
  kOffSurface,      // outside the surface model
  kMapMismatch,     // the ranges contradict the calibration: the pose is by odometry only
  kOdometryTimes,   // odometry's timestamps are wrong or late; given by the daemon, not by Tracker
};

// "UNINITIALIZED", "CONVERGING", "TRACKING", "DEGRADED", "LOST".
[[nodiscard]] std::string_view state_name(State state) noexcept;
// "", "no-ranges", "ranges-disagree", "no-odometry", "tag-silent", "uncertain", "off-surface",
// "map-mismatch", "odometry-times".
[[nodiscard]] std::string_view reason_name(Reason reason) noexcept;

struct TrackerConfig {
  // Whether the tracker searches for a pose and relocates; otherwise it waits for a start and keeps to it.
  bool relocates = true;
  // Several consistent inputs at least this far before or after the newest one are a clock step. By hand:
  // longer than the 0.5 s by which inputs may be late; TrackerTest.ContinuesAfterAClockStep (simulated).
  double clock_step_s = 2.0;
};

class Tracker {
 public:
  // Timeout of ranges used and of odometry. By hand; TrackerTest.ReportsMissingRangesAndRecovers (simulated).
  static constexpr double kSilent_s = 1.0;

  // As Filter's.
  Tracker(model::Surface surface, std::span<const model::Tag> tags, const model::Calibration& calibration,
          const Config& config, const TrackerConfig& tracker = {});

  // Initializes at a known pose, in that state. Returns false and does nothing if it is too late.
  bool start(const Start& start, State state = State::kConverging) noexcept;
  // Takes over the pose and state of another started tracker, with another calibration; see Filter::resume().
  // The agreement of the ranges is tested from then on.
  void resume(const Tracker& other) noexcept;
  // Back to CONVERGING: the pose stays, but the ranges have to agree with it again, as after a start. widens:
  // with a larger covariance; a pose that is then too uncertain is dropped.
  void require_agreement(bool widens) noexcept;
  OdometryOutcome process(const model::OdometrySample& sample) noexcept;
  RangeResult process(const model::RangeSample& range) noexcept;
  // A usable PoseSample initializes a tracker that has not started.
  SensorResult process(const model::SensorSample& sample) noexcept;

  [[nodiscard]] State state() const noexcept { return state_; }
  [[nodiscard]] Reason reason() const noexcept { return reason_; }
  // Whether a covariance (of x_m, y_m, theta_rad) is small enough for TRACKING.
  [[nodiscard]] bool is_certain(const Eigen::Matrix3d& covariance) const noexcept;
  // Time of the newest odometry sample used; -infinity before any.
  [[nodiscard]] double last_odometry_s() const noexcept { return last_odometry_s_; }
  // Whether there is an estimate; use it in the states TRACKING and DEGRADED.
  [[nodiscard]] bool started() const noexcept { return filter_.started(); }
  [[nodiscard]] Estimate estimate() const noexcept;
  // As OrderedFilter's.
  [[nodiscard]] Estimate sample_estimate() const noexcept;
  // The state for prediction by newer odometry: see Filter::carry().
  [[nodiscard]] Filter::Prediction prediction() const noexcept;
  [[nodiscard]] const MapWatch& map_watch() const noexcept { return map_watch_; }
  [[nodiscard]] const OrderedFilter& filter() const noexcept { return filter_; }
  // Number of re-initializations at another pose.
  [[nodiscard]] std::size_t relocations() const noexcept { return relocations_; }

  // As Filter's.
  void archive(model::StateArchive& state) {
    state(filter_, search_, map_watch_, by_odometry_, state_, reason_, newest_s_, last_odometry_s_,
          last_used_s_, last_search_s_, searches_left_, earned_s_, no_place_, no_place_ranges_, disagrees_,
          agrees_, confirmed_, judged_s_, refused_, judged_, strange_s_, strange_, tags_, relocations_);
  }

 private:
  static constexpr double kNotYet_s = -std::numeric_limits<double>::infinity();

  struct TagWatch {
    model::NodeId id = 0;
    double last_s = kNotYet_s;  // time of its last range
  };

  // As start(), for a pose found from ranges only: by_odometry_ stays.
  bool begin(const Start& start, State state) noexcept;
  [[nodiscard]] bool is_on_wrong_map() const noexcept { return map_watch_.is_wrong() && by_odometry_; }
  // Maintains by_odometry_: dead reckoning since the map last fitted, used if the map turns out to be wrong.
  void advance_by_odometry(const MotionInput& input) noexcept;
  void restart_by_odometry(const Filter::Prediction& prediction) noexcept;
  void report_wrong_map() noexcept;
  SensorResult start_at(const model::PoseSample& sample) noexcept;
  // Clock-step filter: false if the input's time is not accepted yet.
  bool accepts_time(double t_s) noexcept;
  void set_back(double t_s) noexcept;
  // Re-initializes at the same pose, with a larger covariance.
  void start_near(const Estimate& before, double t_s) noexcept;
  void watch(const model::RangeSample& range, const RangeResult& result) noexcept;
  void assess() noexcept;
  void search_when_due() noexcept;
  void compare_floors_when_due() noexcept;
  // Whether enough time has passed since the last search; then restarts the interval.
  bool search_is_due() noexcept;
  // Token bucket of searches: true if one is left, and uses it.
  bool take_search_token() noexcept;
  // ln of the odds, by cautious cost, of the hypothesis against the estimate.
  [[nodiscard]] double odds(const StartSearch::Hypothesis& hypothesis) noexcept;
  [[nodiscard]] bool is_elsewhere(const StartSearch::Hypothesis& hypothesis) const noexcept;
  [[nodiscard]] bool is_on_other_floor(const StartSearch::Hypothesis& hypothesis) const noexcept;
  void begin_at(const StartSearch::Hypothesis& hypothesis) noexcept;
  void restart_agreement() noexcept;
  [[nodiscard]] Reason find_reason() const noexcept;

  TrackerConfig config_;
  model::Surface surface_;
  OrderedFilter filter_;
  StartSearch search_;
  MapWatch map_watch_;
  std::optional<Filter::Prediction> by_odometry_;  // none: the pose is known from ranges only
  double reach_m_ = 0.0;                           // distance between the anchors that are farthest apart
  State state_ = State::kUninitialized;
  Reason reason_ = Reason::kNone;

  double newest_s_ = kNotYet_s;
  double last_odometry_s_ = kNotYet_s;
  double last_used_s_ = kNotYet_s;
  double last_search_s_ = kNotYet_s;
  double searches_left_;
  double earned_s_ = 0.0;         // time of the last refill of searches_left_
  Since no_place_;                // no search found a pose that explains half of the ranges
  double no_place_ranges_ = 0.0;  // ranges since then
  Since disagrees_;               // most ranges are refused
  Since agrees_;                  // while converging
  bool confirmed_ = false;        // the ranges have agreed for long enough since the start
  double judged_s_ = 0.0;
  double refused_ = 0.0;  // sums with exponential forgetting
  double judged_ = 0.0;
  double strange_s_ = 0.0;  // time of the last input whose time was not accepted
  std::size_t strange_ = 0;
  std::vector<TagWatch> tags_;
  std::size_t relocations_ = 0;
};

}  // namespace groma::filter
