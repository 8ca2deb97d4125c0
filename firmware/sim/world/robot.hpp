// The simulated robot: a body that follows a path on the ground, with odometry and pose priors.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "firmware/sim/keyed_random.hpp"
#include "firmware/sim/world/path.hpp"
#include "host/model/pose.hpp"
#include "host/model/steering.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::sim {

// A car's odometry: wheel speed and steering angle, with the vehicle as it is configured. base_link is at the
// rear axle.
struct CarOdometryOptions {
  model::Steering vehicle;
  double wheelbase_scale_sigma = 0.01;       // of the true wheelbase over the configured one, constant
  double steering_offset_sigma_rad = 0.002;  // of the constant error of the angle
  // In a curve the front wheels slip: the angle is 1 + understeer_s2pm2 v^2 times that of the bicycle model.
  double understeer_s2pm2 = 0.02;
};

// The wheels spin or slide: for a while the speed that they show is the true one times `scale`.
struct WheelSlip {
  double from_s = 0.0;
  double to_s = 0.0;
  double scale = 1.0;
};

// A rectangle of the floor plan on which wheels grip worse: the white noise is so many times as large.
struct SlipperyArea {
  Eigen::Vector2d from_m = Eigen::Vector2d::Zero();
  Eigen::Vector2d to_m = Eigen::Vector2d::Zero();
  double noise_factor = 1.0;
};

struct OdometryOptions {
  double rate_hz = 50.0;
  model::OdometryNoise noise{0.02, 0.02, 0.006};
  double scale_sigma = 0.01;                 // of the constant factor on both velocities
  double yaw_rate_bias_sigma_radps = 0.001;  // of the constant bias; not of a car
  std::optional<CarOdometryOptions> car{};
  std::vector<WheelSlip> slips{};
  std::vector<SlipperyArea> areas{};
};

// Of such a car, otherwise with the defaults.
[[nodiscard]] inline OdometryOptions odometry_of(const model::Steering& vehicle) {
  OdometryOptions out;
  out.noise = model::noise_of(vehicle);
  out.car = {.vehicle = vehicle};
  return out;
}

struct PosePriorOptions {
  double rate_hz = 10.0;
  double correlated_sigma_m = 0.02;  // in x and in y, with the correlation time correlation_s
  double correlated_sigma_rad = 0.003;
  double correlation_s = 10.0;
  double white_sigma_m = 0.01;
  double white_sigma_rad = 0.002;
};

// Velocity of base_link in its own axes: linear in the tangent plane, angular about its normal.
struct BodyVelocity {
  double vx_mps = 0.0;
  double vy_mps = 0.0;
  double omega_radps = 0.0;
};

class Robot {
 public:
  Robot(model::Surface ground, Path path, const OdometryOptions& odometry, const PosePriorOptions& prior,
        const KeyedRandom& random);

  [[nodiscard]] model::SurfacePose pose(double t_s) const noexcept;
  [[nodiscard]] BodyVelocity velocity(double t_s) const noexcept;
  // The ground truth. yaw_rad is the heading on the surface; roll and pitch are not set.
  [[nodiscard]] model::PoseSample truth(double t_s) const noexcept;

  // Sample k holds from k / rate to (k + 1) / rate: the mean velocity over its interval, with noise, scale
  // and bias.
  // A car's is that of its steering() by model::to_odometry().
  [[nodiscard]] model::OdometrySample odometry(std::uint64_t k) const;
  // The same sample of a car.
  [[nodiscard]] model::SteeringSample steering(std::uint64_t k) const;
  // Sample k is the pose at k / rate with the noise of PosePriorOptions, as from another localization system.
  [[nodiscard]] model::PoseSample pose_prior(std::uint64_t k) const;

  [[nodiscard]] const OdometryOptions& odometry_options() const noexcept { return odometry_; }
  [[nodiscard]] const PosePriorOptions& pose_prior_options() const noexcept { return prior_; }
  [[nodiscard]] const Path& path() const noexcept { return path_; }
  [[nodiscard]] const model::Surface& ground() const noexcept { return ground_; }

 private:
  // The mean over the interval of sample k, without errors but slips.
  [[nodiscard]] model::OdometrySample mean_velocity(std::uint64_t k) const;
  [[nodiscard]] double noise_factor(double t_s) const noexcept;

  model::Surface ground_;
  Path path_;
  OdometryOptions odometry_;
  PosePriorOptions prior_;
  KeyedRandom random_;
};

}  // namespace groma::sim
