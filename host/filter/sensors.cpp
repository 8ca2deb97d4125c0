#include "host/filter/sensors.hpp"

#include <algorithm>
#include <cmath>

#include "host/filter/propagation.hpp"
#include "host/model/plausible.hpp"

namespace groma::filter {

namespace {

using model::square;

// Huber threshold on the root mean square in sigmas; beyond it the weight is (threshold / rms)^2. Statistics:
// chi-square exceeds it with 1.2e-4 (2 components) or 6e-6 (3 components).
constexpr double kHuberThreshold = 3.0;
// Beyond the gate a sample is refused, unless no sample of its sensor was within it for kSensorPatience_s.
// Statistics: no Gaussian noise reaches 10 sigmas. The time is chosen by hand.
constexpr double kGateSigmas = 10.0;
constexpr double kSensorPatience_s = 2.0;

}  // namespace

CoreMeasurement<2> measure(const SensorView& state, const model::PositionSample& sample) noexcept {
  const PresentPose& now = state.now;
  const Eigen::Vector3d& lever_arm = state.config.position_lever_arm_m;
  const model::SurfacePose pose =
      model::pose_on_surface(state.surface, {now.pose.x(), now.pose.y(), now.pose.z(), now.chart});
  const Eigen::Vector3d antenna = pose.pose.rotation * lever_arm;
  Eigen::Matrix3d d_antenna;
  d_antenna << pose.d_rotation_d_x * lever_arm, pose.d_rotation_d_y * lever_arm,
      pose.d_rotation_d_theta * lever_arm;
  Eigen::Matrix<double, 2, 3> d_pose = d_antenna.topRows<2>();
  d_pose.leftCols<2>() += Eigen::Matrix2d::Identity();
  const auto& [xx, xy, yy] = sample.covariance_m2;

  CoreMeasurement<2> out;
  out.innovation << sample.x_m - now.pose.x() - antenna.x(), sample.y_m - now.pose.y() - antenna.y();
  out.d_core = d_pose.lazyProduct(now.d_core);
  out.noise << xx, xy, xy, yy;
  out.noise += (d_pose * now.noise).lazyProduct(d_pose.transpose());
  return out;
}

CoreMeasurement<3> measure(const SensorView& state, const model::PoseSample& sample) noexcept {
  const PresentPose& now = state.now;
  CoreMeasurement<3> out;
  out.innovation << sample.x_m - now.pose.x(), sample.y_m - now.pose.y(),
      model::wrap_angle(place_on(state.surface, sample).theta_rad - now.pose.z());
  out.d_core = now.d_core;
  out.noise = model::to_matrix(*sample.covariance) + now.noise;
  return out;
}

model::PlanarPose place_on(const model::Surface& surface, const model::PoseSample& pose) noexcept {
  model::PlanarPose out{pose.x_m, pose.y_m, pose.yaw_rad, surface.nearest(pose.x_m, pose.y_m, pose.z_m)};
  if (!std::isfinite(pose.roll_rad) || !std::isfinite(pose.pitch_rad)) return out;
  const Eigen::Matrix3d tilt = model::surface_rotation(surface.at(pose.x_m, pose.y_m, out.chart).gradient);
  const Eigen::Matrix3d turn =
      tilt.transpose() * model::rotation_from_zyx(pose.yaw_rad, pose.pitch_rad, pose.roll_rad);
  out.theta_rad = std::atan2(turn(1, 0), turn(0, 0));
  return out;
}

CoreMeasurement<3> measure(const SensorView& state, const model::ZeroVelocitySample& /*sample*/) noexcept {
  const BodyVelocity velocity = body_velocity(state.core, state.odometry);
  CoreMeasurement<3> out;
  out.innovation << -velocity.value.head<2>(),
      state.core(kYawBias) + state.core(kOdometryOmega) - state.odometry.omega_radps;
  out.d_core = velocity.d_core;
  const double variance_m2ps2 = square(state.config.standing_sigma_mps);
  out.noise =
      Eigen::Vector3d(variance_m2ps2, variance_m2ps2, square(state.config.standing_sigma_radps)).asDiagonal();
  return out;
}

bool is_usable(const model::YawRateSample& sample) noexcept {
  return std::isfinite(sample.t_s + sample.omega_radps);
}
bool is_usable(const model::PositionSample& sample) noexcept {
  return model::is_plausible(sample);
}
bool is_usable(const model::PoseSample& sample) noexcept {
  return sample.covariance && model::is_plausible(sample);
}
bool is_usable(const model::ZeroVelocitySample& sample) noexcept {
  return std::isfinite(sample.t_s);
}

SampleKey key_of(const model::YawRateSample& sample) noexcept {
  return {sample.t_s, sample.omega_radps};
}
SampleKey key_of(const model::PositionSample& sample) noexcept {
  return {sample.t_s, sample.x_m, sample.y_m, sample.covariance_m2[0]};
}
SampleKey key_of(const model::PoseSample& sample) noexcept {
  return {sample.t_s, sample.x_m, sample.y_m, sample.yaw_rad};
}
SampleKey key_of(const model::ZeroVelocitySample& sample) noexcept {
  return {sample.t_s};
}

double SensorGate::weigh(std::size_t sensor, double t_s, double mean_square) noexcept {
  if (!std::isfinite(mean_square)) return 0.0;
  Times& times = times_[sensor];
  if (t_s - times.seen_s > kSensorPatience_s) times.heard_s = t_s;
  times.seen_s = t_s;
  if (!(mean_square > square(kGateSigmas))) {
    times.heard_s = t_s;
  } else if (t_s - times.heard_s < kSensorPatience_s) {
    return 0.0;
  }
  return std::min(square(kHuberThreshold) / mean_square, 1.0);
}

}  // namespace groma::filter
