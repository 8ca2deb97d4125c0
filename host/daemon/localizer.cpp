#include "host/daemon/localizer.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <span>
#include <utility>
#include <variant>

#include <Eigen/Eigenvalues>

#include "host/filter/replay.hpp"

namespace groma::daemon {

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

Localizer::Localizer(Setup setup, std::function<void(const PoseEstimate&)> on_pose)
    : setup_(std::move(setup)), on_pose_(std::move(on_pose)) {
  renew();
}

void Localizer::adopt(model::Calibration calibration) {
  setup_.calibration = std::move(calibration);
  const bool started = tracker_->started();
  const filter::State state = tracker_->state();
  const filter::Estimate estimate = tracker_->estimate();
  renew();
  if (!started) return;
  const Eigen::Matrix2d position = estimate.covariance.topLeftCorner<2, 2>();
  const double variance_m2 = position.selfadjointView<Eigen::Lower>().eigenvalues()(1);
  tracker_->start({.t_s = estimate.t_s,
                   .pose = estimate.pose,
                   .position_sigma_m = std::sqrt(std::max(variance_m2, 0.0)),
                   .heading_sigma_rad = std::sqrt(std::max(estimate.covariance(2, 2), 0.0))},
                  state);
}

void Localizer::start(const filter::Start& start) {
  tracker_->start(start);
}

void Localizer::on_odometry(const model::OdometrySample& row) {
  const filter::OdometryOutcome outcome = tracker_->process(row);
  if (!tracker_->started() || outcome != filter::OdometryOutcome::kUsed) return;
  const filter::Estimate estimate = tracker_->estimate();
  PoseEstimate pose = pose_on(setup_.surface, estimate);
  pose.state = tracker_->state();
  pose.reason = tracker_->reason();
  on_pose_(pose);
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
  std::visit([this](const auto& of) { tracker_->process(of); }, sample);
}

void Localizer::on_clock_set() {
  renew();
}

void Localizer::renew() {
  tracker_ = std::make_unique<filter::Tracker>(setup_.surface, setup_.tags, setup_.calibration, setup_.filter,
                                               setup_.tracker);
}

}  // namespace groma::daemon
