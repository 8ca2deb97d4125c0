// The frame odom of REP-105: base_link's pose by odometry alone, continuous but with drift.
#pragma once

#include <optional>

#include "host/model/pose.hpp"
#include "host/model/state_archive.hpp"
#include "host/model/types.hpp"

namespace groma::model {

// Of base_link in odom.
struct OdomPose {
  double t_s = 0.0;
  QuaternionPose pose;
  bool is_integrated = false;  // here, from velocities; otherwise the robot gave it
};

// Integrates the velocities of odometry, from the origin of odom on.
class OdomFrame {
 public:
  // A longer gap between samples counts as this: the robot may have stopped.
  static constexpr double kLongestHold_s = 0.5;

  // Samples in the order of time; each holds until the next.
  void take(const OdometrySample& sample) noexcept;
  // The robot's clock was set: times before and after are not comparable.
  void forget_time() noexcept { last_.reset(); }
  // The robot's clock was set by step_s.
  void shift_time(double step_s) noexcept {
    if (last_) last_->t_s += step_s;
  }
  // At the last sample; none before the first.
  [[nodiscard]] std::optional<OdomPose> pose() const noexcept;

  void archive(StateArchive& state) { state(last_, at_); }

 private:
  std::optional<OdometrySample> last_;
  PlanarPose at_;
};

}  // namespace groma::model
