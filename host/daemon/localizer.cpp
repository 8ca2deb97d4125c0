#include "host/daemon/localizer.hpp"

#include <algorithm>
#include <limits>
#include <memory>
#include <span>
#include <utility>
#include <variant>

#include "host/filter/replay.hpp"

namespace groma::daemon {

namespace {

constexpr double kNothingYet_s = -std::numeric_limits<double>::infinity();

// By time, odometry before yaw rates, as a session passes them on.
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
  pose.planar_covariance = estimate.covariance;
  pose.covariance = at.covariance;
  if (surface.chart_count() > 1) pose.floor = surface.charts()[static_cast<std::size_t>(at.chart)].name;
  return pose;
}

Localizer::Localizer(Setup setup, OnPose on_pose, OnPose on_settled)
    : setup_(std::move(setup)),
      on_pose_(std::move(on_pose)),
      on_settled_(std::move(on_settled)),
      last_row_s_(kNothingYet_s) {
  ahead_.reserve(kMaxAhead);
  renew();
}

void Localizer::adopt(model::Calibration calibration) {
  setup_.calibration = std::move(calibration);
  const std::unique_ptr<filter::Tracker> before = std::move(tracker_);
  renew();
  if (before->started()) tracker_->resume(*before);
}

void Localizer::start(const filter::Start& start) {
  tracker_->start(start);
}

void Localizer::on_odometry(const model::OdometrySample& row) {
  arrived(row);
  const filter::OdometryOutcome outcome = tracker_->process(row);
  const bool has_waited = row.t_s <= last_row_s_;
  last_row_s_ = std::max(last_row_s_, row.t_s);
  if (!tracker_->started() || outcome != filter::OdometryOutcome::kUsed) return;
  if (!has_waited) on_pose_(pose_of(tracker_->filter().row_estimate()));
  if (on_settled_) on_settled_(pose_of(tracker_->estimate()));
}

void Localizer::on_odometry_ahead(const model::OdometrySample& row) {
  const auto end = await(row);
  last_row_s_ = std::max(last_row_s_, row.t_s);
  if (tracker_->started()) on_pose_(pose_of(filter().predict({ahead_.cbegin(), end})));
}

void Localizer::on_range(const model::RangeSample& range) {
  tracker_->process(range);
}

void Localizer::on_pose_prior(const model::PoseSample& pose) {
  if (tracker_->started()) return;
  if (const auto prior = filter::start_from_prior(std::span(&pose, 1), pose.t_s, setup_.surface))
    start(*prior);
}

void Localizer::on_sensor(const model::SensorSample& sample) {
  if (const auto* rate = std::get_if<model::YawRateSample>(&sample)) arrived(*rate);
  std::visit([this](const auto& of) { tracker_->process(of); }, sample);
}

void Localizer::on_sensor_ahead(const model::SensorSample& sample) {
  if (const auto* rate = std::get_if<model::YawRateSample>(&sample)) await(*rate);
}

void Localizer::on_clock_set() {
  ahead_.clear();
  last_row_s_ = kNothingYet_s;
  renew();
}

PoseEstimate Localizer::pose_of(const filter::Estimate& estimate) const {
  PoseEstimate pose = pose_on(setup_.surface, estimate);
  pose.state = tracker_->state();
  pose.reason = tracker_->reason();
  return pose;
}

Localizer::Ahead::const_iterator Localizer::await(const filter::MotionInput& input) {
  if (ahead_.size() == kMaxAhead) ahead_.erase(ahead_.begin());
  const auto place = std::upper_bound(ahead_.begin(), ahead_.end(), input, comes_before);
  return ahead_.insert(place, input) + 1;
}

void Localizer::arrived(const filter::MotionInput& input) {
  ahead_.erase(ahead_.begin(), std::upper_bound(ahead_.begin(), ahead_.end(), input, comes_before));
}

void Localizer::renew() {
  tracker_ = std::make_unique<filter::Tracker>(setup_.surface, setup_.tags, setup_.calibration, setup_.filter,
                                               setup_.tracker);
}

}  // namespace groma::daemon
