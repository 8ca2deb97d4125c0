#include "host/daemon/localizer.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <memory>
#include <span>
#include <utility>
#include <variant>

#include "host/filter/replay.hpp"

namespace groma::daemon {

namespace {

constexpr double kNotYet_s = -std::numeric_limits<double>::infinity();

// By time, then odometry before yaw rates: the order in which a session passes them on.
bool comes_before(const filter::MotionInput& a, const filter::MotionInput& b) {
  const auto time_of = [](const auto& of) { return of.t_s; };
  const double a_s = std::visit(time_of, a);
  const double b_s = std::visit(time_of, b);
  return a_s != b_s ? a_s < b_s : a.index() < b.index();
}

}  // namespace

PoseEstimate pose_on(const model::Surface& surface, const filter::Estimate& estimate) noexcept {
  const model::SpatialEstimate at =
      model::on_surface(surface, estimate.pose, estimate.covariance_with_ground());
  PoseEstimate pose;
  pose.t_s = estimate.t_s;
  pose.x_m = estimate.pose.x_m;
  pose.y_m = estimate.pose.y_m;
  pose.z_m = at.z_m;
  pose.roll_rad = at.roll_rad;
  pose.pitch_rad = at.pitch_rad;
  pose.yaw_rad = model::wrap_angle(estimate.pose.theta_rad);
  pose.quaternion = at.quaternion;
  pose.planar_covariance = estimate.covariance;
  pose.covariance = at.covariance;
  pose.velocity = estimate.velocity;
  pose.velocity_covariance = estimate.velocity_covariance;
  if (surface.chart_count() > 1) pose.floor = surface.charts()[static_cast<std::size_t>(at.chart)].name;
  return pose;
}

Localizer::Localizer(Setup setup, OnPose on_pose, OnPose on_settled)
    : setup_(std::move(setup)),
      on_pose_(std::move(on_pose)),
      on_settled_(std::move(on_settled)),
      last_odometry_s_(kNotYet_s) {
  ahead_.reserve(kMaxAhead);
  make_tracker();
}

void Localizer::adopt(model::Calibration calibration, std::vector<model::Tag> tags) {
  setup_.tags = std::move(tags);
  adopt(std::move(calibration));
}

void Localizer::adopt(model::Calibration calibration) {
  setup_.calibration = std::move(calibration);
  prediction_.reset();
  const std::unique_ptr<filter::Tracker> before = std::move(tracker_);
  make_tracker();
  if (before->started()) tracker_->resume(*before);
}

void Localizer::start(const filter::Start& start) {
  begin(in_own_time(start));
}

void Localizer::begin(const filter::Start& start) {
  prediction_.reset();
  tracker_->start(start);
}

void Localizer::on_odometry(const model::OdometrySample& sample) {
  const model::OdometrySample own = in_own_time(sample);
  remove_waiting_until(own);
  if (next_start_ && !tracker_->started()) {
    next_start_->t_s = own.t_s;
    begin(*next_start_);
  }
  next_start_.reset();
  const filter::OdometryOutcome outcome = tracker_->process(own);
  const bool was_announced = own.t_s <= last_odometry_s_;
  note_odometry_time(own.t_s);
  const bool implausible = outcome == filter::OdometryOutcome::kImplausible;
  if (implausible) ++implausible_;
  if (!tracker_->started() || !(outcome == filter::OdometryOutcome::kUsed || implausible)) return;
  if (!was_announced) on_pose_(pose_of(tracker_->sample_estimate()));
  if (on_settled_) on_settled_(pose_of(tracker_->estimate()));
}

void Localizer::on_odometry_ahead(const model::OdometrySample& sample) {
  const model::OdometrySample own = in_own_time(sample);
  const auto end = insert_waiting(own);
  note_odometry_time(own.t_s);
  if (tracker_->started()) on_pose_(pose_of(predict(own.t_s, end)));
}

filter::Estimate Localizer::predict(double t_s, Ahead::const_iterator end) {
  auto next = ahead_.cbegin();
  if (prediction_ && t_s - predicted_since_s_ < kPredictionReuse_s) {
    next = std::upper_bound(next, end, last_propagated_, comes_before);
  } else {
    prediction_ = tracker_->prediction();
    predicted_since_s_ = t_s;
  }
  for (; next != end; ++next) filter().carry(*prediction_, *next);
  last_propagated_ = *std::prev(end);
  return filter().estimate(*prediction_);
}

void Localizer::note_odometry_time(double t_s) noexcept {
  const bool paused = t_s - last_odometry_s_ > filter::Tracker::kSilent_s;
  if (last_odometry_s_ != kNotYet_s && paused) paused_until_s_ = t_s;
  last_odometry_s_ = std::max(last_odometry_s_, t_s);
}

std::optional<diagnosis::Finding> Localizer::finding() const {
  if (tracker_->reason() != filter::Reason::kMapMismatch) return std::nullopt;
  if (!tracker_->started()) return diagnosis::map_mismatch({});
  return diagnosis::map_mismatch(tracker_->map_watch().share());
}

void Localizer::on_range(const model::RangeSample& range) {
  const filter::RangeResult result = tracker_->process(in_own_time(range));
  if (setup_.on_range) setup_.on_range(range, result);
}

void Localizer::on_pose_prior(const model::PoseSample& sample) {
  if (tracker_->started()) return;
  const model::PoseSample pose = in_own_time(sample);
  const auto prior = filter::start_from_prior(std::span(&pose, 1), pose.t_s, setup_.surface);
  if (prior) begin(*prior);
}

void Localizer::on_initial_pose(const model::PoseSample& sample) {
  const model::PoseSample pose = in_own_time(sample);
  auto start = filter::start_from_prior(std::span(&pose, 1), pose.t_s, setup_.surface);
  if (!start) return;
  if (pose.covariance) {
    const Eigen::Matrix3d covariance = model::to_matrix(*pose.covariance);
    start->position_sigma_m = std::sqrt(std::max(covariance(0, 0), covariance(1, 1)));
    start->heading_sigma_rad = std::sqrt(covariance(2, 2));
  }
  begin(*start);
}

void Localizer::on_sensor(const model::SensorSample& sample) {
  if (const auto* rate = std::get_if<model::YawRateSample>(&sample)) remove_waiting_until(in_own_time(*rate));
  const filter::SensorResult result = tracker_->process(
      model::visit(sample, [this](const auto& of) { return model::SensorSample(in_own_time(of)); }));
  const bool implausible =
      result.outcome == filter::SensorOutcome::kJumped || result.outcome == filter::SensorOutcome::kBadValue;
  if (implausible) ++implausible_;
}

void Localizer::on_sensor_ahead(const model::SensorSample& sample) {
  if (const auto* rate = std::get_if<model::YawRateSample>(&sample)) insert_waiting(in_own_time(*rate));
}

void Localizer::on_clock_set() {
  forget_times();
  make_tracker();
}

void Localizer::on_clock_step(double step_s, bool found_late) {
  clock_s_ += step_s;
  tracker_->require_agreement(found_late);
  prediction_.reset();
}

void Localizer::forget_times() noexcept {
  ahead_.clear();
  prediction_.reset();
  clock_s_ = 0.0;
  last_odometry_s_ = kNotYet_s;
  paused_until_s_ = kNotYet_s;
}

PoseEstimate Localizer::pose_of(const filter::Estimate& estimate) const {
  PoseEstimate pose = pose_on(setup_.surface, estimate);
  pose.t_s += clock_s_;
  pose.state = tracker_->state();
  pose.reason = tracker_->reason();
  if (pose.state != filter::State::kTracking) return pose;
  if (times_suspect_) {
    pose.reason = filter::Reason::kOdometryTimes;
  } else if (tracker_->last_odometry_s() < paused_until_s_) {
    pose.reason = filter::Reason::kNoOdometry;
  } else if (!tracker_->is_certain(estimate.covariance)) {
    pose.reason = filter::Reason::kUncertain;
  }
  if (pose.reason != filter::Reason::kNone) pose.state = filter::State::kDegraded;
  return pose;
}

Localizer::Ahead::const_iterator Localizer::insert_waiting(const filter::MotionInput& input) {
  if (ahead_.size() == kMaxAhead) ahead_.erase(ahead_.begin());
  if (prediction_ && comes_before(input, last_propagated_)) prediction_.reset();
  const auto place = std::upper_bound(ahead_.begin(), ahead_.end(), input, comes_before);
  return ahead_.insert(place, input) + 1;
}

void Localizer::remove_waiting_until(const filter::MotionInput& input) {
  ahead_.erase(ahead_.begin(), std::upper_bound(ahead_.begin(), ahead_.end(), input, comes_before));
}

void Localizer::archive(model::StateArchive& state) {
  state(setup_.tags, setup_.calibration);
  if (state.reads()) make_tracker();
  state(*tracker_, next_start_, ahead_, last_odometry_s_, paused_until_s_, clock_s_, times_suspect_,
        prediction_, predicted_since_s_, last_propagated_, implausible_);
}

void Localizer::make_tracker() {
  tracker_ = std::make_unique<filter::Tracker>(setup_.surface, setup_.tags, setup_.calibration, setup_.filter,
                                               setup_.tracker);
}

}  // namespace groma::daemon
