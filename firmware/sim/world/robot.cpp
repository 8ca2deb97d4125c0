#include "firmware/sim/world/robot.hpp"

#include <array>
#include <cmath>
#include <utility>

#include "firmware/sim/world/smooth_noise.hpp"

namespace groma::sim {

namespace {

enum Purpose : std::uint64_t {
  kScale,
  kYawRateBias,
  kOdometryRow,
  kPriorRow,
  kPriorX,
  kPriorY,
  kPriorYaw,
  kWheelbase,
  kSteeringOffset,
};

// Gauss-Legendre quadrature, three points on (0, 1).
constexpr std::array<double, 3> kNodes = {0.11270166537925831, 0.5, 0.88729833462074169};
constexpr std::array<double, 3> kWeights = {5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0};

}  // namespace

Robot::Robot(model::Surface ground, Path path, const OdometryOptions& odometry, const PosePriorOptions& prior,
             const KeyedRandom& random)
    : ground_(std::move(ground)),
      path_(std::move(path)),
      odometry_(odometry),
      prior_(prior),
      random_(random) {}

model::SurfacePose Robot::pose(double t_s) const noexcept {
  const PlanarMotion motion = path_.at(t_s);
  return model::pose_on_surface(ground_, {motion.x_m, motion.y_m, motion.theta_rad});
}

BodyVelocity Robot::velocity(double t_s) const noexcept {
  const PlanarMotion motion = path_.at(t_s);
  const model::SurfacePose pose = model::pose_on_surface(ground_, {motion.x_m, motion.y_m, motion.theta_rad});
  const Eigen::Matrix3d& r = pose.pose.rotation;
  const Eigen::Vector3d in_map = pose.d_position_d_xy * Eigen::Vector2d(motion.vx_mps, motion.vy_mps);
  const Eigen::Vector3d in_body = r.transpose() * in_map;
  const Eigen::Matrix3d rate =
      r.transpose() * (pose.d_rotation_d_x * motion.vx_mps + pose.d_rotation_d_y * motion.vy_mps +
                       pose.d_rotation_d_theta * motion.theta_radps);
  return {in_body.x(), in_body.y(), rate(1, 0)};
}

model::PoseSample Robot::truth(double t_s) const noexcept {
  const PlanarMotion motion = path_.at(t_s);
  model::PoseSample sample;
  sample.t_s = t_s;
  sample.x_m = motion.x_m;
  sample.y_m = motion.y_m;
  sample.z_m = ground_.at(motion.x_m, motion.y_m).z_m;
  sample.yaw_rad = model::wrap_angle(motion.theta_rad);
  return sample;
}

model::OdometrySample Robot::mean_velocity(std::uint64_t k) const {
  const double interval_s = 1.0 / odometry_.rate_hz;
  model::OdometrySample row;
  row.t_s = static_cast<double>(k) / odometry_.rate_hz;
  for (std::size_t i = 0; i < kNodes.size(); ++i) {
    const BodyVelocity v = velocity(row.t_s + kNodes[i] * interval_s);
    row.vx_mps += kWeights[i] * v.vx_mps;
    row.vy_mps += kWeights[i] * v.vy_mps;
    row.omega_radps += kWeights[i] * v.omega_radps;
  }
  for (const WheelSlip& slip : odometry_.slips) {
    if (row.t_s < slip.from_s || row.t_s >= slip.to_s) continue;
    row.vx_mps *= slip.scale;
    row.vy_mps *= slip.scale;
  }
  return row;
}

double Robot::noise_factor(double t_s) const noexcept {
  double out = 1.0;
  const PlanarMotion at = path_.at(t_s);
  for (const SlipperyArea& area : odometry_.areas) {
    if (at.x_m >= area.from_m.x() && at.x_m <= area.to_m.x() && at.y_m >= area.from_m.y() &&
        at.y_m <= area.to_m.y())
      out = area.noise_factor;
  }
  return out;
}

model::OdometrySample Robot::odometry(std::uint64_t k) const {
  if (odometry_.car) return model::to_odometry(steering(k), odometry_.car->vehicle);
  model::OdometrySample row = mean_velocity(k);
  const double scale = 1.0 + random_.of(kScale).normal(0.0, odometry_.scale_sigma);
  const double bias_radps = random_.of(kYawRateBias).normal(0.0, odometry_.yaw_rate_bias_sigma_radps);
  const KeyedRandom white = random_.of(kOdometryRow, k);
  const double noise = noise_factor(row.t_s);
  row.vx_mps = scale * row.vx_mps + white.of(0).normal(0.0, noise * odometry_.noise.sigma_vx_mps);
  row.vy_mps = scale * row.vy_mps + white.of(1).normal(0.0, noise * odometry_.noise.sigma_vy_mps);
  row.omega_radps += bias_radps + white.of(2).normal(0.0, noise * odometry_.noise.sigma_omega_radps);
  return row;
}

model::SteeringSample Robot::steering(std::uint64_t k) const {
  constexpr double kStands_mps = 1e-3;
  const CarOdometryOptions& car = *odometry_.car;
  const model::OdometrySample moved = mean_velocity(k);
  const double wheelbase_m =
      car.vehicle.wheelbase_m * (1.0 + random_.of(kWheelbase).normal(0.0, car.wheelbase_scale_sigma));
  const double rolled_rad =
      std::abs(moved.vx_mps) < kStands_mps ? 0.0 : std::atan(moved.omega_radps * wheelbase_m / moved.vx_mps);
  const KeyedRandom white = random_.of(kOdometryRow, k);
  const double noise = noise_factor(moved.t_s);
  model::SteeringSample row{.t_s = moved.t_s};
  row.speed_mps = moved.vx_mps * (1.0 + random_.of(kScale).normal(0.0, odometry_.scale_sigma)) +
                  white.of(0).normal(0.0, noise * car.vehicle.sigma_speed_mps);
  row.steering_rad = rolled_rad * (1.0 + car.understeer_s2pm2 * moved.vx_mps * moved.vx_mps) +
                     random_.of(kSteeringOffset).normal(0.0, car.steering_offset_sigma_rad) +
                     white.of(1).normal(0.0, noise * car.vehicle.sigma_steering_rad);
  return row;
}

model::PoseSample Robot::pose_prior(std::uint64_t k) const {
  model::PoseSample row = truth(static_cast<double>(k) / prior_.rate_hz);
  // The correlation of a cubic B-spline over independent draws falls to one half after 1.4 knots.
  const double u = row.t_s / (0.5 * prior_.correlation_s);
  const KeyedRandom white = random_.of(kPriorRow, k);
  row.x_m += prior_.correlated_sigma_m * smooth_noise(random_.of(kPriorX), u) +
             white.of(0).normal(0.0, prior_.white_sigma_m);
  row.y_m += prior_.correlated_sigma_m * smooth_noise(random_.of(kPriorY), u) +
             white.of(1).normal(0.0, prior_.white_sigma_m);
  row.yaw_rad =
      model::wrap_angle(row.yaw_rad + prior_.correlated_sigma_rad * smooth_noise(random_.of(kPriorYaw), u) +
                        white.of(2).normal(0.0, prior_.white_sigma_rad));
  row.z_m = ground_.at(row.x_m, row.y_m).z_m;
  return row;
}

}  // namespace groma::sim
