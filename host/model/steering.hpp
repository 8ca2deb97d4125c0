// Odometry of a car-like vehicle: wheel speed and steering angle, by the bicycle model.
#pragma once

#include <cmath>

#include "host/model/types.hpp"

namespace groma::model {

struct SteeringSample {
  double t_s = 0.0;
  double speed_mps = 0.0;     // of the middle of the rear axle; negative in reverse
  double steering_rad = 0.0;  // of the front wheel; positive to the left
};

// A vehicle whose rear axle is parallel to base_link's y. The sigmas are of white noise, but for sigma_curve.
struct Steering {
  double wheelbase_m = 1.0;
  double rear_axle_x_m = 0.0;  // of the rear axle's middle in base_link
  double sigma_speed_mps = 0.05;
  double sigma_steering_rad = 0.01;
  double sigma_side_mps = 0.02;  // of the rear axle's sideways slip
  double sigma_curve = 0.03;     // of the relative error of the yaw rate in a curve: wheelbase, understeer
};

// Nearly a quarter turn: no front wheel turns further. In other units it would be more.
inline constexpr double kMostSteering_rad = 1.5;

// The velocity of base_link. Not finite for a steering angle of a quarter turn, or what is not finite.
[[nodiscard]] inline OdometrySample to_odometry(const SteeringSample& sample,
                                                const Steering& vehicle) noexcept {
  const double omega_radps = sample.speed_mps * std::tan(sample.steering_rad) / vehicle.wheelbase_m;
  return {sample.t_s, sample.speed_mps, -omega_radps * vehicle.rear_axle_x_m, omega_radps};
}

// The noise of such a sample. The yaw rate's grows with the speed: this is that of straight travel at a speed
// by hand, from which the filter adapts it to the samples.
[[nodiscard]] inline OdometryNoise noise_of(const Steering& vehicle) noexcept {
  constexpr double kSpeed_mps = 1.0;
  const double sigma_radps = kSpeed_mps * vehicle.sigma_steering_rad / vehicle.wheelbase_m;
  return {vehicle.sigma_speed_mps, std::hypot(vehicle.sigma_side_mps, sigma_radps * vehicle.rear_axle_x_m),
          sigma_radps, vehicle.sigma_curve};
}

}  // namespace groma::model
