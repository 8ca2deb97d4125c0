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

PoseEstimate pose_on(const model::Surface& surface, const model::PlanarPose& planar,
                     const Eigen::Matrix3d& planar_covariance) noexcept {
  const model::SurfacePose on_surface = model::pose_on_surface(surface, planar);
  const Eigen::Matrix3d& rotation = on_surface.pose.rotation;
  PoseEstimate pose;
  pose.x_m = planar.x_m;
  pose.y_m = planar.y_m;
  pose.z_m = on_surface.pose.position_m.z();
  // R_WR = R_z(yaw) R_y(pitch) R_x(roll): its last row is (-sin p, cos p sin r, cos p cos r).
  const double cos_pitch = std::hypot(rotation(2, 1), rotation(2, 2));
  pose.roll_rad = std::atan2(rotation(2, 1), rotation(2, 2));
  pose.pitch_rad = std::atan2(-rotation(2, 0), cos_pitch);
  pose.yaw_rad = model::wrap_angle(planar.theta_rad);

  Eigen::Matrix<double, 6, 3> d_planar = Eigen::Matrix<double, 6, 3>::Zero();
  d_planar.topLeftCorner<3, 2>() = on_surface.d_position_d_xy;
  const std::array<const Eigen::Matrix3d*, 3> d_rotation{
      &on_surface.d_rotation_d_x, &on_surface.d_rotation_d_y, &on_surface.d_rotation_d_theta};
  for (int i = 0; i < 3; ++i) {
    const Eigen::RowVector3d d_row = d_rotation[static_cast<std::size_t>(i)]->row(2);
    d_planar(3, i) = (d_row.y() * rotation(2, 2) - rotation(2, 1) * d_row.z()) / (cos_pitch * cos_pitch);
    d_planar(4, i) = -d_row.x() / cos_pitch;
  }
  d_planar(5, 2) = 1.0;
  pose.planar_covariance = planar_covariance;
  pose.covariance = d_planar * planar_covariance * d_planar.transpose();
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
  PoseEstimate pose = pose_on(setup_.surface, estimate.pose, estimate.covariance);
  pose.t_s = estimate.t_s;
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
