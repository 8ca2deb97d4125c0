#include "host/diagnosis/dead_reckoning.hpp"

#include <algorithm>
#include <limits>

#include <Eigen/Geometry>

namespace groma::diagnosis {

DeadReckoning::DeadReckoning(std::span<const model::OdometrySample> odometry, YawRateError yaw_rate)
    : odometry_(odometry), yaw_rate_(yaw_rate), path_(odometry.size()) {
  for (std::size_t i = 1; i < path_.size(); ++i)
    path_[i] = advance(path_[i - 1], odometry_[i - 1], odometry_[i].t_s - odometry_[i - 1].t_s);
}

DeadReckoning::Place DeadReckoning::advance(const Place& from, const model::OdometrySample& held,
                                            double dt_s) const {
  const double turn_rad = (held.omega_radps - yaw_rate_.bias_radps) / yaw_rate_.scale * dt_s;
  const Eigen::Rotation2Dd middle(from.heading_rad + 0.5 * turn_rad);
  return {from.position_m + middle * Eigen::Vector2d(held.vx_mps, held.vy_mps) * dt_s,
          from.heading_rad + turn_rad};
}

DeadReckoning::Place DeadReckoning::at(double t_s) const {
  const auto next =
      std::upper_bound(odometry_.begin(), odometry_.end(), t_s,
                       [](double t, const model::OdometrySample& sample) { return t < sample.t_s; });
  if (next == odometry_.begin() || (next == odometry_.end() && t_s > odometry_.back().t_s)) {
    constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
    return {{kNone, kNone}, kNone};
  }
  const auto held = next - odometry_.begin() - 1;
  return advance(path_[static_cast<std::size_t>(held)], odometry_[static_cast<std::size_t>(held)],
                 t_s - odometry_[static_cast<std::size_t>(held)].t_s);
}

}  // namespace groma::diagnosis
