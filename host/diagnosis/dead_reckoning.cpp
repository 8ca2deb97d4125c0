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

std::vector<model::OdometrySample> joined(std::span<const model::OdometrySample> odometry, double least_s) {
  std::vector<model::OdometrySample> out;
  const DeadReckoning path(odometry, {});
  for (std::size_t begin = 0; begin < odometry.size();) {
    std::size_t end = begin + 1;
    while (end < odometry.size() && odometry[end].t_s - odometry[begin].t_s < least_s) ++end;
    if (end == odometry.size()) {
      out.insert(out.end(), odometry.begin() + static_cast<std::ptrdiff_t>(begin), odometry.end());
      break;
    }
    const DeadReckoning::Place from = path.at(odometry[begin].t_s);
    const DeadReckoning::Place to = path.at(odometry[end].t_s);
    const double dt_s = odometry[end].t_s - odometry[begin].t_s;
    const Eigen::Vector2d velocity_mps = Eigen::Rotation2Dd(-0.5 * (from.heading_rad + to.heading_rad)) *
                                         (to.position_m - from.position_m) / dt_s;
    out.push_back({odometry[begin].t_s, velocity_mps.x(), velocity_mps.y(),
                   (to.heading_rad - from.heading_rad) / dt_s});
    begin = end;
  }
  return out;
}

}  // namespace groma::diagnosis
