#include "host/simulation/robot_feed.hpp"

#include <fmt/format.h>

#include <cmath>
#include <iterator>

namespace groma::simulation {

namespace {

std::uint64_t first_at_or_after(double t_s, double rate_hz) {
  return static_cast<std::uint64_t>(std::ceil(t_s * rate_hz - 1e-6));
}

double time_of(std::uint64_t index, double rate_hz) {
  return static_cast<double>(index) / rate_hz;
}

}  // namespace

RobotFeed::RobotFeed(const sim::Robot& robot, double from_s)
    : robot_(robot),
      next_odometry_(first_at_or_after(from_s, robot.odometry_options().rate_hz)),
      next_prior_(first_at_or_after(from_s, robot.pose_prior_options().rate_hz)) {}

void RobotFeed::lines_until(double t_s, std::string& out) {
  for (;;) {
    const double odometry_s = time_of(next_odometry_, robot_.odometry_options().rate_hz);
    const double prior_s = time_of(next_prior_, robot_.pose_prior_options().rate_hz);
    if (odometry_s > t_s && prior_s > t_s) return;
    if (odometry_s <= prior_s && robot_.odometry_options().car) {
      const model::SteeringSample sample = robot_.steering(next_odometry_++);
      fmt::format_to(std::back_inserter(out),
                     "{{\"class\":\"STEERING\",\"t_s\":{},\"speed_mps\":{},\"steering_rad\":{}}}\n",
                     sample.t_s, sample.speed_mps, sample.steering_rad);
    } else if (odometry_s <= prior_s) {
      const model::OdometrySample sample = robot_.odometry(next_odometry_++);
      fmt::format_to(std::back_inserter(out),
                     "{{\"class\":\"ODOMETRY\",\"t_s\":{},\"vx_mps\":{},\"vy_mps\":{},\"omega_radps\":{}}}\n",
                     sample.t_s, sample.vx_mps, sample.vy_mps, sample.omega_radps);
    } else {
      const model::PoseSample pose = robot_.pose_prior(next_prior_++);
      fmt::format_to(
          std::back_inserter(out),
          "{{\"class\":\"POSE_PRIOR\",\"t_s\":{},\"x_m\":{},\"y_m\":{},\"z_m\":{},\"yaw_rad\":{}}}\n",
          pose.t_s, pose.x_m, pose.y_m, pose.z_m, pose.yaw_rad);
    }
  }
}

}  // namespace groma::simulation
