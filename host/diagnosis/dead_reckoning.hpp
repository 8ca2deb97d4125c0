// The odometry integrated from its first sample, each sample held until the next.
#pragma once

#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/model/types.hpp"

namespace groma::diagnosis {

class DeadReckoning {
 public:
  // In the frame of base_link at the first sample; before scales of the speed.
  struct Place {
    Eigen::Vector2d position_m = Eigen::Vector2d::Zero();
    double heading_rad = 0.0;
  };

  // `yaw_rate_scale`: given over true. `odometry` is in the order of its times, and outlives this.
  DeadReckoning(std::span<const model::OdometrySample> odometry, double yaw_rate_scale);

  // NaN outside of the odometry's times.
  [[nodiscard]] Place at(double t_s) const;
  [[nodiscard]] double yaw_rate_scale() const noexcept { return yaw_rate_scale_; }

 private:
  [[nodiscard]] Place advance(const Place& from, const model::OdometrySample& held, double dt_s) const;

  std::span<const model::OdometrySample> odometry_;
  double yaw_rate_scale_;
  std::vector<Place> path_;  // at each sample
};

}  // namespace groma::diagnosis
