#include "host/filter/tracker.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "host/filter/sensors.hpp"

namespace groma::filter {

namespace {

// "By hand" is explained in config.hpp. The tests of all of them are the simulated TrackerTest.*, which bound
// the time to track, the time with a wrong pose in TRACKING, and relocations.
constexpr double kAgreement_s = 1.0;    // time constant of the agreement test. By hand
constexpr double kDisagreeShare = 0.5;  // share of refused weight from which ranges disagree. By hand
constexpr double kFewRanges = 4.0;      // with fewer ranges in the window the test is undecided. By hand
constexpr double kTagSilent_s = 2.0;    // timeout of one tag. By hand
constexpr double kLostAfter_s = 3.0;    // disagreement until another pose is searched for. By hand
// Agreement until CONVERGING becomes TRACKING. By hand. On a simulated drive with a pause of odometry of 5 s,
// 16 poses were TRACKING beyond 5 sigma when a pause did not require it, and none since.
constexpr double kAgreeFor_s = 0.5;
constexpr std::size_t kClockInputs = 5;  // see TrackerConfig::clock_step_s. By hand
// A search takes some 10 ms, so searches are rate limited: at most kMostSearches at this interval (twice the
// interval if the map is suspected to be wrong), then one each kSearchEarned_s. By hand, for the processor:
// 2 % of it, later 0.2 %, on a wrong map 0.03 %.
constexpr double kSearchEvery_s = 0.5;
constexpr double kMostSearches = 40.0;
constexpr double kSearchEarned_s = 5.0;
constexpr double kSearchEarnedOnWrongMap_s = 30.0;
// The next search waits for this share of the time that the ranges have disagreed, at most kSearchEarned_s:
// by hand, for the processor.
constexpr double kSearchShare = 0.3;
// Share of refused weight from which other floors at the same position are compared. It is small because a
// wrong floor changes the ranges of some anchors only, and the position compensates for others. By hand;
// Floors.* (simulated).
constexpr double kFloorShare = 0.1;
constexpr double kUncertain_m = 1.0;  // sigmas from which the pose is uncertain. By hand
constexpr double kUncertain_rad = 0.3;
// Sigma from which a pose after a pause of odometry is dropped. By hand.
constexpr double kUnknownAfterPause_m = 3.0;
// A hypothesis is accepted as another pose if it is this many sigmas away and this much likelier (ln of the
// odds, by cautious cost). The odds include a prior of one in ten thousand: the number of distinct poses that
// the robot may have been carried to. Statistics: 5 sigmas in 3 components are exceeded with 1.5e-5.
// The odds are tuned on the simulated outdoor run with a gate: an obstacle reached 18, a robot that was
// carried away 35 to 70. So half would relocate during NLOS (15, without the cautious cost, did: 0.15 m off
// in the mean), and twice as much would miss some of the carried robots.
constexpr double kOtherSigmas = 5.0;
constexpr double kOtherOdds = 25.0;
constexpr double kLostOdds = 20.0;   // odds from which the state is LOST, settled or not; above those 18
constexpr double kFloorOdds = 15.0;  // without that prior (ln 1e4 = 9): few floors have the same position
// The map is wrong if no search explains half of the ranges for this time and number of ranges. By hand.
constexpr double kNoPlace_s = 25.0;
constexpr double kNoPlaceRanges = 150.0;
// Sigmas added to the pose after the clock was set back or odometry paused. By hand.
constexpr double kSetBack_m = 0.5;
constexpr double kSetBack_rad = 0.2;

using model::square;

constexpr std::array<std::string_view, 5> kStateNames{"UNINITIALIZED", "CONVERGING", "TRACKING", "DEGRADED",
                                                      "LOST"};
constexpr std::array<std::string_view, 9> kReasonNames{
    "",          "no-ranges",   "ranges-disagree", "no-odometry",   "tag-silent",
    "uncertain", "off-surface", "map-mismatch",    "odometry-times"};

double reach_m(const model::Calibration& calibration) noexcept {
  double out = 0.0;
  for (const model::AnchorCalibration& a : calibration.anchors) {
    for (const model::AnchorCalibration& b : calibration.anchors) {
      if (!model::has_position(a) || !model::has_position(b)) continue;
      out = std::max(out, (a.position_m - b.position_m).norm());
    }
  }
  return out;
}

double largest_variance(const Eigen::Matrix3d& covariance) noexcept {
  const double a = covariance(0, 0);
  const double b = covariance(1, 1);
  return 0.5 * (a + b) + std::hypot(0.5 * (a - b), covariance(0, 1));
}

// A start at a pose with that covariance of x_m, y_m, theta_rad, plus additional sigmas.
Start start_of(double t_s, const model::PlanarPose& pose, const Eigen::Matrix3d& covariance,
               double position_sigma_m = 0.0, double heading_sigma_rad = 0.0) noexcept {
  return {.t_s = t_s,
          .pose = pose,
          .position_sigma_m = std::hypot(std::sqrt(largest_variance(covariance)), position_sigma_m),
          .heading_sigma_rad = std::hypot(std::sqrt(covariance(2, 2)), heading_sigma_rad)};
}

}  // namespace

std::string_view state_name(State state) noexcept {
  return kStateNames[static_cast<std::size_t>(state)];
}

std::string_view reason_name(Reason reason) noexcept {
  return kReasonNames[static_cast<std::size_t>(reason)];
}

Tracker::Tracker(model::Surface surface, std::span<const model::Tag> tags,
                 const model::Calibration& calibration, const Config& config, const TrackerConfig& tracker)
    : config_(tracker),
      surface_(surface),
      filter_(surface, tags, calibration, config),
      search_(std::move(surface), tags, calibration, config),
      reach_m_(reach_m(calibration)),
      searches_left_(kMostSearches) {
  for (const model::Tag& tag : tags) tags_.push_back({.id = tag.id});
}

bool Tracker::start(const Start& start, State state) noexcept {
  if (!begin(start, state)) return false;
  restart_by_odometry(filter_.filter().prediction());
  return true;
}

bool Tracker::begin(const Start& start, State state) noexcept {
  if (!filter_.start(start)) return false;
  state_ = state;
  reason_ = Reason::kNone;
  confirmed_ = state == State::kTracking;
  newest_s_ = std::max(newest_s_, start.t_s);
  last_used_s_ = newest_s_;
  restart_agreement();
  return true;
}

void Tracker::resume(const Tracker& other) noexcept {
  filter_.resume(other.filter_);
  state_ = other.state_;
  reason_ = other.reason_;
  confirmed_ = other.confirmed_;
  newest_s_ = other.newest_s_;
  last_odometry_s_ = other.last_odometry_s_;
  last_used_s_ = other.last_used_s_;
  tags_ = other.tags_;
  restart_by_odometry(other.prediction());
  relocations_ = other.relocations_;
  restart_agreement();
}

void Tracker::restart_agreement() noexcept {
  judged_s_ = newest_s_;
  refused_ = judged_ = 0.0;
  disagrees_.reset();
  agrees_.reset();
}

OdometryOutcome Tracker::process(const model::OdometrySample& sample) noexcept {
  if (std::isfinite(sample.t_s) && !accepts_time(sample.t_s)) return OdometryOutcome::kOutOfOrder;
  const OdometryOutcome outcome = filter_.process(sample);
  if (outcome == OdometryOutcome::kBadValue || outcome == OdometryOutcome::kOutOfOrder) return outcome;
  newest_s_ = std::max(newest_s_, sample.t_s);
  if (outcome != OdometryOutcome::kImplausible) {
    search_.process(sample);
    // The motion during the pause is extrapolated: the ranges have to confirm the pose, as after a start.
    if (sample.t_s - last_odometry_s_ > kSilent_s && last_odometry_s_ != kNotYet_s) require_agreement(true);
    last_odometry_s_ = std::max(last_odometry_s_, sample.t_s);
  }
  advance_by_odometry(sample);
  assess();
  return outcome;
}

RangeResult Tracker::process(const model::RangeSample& range) noexcept {
  if (std::isfinite(range.t_s) && !accepts_time(range.t_s)) return {.outcome = RangeOutcome::kOutOfOrder};
  RangeResult result = filter_.process(range);
  if (result.outcome != RangeOutcome::kUsed && result.outcome != RangeOutcome::kGated &&
      result.outcome != RangeOutcome::kNotStarted) {
    return result;
  }
  search_.process(range);
  newest_s_ = std::max(newest_s_, range.t_s);
  watch(range, result);
  assess();
  return result;
}

SensorResult Tracker::process(const model::SensorSample& sample) noexcept {
  const double t_s = model::time_of(sample);
  if (std::isfinite(t_s) && !accepts_time(t_s)) return {.outcome = SensorOutcome::kOutOfOrder};
  const auto* pose = std::get_if<model::PoseSample>(&sample);
  if (pose != nullptr && !filter_.started() && is_usable(*pose)) return start_at(*pose);
  const SensorResult result = filter_.process(sample);
  if (result.outcome == SensorOutcome::kUsed || result.outcome == SensorOutcome::kGated)
    newest_s_ = std::max(newest_s_, t_s);
  const bool is_fix = pose != nullptr || std::holds_alternative<model::PositionSample>(sample);
  if (is_fix && result.outcome == SensorOutcome::kUsed) last_used_s_ = std::max(last_used_s_, t_s);
  if (const auto* rate = std::get_if<model::YawRateSample>(&sample)) advance_by_odometry(*rate);
  return result;
}

SensorResult Tracker::start_at(const model::PoseSample& sample) noexcept {
  if (!start(start_of(sample.t_s, place_on(surface_, sample), model::to_matrix(*sample.covariance))))
    return {.outcome = SensorOutcome::kOutOfOrder};
  return {.outcome = SensorOutcome::kUsed, .weight = 1.0};
}

Estimate Tracker::estimate() const noexcept {
  return is_on_wrong_map() ? filter_.filter().estimate(*by_odometry_) : filter_.estimate();
}

Estimate Tracker::sample_estimate() const noexcept {
  return is_on_wrong_map() ? estimate() : filter_.sample_estimate();
}

Filter::Prediction Tracker::prediction() const noexcept {
  return is_on_wrong_map() ? *by_odometry_ : filter_.filter().prediction();
}

void Tracker::restart_by_odometry(const Filter::Prediction& prediction) noexcept {
  by_odometry_ = prediction;
  by_odometry_->by_odometry_alone = true;
}

void Tracker::advance_by_odometry(const MotionInput& input) noexcept {
  if (!filter_.started()) return;
  if (map_watch_.fits()) {
    restart_by_odometry(filter_.filter().prediction());
  } else if (by_odometry_) {
    filter_.filter().carry(*by_odometry_, input);
  }
}

void Tracker::report_wrong_map() noexcept {
  if (!by_odometry_) {
    // The pose is known from ranges only, so it may be anywhere on the site.
    restart_by_odometry(filter_.filter().prediction());
    by_odometry_->covariance.grow(kX, square(reach_m_));
    by_odometry_->covariance.grow(kY, square(reach_m_));
    by_odometry_->covariance.grow(kTheta, square(std::numbers::pi) / 3.0);
  }
  reason_ = Reason::kMapMismatch;
  state_ = is_certain(filter_.filter().estimate(*by_odometry_).covariance) ? State::kDegraded : State::kLost;
  confirmed_ = false;
  agrees_.reset();
}

bool Tracker::accepts_time(double t_s) noexcept {
  if (newest_s_ == kNotYet_s || std::abs(t_s - newest_s_) < config_.clock_step_s) {
    strange_ = 0;
    return true;
  }
  // A single input may have a wrong time. Several consistent ones mean that the clock was set, or that there
  // was a gap; forwards both are treated alike.
  strange_ = strange_ > 0 && std::abs(t_s - strange_s_) < config_.clock_step_s ? strange_ + 1 : 1;
  strange_s_ = t_s;
  if (strange_ < kClockInputs) return false;
  strange_ = 0;
  if (t_s < newest_s_) set_back(t_s);
  return true;
}

void Tracker::set_back(double t_s) noexcept {
  const bool known = state_ == State::kTracking || state_ == State::kDegraded;
  const Estimate before = estimate();
  filter_.stop();
  by_odometry_.reset();
  map_watch_ = {};
  no_place_.reset();
  search_.stop();
  state_ = State::kUninitialized;
  reason_ = Reason::kNone;
  newest_s_ = last_odometry_s_ = last_used_s_ = last_search_s_ = kNotYet_s;
  restart_agreement();
  for (TagWatch& tag : tags_) tag.last_s = kNotYet_s;
  // The robot is near its last pose, although the time since then is unknown.
  if (known) start_near(before, t_s);
}

void Tracker::start_near(const Estimate& before, double t_s) noexcept {
  start(start_of(t_s, before.pose, before.covariance, kSetBack_m, kSetBack_rad));
}

void Tracker::watch(const model::RangeSample& range, const RangeResult& result) noexcept {
  for (TagWatch& tag : tags_) {
    if (tag.id == range.tag_id) tag.last_s = std::max(tag.last_s, range.t_s);
  }
  if (result.outcome == RangeOutcome::kNotStarted) {
    no_place_ranges_ += 1.0;
    return;
  }
  map_watch_.observe(range.t_s, result.innovation_m, result.map_variance_m2);
  if (result.outcome == RangeOutcome::kUsed) last_used_s_ = std::max(last_used_s_, range.t_s);
  const double fade = fading(judged_s_, newest_s_, kAgreement_s);
  judged_s_ = newest_s_;
  judged_ = judged_ * fade + 1.0;
  refused_ = refused_ * fade + (1.0 - result.weight);
  if (judged_ < kFewRanges) return;
  const bool disagrees = refused_ > kDisagreeShare * judged_;
  if (disagrees && !disagrees_.holds()) {
    // Earlier ranges may be from another place.
    search_.clear();
    last_search_s_ = newest_s_;
  }
  disagrees_.update(disagrees, newest_s_);
}

void Tracker::require_agreement(bool widens) noexcept {
  confirmed_ = false;
  agrees_.reset();
  if (state_ != State::kTracking && state_ != State::kDegraded) return;
  state_ = State::kConverging;
  if (!widens) return restart_agreement();
  const Estimate now = estimate();
  if (!config_.relocates || largest_variance(now.covariance) < square(kUnknownAfterPause_m))
    return start_near(now, now.t_s);
  // The pose is practically unknown: linearizing ranges there would be wrong.
  filter_.stop();
  by_odometry_.reset();
  search_.clear();
  state_ = State::kUninitialized;
  reason_ = Reason::kNone;
}

bool Tracker::is_certain(const Eigen::Matrix3d& covariance) const noexcept {
  return largest_variance(covariance) < square(kUncertain_m) && covariance(2, 2) < square(kUncertain_rad);
}

Reason Tracker::find_reason() const noexcept {
  if (disagrees_.holds() || map_watch_.is_suspect()) return Reason::kRangesDisagree;
  if (newest_s_ - last_used_s_ > kSilent_s) return Reason::kNoRanges;
  if (newest_s_ - last_odometry_s_ > kSilent_s) return Reason::kNoOdometry;
  if (!is_certain(filter_.filter().covariance().core().topLeftCorner<3, 3>())) return Reason::kUncertain;
  for (const TagWatch& tag : tags_) {
    if (tag.last_s != kNotYet_s && newest_s_ - tag.last_s > kTagSilent_s) return Reason::kTagSilent;
  }
  if (filter_.filter().is_off_surface()) return Reason::kOffSurface;
  return Reason::kNone;
}

void Tracker::assess() noexcept {
  if (!filter_.started()) {
    state_ = config_.relocates && search_.ranges() > 0 ? State::kConverging : State::kUninitialized;
    reason_ = Reason::kNone;
    if (no_place_.lasted_s(newest_s_) >= kNoPlace_s && no_place_ranges_ >= kNoPlaceRanges) {
      state_ = State::kLost;
      reason_ = Reason::kMapMismatch;
    }
    return search_when_due();
  }
  if (map_watch_.is_wrong()) {
    report_wrong_map();
    return search_when_due();
  }
  reason_ = find_reason();
  const bool disagrees = reason_ == Reason::kRangesDisagree;
  if (state_ == State::kConverging) {
    agrees_.update(!disagrees && judged_ >= kFewRanges, newest_s_);
    if (agrees_.lasted_s(newest_s_) >= kAgreeFor_s && reason_ != Reason::kUncertain) {
      state_ = State::kTracking;
      confirmed_ = true;
    }
    if (reason_ == Reason::kNoRanges) state_ = State::kDegraded;
  }
  if (state_ == State::kTracking || state_ == State::kDegraded) {
    const State good = confirmed_ ? State::kTracking : State::kConverging;
    state_ = reason_ == Reason::kNone ? good : State::kDegraded;
    if (state_ == State::kConverging) agrees_.reset();
  }
  if (state_ == State::kLost && !disagrees) {
    state_ = State::kConverging;
    confirmed_ = false;
    agrees_.reset();
  }
  // Wait for kLostAfter_s: obstacles may make most anchors NLOS for a while, and the ranges then fit a pose
  // some way off.
  if (disagrees && disagrees_.lasted_s(newest_s_) > kLostAfter_s) {
    search_when_due();
  } else if (surface_.chart_count() > 1 && judged_ >= kFewRanges && refused_ > kFloorShare * judged_) {
    compare_floors_when_due();
  }
}

bool Tracker::search_is_due() noexcept {
  const bool is_map_suspect = map_watch_.is_suspect() || no_place_.holds();
  const double every_s = std::clamp(kSearchShare * disagrees_.lasted_s(newest_s_),
                                    (is_map_suspect ? 2.0 : 1.0) * kSearchEvery_s, kSearchEarned_s);
  if (newest_s_ - last_search_s_ < every_s) return false;
  last_search_s_ = newest_s_;
  return true;
}

bool Tracker::take_search_token() noexcept {
  const bool is_wrong = reason_ == Reason::kMapMismatch;
  const double earned_in_s = is_wrong ? kSearchEarnedOnWrongMap_s : kSearchEarned_s;
  const double most = is_wrong ? 1.0 : kMostSearches;
  searches_left_ = std::min(searches_left_ + std::max(newest_s_ - earned_s_, 0.0) / earned_in_s, most);
  earned_s_ = newest_s_;
  if (searches_left_ < 1.0) return false;
  searches_left_ -= 1.0;
  return true;
}

void Tracker::search_when_due() noexcept {
  const bool is_known = filter_.started() && !map_watch_.is_wrong();
  if (!is_known && !config_.relocates) return;
  if (!search_is_due() || !take_search_token()) return;
  const auto hypotheses = search_.search();
  if (hypotheses.empty()) return;
  const StartSearch::Hypothesis& best = hypotheses.front();
  if (!filter_.started()) {
    const bool is_explained = best.mean_weight > StartSearch::kExplainedShare;
    if (!is_explained && !no_place_.holds()) no_place_ranges_ = 0.0;
    no_place_.update(!is_explained, newest_s_);
    if (search_.settled() && config_.relocates) begin_at(best);
    return;
  }
  const double odds = this->odds(best);
  if (is_known) state_ = odds > kLostOdds ? State::kLost : State::kDegraded;
  if (!search_.settled() || !config_.relocates || odds < kOtherOdds || !is_elsewhere(best)) return;
  ++relocations_;
  begin_at(best);
}

void Tracker::compare_floors_when_due() noexcept {
  if (!config_.relocates || !search_is_due()) return;
  const auto hypotheses = search_.search_floors(filter_.estimate().pose);
  if (!search_.settled()) return;
  const StartSearch::Hypothesis& found = hypotheses.front();
  if (!is_on_other_floor(found) || odds(found) < kFloorOdds) return;
  ++relocations_;
  begin_at(found);
}

double Tracker::odds(const StartSearch::Hypothesis& hypothesis) noexcept {
  return search_.cautious_cost(filter_.estimate().pose) - search_.cautious_cost(hypothesis.pose);
}

bool Tracker::is_on_other_floor(const StartSearch::Hypothesis& hypothesis) const noexcept {
  const double x_m = hypothesis.pose.x_m;
  const double y_m = hypothesis.pose.y_m;
  const int chart = surface_.follow(filter_.estimate().pose.chart, x_m, y_m);
  const double above_m = surface_.at(x_m, y_m, hypothesis.pose.chart).z_m - surface_.at(x_m, y_m, chart).z_m;
  return std::abs(above_m) > model::Surface::kStep_m;
}

bool Tracker::is_elsewhere(const StartSearch::Hypothesis& hypothesis) const noexcept {
  if (is_on_other_floor(hypothesis)) return true;
  const Estimate now = filter_.estimate();
  const Eigen::Vector3d apart(hypothesis.pose.x_m - now.pose.x_m, hypothesis.pose.y_m - now.pose.y_m,
                              model::wrap_angle(hypothesis.pose.theta_rad - now.pose.theta_rad));
  // Mahalanobis distance by the hypothesis's covariance only: the filter's grows while ranges are refused.
  const double distance2 = apart.dot(hypothesis.covariance.ldlt().solve(apart));
  return distance2 > square(kOtherSigmas);
}

void Tracker::begin_at(const StartSearch::Hypothesis& hypothesis) noexcept {
  begin(start_of(search_.t_s(), hypothesis.pose, hypothesis.covariance), State::kConverging);
  map_watch_.restart();
  if (map_watch_.is_wrong()) report_wrong_map();
  search_.clear();
}

}  // namespace groma::filter
