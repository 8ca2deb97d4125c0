#include "host/filter/tracker.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "host/filter/sensors.hpp"

namespace groma::filter {

namespace {

constexpr double kNotYet_s = -std::numeric_limits<double>::infinity();
constexpr double kNotNow = std::numeric_limits<double>::quiet_NaN();

using model::square;

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

}  // namespace

std::string_view state_name(State state) noexcept {
  switch (state) {
    case State::kUninitialized:
      return "UNINITIALIZED";
    case State::kConverging:
      return "CONVERGING";
    case State::kTracking:
      return "TRACKING";
    case State::kDegraded:
      return "DEGRADED";
    case State::kLost:
      break;
  }
  return "LOST";
}

std::string_view reason_name(Reason reason) noexcept {
  switch (reason) {
    case Reason::kNone:
      return "";
    case Reason::kNoRanges:
      return "no-ranges";
    case Reason::kRangesDisagree:
      return "ranges-disagree";
    case Reason::kNoOdometry:
      return "no-odometry";
    case Reason::kTagSilent:
      return "tag-silent";
    case Reason::kUncertain:
      return "uncertain";
    case Reason::kOffSurface:
      return "off-surface";
    case Reason::kMapMismatch:
      return "map-mismatch";
    case Reason::kOdometryTimes:
      break;
  }
  return "odometry-times";
}

Tracker::Tracker(model::Surface surface, std::span<const model::Tag> tags,
                 const model::Calibration& calibration, const Config& config, const TrackerConfig& tracker,
                 const StartSearchConfig& search)
    : config_(tracker),
      surface_(surface),
      filter_(surface, tags, calibration, config),
      search_(std::move(surface), tags, calibration, config, search),
      reach_m_(reach_m(calibration)),
      searches_left_(tracker.most_searches) {
  for (const model::Tag& tag : tags) {
    if (tag_count_ < tags_.size()) tags_[tag_count_++].id = tag.id;
  }
}

bool Tracker::start(const Start& start, State state) noexcept {
  if (!begin(start, state)) return false;
  go_on_alone_from(filter_.filter().prediction());
  return true;
}

bool Tracker::begin(const Start& start, State state) noexcept {
  if (!filter_.start(start)) return false;
  state_ = state;
  reason_ = Reason::kNone;
  proven_ = state == State::kTracking;
  newest_s_ = std::max(newest_s_, start.t_s);
  last_used_s_ = newest_s_;
  judge_anew();
  return true;
}

void Tracker::resume(const Tracker& other) noexcept {
  filter_.resume(other.filter_);
  state_ = other.state_;
  reason_ = other.reason_;
  proven_ = other.proven_;
  newest_s_ = other.newest_s_;
  last_row_s_ = other.last_row_s_;
  last_used_s_ = other.last_used_s_;
  tags_ = other.tags_;
  go_on_alone_from(other.prediction());
  relocations_ = other.relocations_;
  clock_steps_ = other.clock_steps_;
  judge_anew();
}

void Tracker::judge_anew() noexcept {
  judged_s_ = newest_s_;
  refused_ = 0.0;
  judged_ = 0.0;
  disagrees_since_s_ = kNotNow;
  agrees_since_s_ = kNotNow;
}

OdometryOutcome Tracker::process(const model::OdometrySample& row) noexcept {
  if (std::isfinite(row.t_s) && !believe(row.t_s)) return OdometryOutcome::kOutOfOrder;
  const OdometryOutcome outcome = filter_.process(row);
  if (outcome == OdometryOutcome::kBadValue || outcome == OdometryOutcome::kOutOfOrder) return outcome;
  newest_s_ = std::max(newest_s_, row.t_s);
  if (outcome != OdometryOutcome::kImplausible) {
    search_.process(row);
    // What went on meanwhile is a guess, which the ranges have to confirm as they do a start.
    if (row.t_s - last_row_s_ > config_.silent_s && last_row_s_ != kNotYet_s) prove_again(true);
    last_row_s_ = std::max(last_row_s_, row.t_s);
  }
  carry_on(row);
  assess();
  return outcome;
}

RangeResult Tracker::process(const model::RangeSample& range) noexcept {
  if (std::isfinite(range.t_s) && !believe(range.t_s)) return {.outcome = RangeOutcome::kOutOfOrder};
  RangeResult result = filter_.process(range);
  const bool of_use = result.outcome == RangeOutcome::kUsed || result.outcome == RangeOutcome::kGated ||
                      result.outcome == RangeOutcome::kNotStarted;
  if (!of_use) return result;
  search_.process(range);
  newest_s_ = std::max(newest_s_, range.t_s);
  watch(range, result);
  assess();
  return result;
}

SensorResult Tracker::process(const model::PoseSample& sample) noexcept {
  if (filter_.started() || !tells_pose(sample)) return process_fix(sample);
  if (!believe(sample.t_s)) return {.outcome = SensorOutcome::kOutOfOrder};
  const Eigen::Matrix3d covariance = model::to_matrix(*sample.covariance);
  const bool begun = start({.t_s = sample.t_s,
                            .pose = place_on(surface_, sample),
                            .position_sigma_m = std::sqrt(largest_variance(covariance)),
                            .heading_sigma_rad = std::sqrt(covariance(2, 2))});
  if (!begun) return {.outcome = SensorOutcome::kOutOfOrder};
  return {.outcome = SensorOutcome::kUsed, .weight = 1.0};
}

SensorResult Tracker::process(const model::YawRateSample& sample) noexcept {
  const SensorResult result = process_sensor(sample);
  carry_on(sample);
  return result;
}

Estimate Tracker::estimate() const noexcept {
  return is_on_wrong_map() ? filter_.filter().estimate(*by_odometry_) : filter_.estimate();
}

Estimate Tracker::row_estimate() const noexcept {
  return is_on_wrong_map() ? estimate() : filter_.row_estimate();
}

Filter::Prediction Tracker::prediction() const noexcept {
  return is_on_wrong_map() ? *by_odometry_ : filter_.filter().prediction();
}

void Tracker::go_on_alone_from(const Filter::Prediction& prediction) noexcept {
  by_odometry_ = prediction;
  by_odometry_->by_odometry_alone = true;
}

void Tracker::carry_on(const MotionInput& input) noexcept {
  if (!filter_.started()) return;
  if (map_watch_.fits()) {
    go_on_alone_from(filter_.filter().prediction());
  } else if (by_odometry_) {
    filter_.filter().carry(*by_odometry_, input);
  }
}

void Tracker::name_wrong_map() noexcept {
  if (!by_odometry_) {
    // Ranges alone told where the robot is: it may be anywhere.
    go_on_alone_from(filter_.filter().prediction());
    by_odometry_->covariance.grow(kX, square(reach_m_));
    by_odometry_->covariance.grow(kY, square(reach_m_));
    by_odometry_->covariance.grow(kTheta, square(std::numbers::pi) / 3.0);
  }
  reason_ = Reason::kMapMismatch;
  state_ = is_certain(filter_.filter().estimate(*by_odometry_).covariance) ? State::kDegraded : State::kLost;
  proven_ = false;
  agrees_since_s_ = kNotNow;
}

bool Tracker::finds_no_place() const noexcept {
  return newest_s_ - no_place_since_s_ >= config_.no_place_s && no_place_ranges_ >= config_.no_place_ranges;
}

bool Tracker::believe(double t_s) noexcept {
  if (newest_s_ == kNotYet_s || std::abs(t_s - newest_s_) < config_.clock_step_s) {
    strange_ = 0;
    return true;
  }
  // One input may be wrong. Some that agree with each other say that the clock was set, or that nothing came
  // for a while: forwards both are the same.
  strange_ = strange_ > 0 && std::abs(t_s - strange_s_) < config_.clock_step_s ? strange_ + 1 : 1;
  strange_s_ = t_s;
  if (strange_ < config_.clock_step_inputs) return false;
  strange_ = 0;
  ++clock_steps_;
  if (t_s < newest_s_) set_back(t_s);
  return true;
}

void Tracker::set_back(double t_s) noexcept {
  const bool known = state_ == State::kTracking || state_ == State::kDegraded;
  const Estimate before = estimate();
  filter_.stop();
  by_odometry_.reset();
  map_watch_ = {};
  no_place_since_s_ = kNotNow;
  search_.stop();
  state_ = State::kUninitialized;
  reason_ = Reason::kNone;
  newest_s_ = last_row_s_ = last_used_s_ = last_search_s_ = kNotYet_s;
  disagrees_since_s_ = agrees_since_s_ = kNotNow;
  refused_ = judged_ = 0.0;
  for (TagWatch& tag : tags_) {
    tag.last_s = kNotYet_s;
    tag.heard = false;
  }
  // The robot is about where it was, though nobody knows how long ago that was.
  if (known) start_near(before, t_s);
}

void Tracker::start_near(const Estimate& before, double t_s) noexcept {
  const Eigen::Matrix3d& covariance = before.covariance;
  start({.t_s = t_s,
         .pose = before.pose,
         .position_sigma_m = std::hypot(std::sqrt(largest_variance(covariance)), config_.set_back_position_m),
         .heading_sigma_rad = std::hypot(std::sqrt(covariance(2, 2)), config_.set_back_heading_rad)});
}

void Tracker::watch(const model::RangeSample& range, const RangeResult& result) noexcept {
  for (TagWatch& tag : std::span(tags_).first(tag_count_)) {
    if (tag.id != range.tag_id) continue;
    tag.last_s = std::max(tag.last_s, range.t_s);
    tag.heard = true;
  }
  if (result.outcome == RangeOutcome::kNotStarted) {
    no_place_ranges_ += 1.0;
    return;
  }
  map_watch_.observe(range.t_s, result.innovation_m, result.map_variance_m2);
  if (result.outcome == RangeOutcome::kUsed) last_used_s_ = std::max(last_used_s_, range.t_s);
  const double fade = std::exp(-std::max(newest_s_ - judged_s_, 0.0) / config_.window_s);
  judged_s_ = newest_s_;
  judged_ = judged_ * fade + 1.0;
  refused_ = refused_ * fade + (1.0 - result.weight);
  if (judged_ < config_.few_ranges) return;
  const bool disagrees = refused_ > config_.disagree_share * judged_;
  if (disagrees && std::isnan(disagrees_since_s_)) {
    disagrees_since_s_ = newest_s_;
    // What came before may be of another place.
    search_.clear();
    last_search_s_ = newest_s_;
  }
  if (!disagrees) disagrees_since_s_ = kNotNow;
}

void Tracker::prove_again(bool widens) noexcept {
  proven_ = false;
  agrees_since_s_ = kNotNow;
  if (state_ != State::kTracking && state_ != State::kDegraded) return;
  state_ = State::kConverging;
  if (!widens) return judge_anew();
  const Estimate now = estimate();
  if (!config_.relocates || largest_variance(now.covariance) < square(config_.unknown_sigma_m)) {
    return start_near(now, now.t_s);
  }
  // As good as nothing is known of it: ranges linearized there would mislead.
  filter_.stop();
  by_odometry_.reset();
  search_.clear();
  state_ = State::kUninitialized;
  reason_ = Reason::kNone;
}

bool Tracker::is_certain(const Eigen::Matrix3d& covariance) const noexcept {
  return largest_variance(covariance) < square(config_.position_sigma_m) &&
         covariance(2, 2) < square(config_.heading_sigma_rad);
}

Reason Tracker::find_reason() const noexcept {
  if (!std::isnan(disagrees_since_s_) || map_watch_.is_doubtful()) return Reason::kRangesDisagree;
  if (newest_s_ - last_used_s_ > config_.silent_s) return Reason::kNoRanges;
  if (newest_s_ - last_row_s_ > config_.silent_s) return Reason::kNoOdometry;
  if (!is_certain(filter_.filter().covariance().core().topLeftCorner<3, 3>())) return Reason::kUncertain;
  for (const TagWatch& tag : std::span(tags_).first(tag_count_)) {
    if (tag.heard && newest_s_ - tag.last_s > config_.tag_silent_s) return Reason::kTagSilent;
  }
  if (filter_.filter().is_off_surface()) return Reason::kOffSurface;
  return Reason::kNone;
}

void Tracker::assess() noexcept {
  if (!filter_.started()) {
    state_ = config_.relocates && search_.ranges() > 0 ? State::kConverging : State::kUninitialized;
    reason_ = Reason::kNone;
    if (finds_no_place()) {
      state_ = State::kLost;
      reason_ = Reason::kMapMismatch;
    }
    search_when_due();
    return;
  }
  if (map_watch_.is_wrong()) {
    name_wrong_map();
    return search_when_due();
  }
  reason_ = find_reason();
  const bool disagrees = reason_ == Reason::kRangesDisagree;
  if (state_ == State::kConverging) {
    if (disagrees || judged_ < config_.few_ranges) {
      agrees_since_s_ = kNotNow;
    } else if (std::isnan(agrees_since_s_)) {
      agrees_since_s_ = newest_s_;
    }
    const bool agreed = newest_s_ - agrees_since_s_ >= config_.agree_s;
    if (agreed && reason_ != Reason::kUncertain) {
      state_ = State::kTracking;
      proven_ = true;
    }
    if (reason_ == Reason::kNoRanges) state_ = State::kDegraded;
  }
  if (state_ == State::kTracking || state_ == State::kDegraded) {
    const State good = proven_ ? State::kTracking : State::kConverging;
    state_ = reason_ == Reason::kNone ? good : State::kDegraded;
    if (state_ == State::kConverging) agrees_since_s_ = kNotNow;
  }
  if (state_ == State::kLost && !disagrees) {
    state_ = State::kConverging;
    proven_ = false;
    agrees_since_s_ = kNotNow;
  }
  // Walls may hide most anchors for a while, and what passes them agrees with a place some way off.
  if (disagrees && newest_s_ - disagrees_since_s_ > config_.lost_s) {
    search_when_due();
  } else if (surface_.chart_count() > 1 && judged_ >= config_.few_ranges &&
             refused_ > config_.floor_share * judged_) {
    compare_floors_when_due();
  }
}

bool Tracker::search_is_due() noexcept {
  const bool is_map_doubtful = map_watch_.is_doubtful() || !std::isnan(no_place_since_s_);
  const double every_s = (is_map_doubtful ? 2.0 : 1.0) * config_.search_every_s;
  if (newest_s_ - last_search_s_ < every_s) return false;
  last_search_s_ = newest_s_;
  return true;
}

bool Tracker::earns_search() noexcept {
  const bool is_wrong = reason_ == Reason::kMapMismatch;
  const double earned_in_s = is_wrong ? config_.search_earned_on_wrong_map_s : config_.search_earned_s;
  const double most = is_wrong ? 1.0 : config_.most_searches;
  searches_left_ = std::min(searches_left_ + std::max(newest_s_ - earned_s_, 0.0) / earned_in_s, most);
  earned_s_ = newest_s_;
  if (searches_left_ < 1.0) return false;
  searches_left_ -= 1.0;
  return true;
}

void Tracker::search_when_due() noexcept {
  const bool is_known = filter_.started() && !map_watch_.is_wrong();
  if (!is_known && !config_.relocates) return;
  if (!search_is_due() || !earns_search()) return;
  const auto hypotheses = search_.search();
  double doubt = 0.0;
  if (filter_.started() && !hypotheses.empty()) {
    doubt = likelier(hypotheses.front());
    if (is_known) state_ = doubt > config_.lost_odds ? State::kLost : State::kDegraded;
  }
  if (!filter_.started() && !hypotheses.empty()) {
    if (hypotheses.front().mean_weight > search_.explained_share()) {
      no_place_since_s_ = kNotNow;
    } else if (std::isnan(no_place_since_s_)) {
      no_place_since_s_ = newest_s_;
      no_place_ranges_ = 0.0;
    }
  }
  if (!search_.settled() || !config_.relocates) return;
  const StartSearch::Hypothesis& found = hypotheses.front();
  if (filter_.started()) {
    if (doubt < config_.other_odds || !is_elsewhere(found)) return;
    ++relocations_;
  }
  begin_at(found);
}

void Tracker::compare_floors_when_due() noexcept {
  if (!config_.relocates || !search_is_due()) return;
  const auto hypotheses = search_.search_floors(filter_.estimate().pose);
  if (!search_.settled()) return;
  const StartSearch::Hypothesis& found = hypotheses.front();
  if (!is_on_other_floor(found) || likelier(found) < config_.floor_odds) return;
  ++relocations_;
  begin_at(found);
}

double Tracker::likelier(const StartSearch::Hypothesis& hypothesis) noexcept {
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
  // The filter's own covariance grows while it doubts; that the ranges refuse it is held against it already.
  const double distance2 = apart.dot(hypothesis.covariance.ldlt().solve(apart));
  return distance2 > square(config_.other_sigmas);
}

void Tracker::begin_at(const StartSearch::Hypothesis& hypothesis) noexcept {
  begin({.t_s = search_.t_s(),
         .pose = hypothesis.pose,
         .position_sigma_m = std::sqrt(largest_variance(hypothesis.covariance)),
         .heading_sigma_rad = std::sqrt(hypothesis.covariance(2, 2))},
        State::kConverging);
  map_watch_.restart();
  if (map_watch_.is_wrong()) name_wrong_map();
  search_.clear();
}

}  // namespace groma::filter
