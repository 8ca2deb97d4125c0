#include "host/model/steering.hpp"

#include <gtest/gtest.h>

#include <cmath>

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace groma::model {
namespace {

// Moves the two axles by their own directions, in small steps: the rear axle rolls along the vehicle, the
// front axle along its wheel.
TEST(Steering, MovesBothAxlesAlongTheirWheels) {
  const Steering vehicle{.wheelbase_m = 1.6, .rear_axle_x_m = -0.4};
  const SteeringSample sample{.t_s = 2.0, .speed_mps = -0.8, .steering_rad = 0.35};
  const OdometrySample found = to_odometry(sample, vehicle);
  EXPECT_EQ(found.t_s, 2.0);

  constexpr double kStep_s = 1e-5;
  constexpr int kSteps = 100'000;
  Eigen::Vector2d rear_m(vehicle.rear_axle_x_m, 0.0);
  Eigen::Vector2d front_m(vehicle.rear_axle_x_m + vehicle.wheelbase_m, 0.0);
  for (int i = 0; i < kSteps; ++i) {
    const Eigen::Vector2d along = (front_m - rear_m).normalized();
    const Eigen::Vector2d wheel = Eigen::Rotation2Dd(sample.steering_rad) * along;
    rear_m += kStep_s * sample.speed_mps * along;
    // The front axle keeps its distance.
    front_m += kStep_s * sample.speed_mps / wheel.dot(along) * wheel;
  }
  const Eigen::Vector2d along = (front_m - rear_m).normalized();
  const double yaw_rad = kStep_s * kSteps * found.omega_radps;
  EXPECT_NEAR(std::atan2(along.y(), along.x()), yaw_rad, 1e-4);
  // base_link on the arc of a circle.
  const double s = std::sin(yaw_rad) / found.omega_radps;
  const double c = (1.0 - std::cos(yaw_rad)) / found.omega_radps;
  const Eigen::Vector2d base_m(s * found.vx_mps - c * found.vy_mps, c * found.vx_mps + s * found.vy_mps);
  EXPECT_LT((rear_m - vehicle.rear_axle_x_m * along - base_m).norm(), 1e-4);
}

TEST(Steering, NoiseOfTheYawRateIsThatOfTheSteering) {
  const Steering vehicle{.wheelbase_m = 2.0, .sigma_speed_mps = 0.03, .sigma_steering_rad = 0.02};
  const OdometryNoise noise = noise_of(vehicle);
  EXPECT_EQ(noise.sigma_vx_mps, 0.03);
  EXPECT_EQ(noise.sigma_vy_mps, vehicle.sigma_side_mps);
  EXPECT_EQ(noise.sigma_curve, vehicle.sigma_curve);
  const double ahead = to_odometry({.speed_mps = 1.0, .steering_rad = 0.02}, vehicle).omega_radps;
  EXPECT_NEAR(noise.sigma_omega_radps, ahead, 1e-4 * ahead + 1e-6);
}

}  // namespace
}  // namespace groma::model
