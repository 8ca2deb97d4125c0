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

  // Of the yaw rate; given: true times `scale` plus bias.
  struct YawRateError {
    double scale = 1.0;
    double bias_radps = 0.0;
    bool operator==(const YawRateError&) const = default;
  };

  // `odometry` is in the order of its times, and outlives this.
  DeadReckoning(std::span<const model::OdometrySample> odometry, YawRateError yaw_rate);

  // NaN outside of the odometry's times.
  [[nodiscard]] Place at(double t_s) const;
  [[nodiscard]] const YawRateError& yaw_rate() const noexcept { return yaw_rate_; }

 private:
  [[nodiscard]] Place advance(const Place& from, const model::OdometrySample& held, double dt_s) const;

  std::span<const model::OdometrySample> odometry_;
  YawRateError yaw_rate_;
  std::vector<Place> path_;  // at each sample
};

// The same motion in samples that are least_s or more apart, each the mean of those that it stands for: of
// the velocity in the axes of base_link in the middle of its turn.
[[nodiscard]] std::vector<model::OdometrySample> joined(std::span<const model::OdometrySample> odometry,
                                                        double least_s);

}  // namespace groma::diagnosis
