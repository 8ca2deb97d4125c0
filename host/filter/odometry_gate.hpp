// Plausibility of odometry: rejects physically impossible samples and inflates the noise of samples that
// jump.
#pragma once

#include <cstddef>

#include "host/model/types.hpp"

namespace groma::filter {

// Whether a robot can change from one sample's velocities to the other's, whatever the time between them. The
// bounds, 7 m/s and 8 rad/s, are twice the largest change between consecutive samples of a robot in the
// recorded drives, 3.5 m/s (plaza1, 5 Hz) and 3.9 rad/s (labyrinth, 8 Hz). Simulated drives reach 0.15 m/s
// and 0.07 rad/s, a handheld rig 4.9 m/s and 7.4 rad/s (inrol_env1, 50 Hz).
[[nodiscard]] bool follows(const model::OdometrySample& before, const model::OdometrySample& sample) noexcept;

// Drops physically impossible samples; the previous sample stays held.
class OdometryGate {
 public:
  // Whether the sample is plausible after the last accepted one (before the first: after a stationary robot).
  // Dropped samples that are consistent with each other for long enough are accepted, so that a wrong sample
  // cannot lock out the right ones.
  [[nodiscard]] bool accepts(const model::OdometrySample& sample) noexcept;

 private:
  model::OdometrySample accepted_{};
  // The current series of dropped samples consistent with each other: the last one, their number, and the
  // time of the first.
  model::OdometrySample dropped_{};
  std::size_t dropped_count_ = 0;
  double dropped_since_s_ = 0.0;
};

// Variances added to an odometry sample's noise, beyond OdometryNoise, and to the pose at once.
struct OdometryInflation {
  double velocity_m2ps2 = 0.0;  // of each axis, white from sample to sample
  double turn_rad2ps2 = 0.0;
  double position_m2 = 0.0;  // of each axis, for the error before it was detected
  double heading_rad2 = 0.0;
};

// Factor of variance by which a sample's white noise has to be larger for the same position variance as an
// error that lasts lasts_s; gap_s: interval between samples.
[[nodiscard]] double white_factor(double lasts_s, double gap_s) noexcept;

// Detects jumps of the odometry's velocity beyond the robot's possible acceleration: the wheels slip, or the
// odometry is computed wrongly.
class OdometryWatch {
 public:
  explicit OdometryWatch(double max_acceleration_mps2) : max_acceleration_mps2_(max_acceleration_mps2) {}

  // Additional variances of `sample`, which follows `before`; noise: the white noise of both.
  OdometryInflation judge(const model::OdometrySample& before, const model::OdometrySample& sample,
                          const model::OdometryNoise& noise) noexcept;
  // Number of samples that jumped.
  [[nodiscard]] std::size_t jumps() const noexcept { return jumps_; }

 private:
  double max_acceleration_mps2_;
  double excess_m2ps2_ = 0.0;  // squared excess of jumps, with exponential forgetting
  double turn_excess_rad2ps2_ = 0.0;
  std::size_t jumps_ = 0;
};

}  // namespace groma::filter
