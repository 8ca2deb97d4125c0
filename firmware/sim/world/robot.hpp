// The simulated robot: a body that follows a path over the ground, and what its sensors tell of it.
#pragma once

#include <cstdint>

#include "firmware/sim/keyed_random.hpp"
#include "firmware/sim/world/path.hpp"
#include "host/model/pose.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::sim {

struct OdometryOptions {
  double rate_hz = 50.0;
  model::OdometryNoise noise{0.02, 0.02, 0.006};
  double scale_sigma = 0.01;                 // of one factor for both velocities, constant
  double yaw_rate_bias_sigma_radps = 0.001;  // constant
};

struct PosePriorOptions {
  double rate_hz = 10.0;
  double correlated_sigma_m = 0.02;  // in x and in y, over correlation_s
  double correlated_sigma_rad = 0.003;
  double correlation_s = 10.0;
  double white_sigma_m = 0.01;
  double white_sigma_rad = 0.002;
};

// Velocity of base_link in its own axes: the tangent plane's, and about its normal.
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
  // yaw_rad is the heading on the surface; roll and pitch are left unknown.
  [[nodiscard]] model::PoseSample truth(double t_s) const noexcept;

  // Row k holds from k / rate to (k + 1) / rate: the mean velocity over its interval, with noise, scale and
  // bias.
  [[nodiscard]] model::OdometrySample odometry(std::uint64_t k) const;
  // Row k is of k / rate: what the robot's own localization tells.
  [[nodiscard]] model::PoseSample pose_prior(std::uint64_t k) const;

  [[nodiscard]] const OdometryOptions& odometry_options() const noexcept { return odometry_; }
  [[nodiscard]] const PosePriorOptions& pose_prior_options() const noexcept { return prior_; }
  [[nodiscard]] const Path& path() const noexcept { return path_; }
  [[nodiscard]] const model::Surface& ground() const noexcept { return ground_; }

 private:
  model::Surface ground_;
  Path path_;
  OdometryOptions odometry_;
  PosePriorOptions prior_;
  KeyedRandom random_;
};

}  // namespace groma::sim
