// Which odometry samples can be the robot's at all, whatever it drives on, and how far one that can be is to
// be believed.
#pragma once

#include <cstddef>

#include "host/model/types.hpp"

namespace groma::filter {

// Whether a robot can change from one sample's velocities to the other's, whatever the time between them. The
// bounds, 7 m/s and 8 rad/s, are twice the largest change from sample to sample of a robot in the recorded
// drives, 3.5 m/s (plaza1, 5 Hz) and 3.9 rad/s (labyrinth, 8 Hz); simulated ones have 0.15 m/s and 0.07
// rad/s. A rig that was held in a hand has 4.9 m/s and 7.4 rad/s (inrol_env1, 50 Hz).
[[nodiscard]] bool follows(const model::OdometrySample& before, const model::OdometrySample& sample) noexcept;

// A sample that no robot can do is dropped, and the sample before it holds on.
class OdometryGate {
 public:
  // Whether the sample can follow the last one that was accepted; before the first, a stationary robot.
  // Dropped samples that follow each other for long enough are believed: no wrong sample locks out the right
  // ones.
  [[nodiscard]] bool accepts(const model::OdometrySample& sample) noexcept;

 private:
  model::OdometrySample accepted_{};
  // The last of those that were dropped since, which follow each other, their number, and the first one's
  // time.
  model::OdometrySample dropped_{};
  std::size_t dropped_count_ = 0;
  double dropped_since_s_ = 0.0;
};

// Variances that a row's noise has beyond OdometryNoise, and what the pose deserves at once.
struct OdometryDoubt {
  double velocity_m2ps2 = 0.0;  // of each axis, white from row to row
  double turn_rad2ps2 = 0.0;
  double position_m2 = 0.0;  // of each axis, for what went wrong before it showed
  double heading_rad2 = 0.0;
};

// An error lasts, while a row's noise is white: as that it has to be larger by this factor for the same way.
[[nodiscard]] double white_factor(double lasts_s, double gap_s) noexcept;

// No robot changes its velocity faster than its wheels can push. Where odometry does, wheels slip, or what
// computes it is wrong.
class OdometryWatch {
 public:
  explicit OdometryWatch(double max_acceleration_mps2) : max_acceleration_mps2_(max_acceleration_mps2) {}

  // Of a row that follows another one, both of that white noise.
  OdometryDoubt judge(const model::OdometrySample& before, const model::OdometrySample& row,
                      const model::OdometryNoise& noise) noexcept;
  // Rows that jumped.
  [[nodiscard]] std::size_t jumps() const noexcept { return jumps_; }

 private:
  double max_acceleration_mps2_;
  double excess_m2ps2_ = 0.0;  // fading squares of what jumps were too large by
  double turn_excess_rad2ps2_ = 0.0;
  std::size_t jumps_ = 0;
};

}  // namespace groma::filter
