#include "host/filter/pose_measurement.hpp"

#include <cmath>

#include "host/model/plausible.hpp"
#include "host/model/pose.hpp"

namespace groma::filter {

bool tells_pose(const model::PoseSample& sample) noexcept {
  return sample.covariance && model::is_plausible(sample);
}

CoreMeasurement<3> measure_pose(const model::Surface& surface, const PresentPose& now,
                                const model::PoseSample& sample) noexcept {
  CoreMeasurement<3> out;
  out.innovation << sample.x_m - now.pose.x(), sample.y_m - now.pose.y(),
      model::wrap_angle(place_on(surface, sample).theta_rad - now.pose.z());
  out.d_core = now.d_core;
  out.noise = model::to_matrix(*sample.covariance) + now.noise;
  return out;
}

model::PlanarPose place_on(const model::Surface& surface, const model::PoseSample& pose) noexcept {
  model::PlanarPose out{pose.x_m, pose.y_m, pose.yaw_rad, surface.nearest(pose.x_m, pose.y_m, pose.z_m)};
  if (!std::isfinite(pose.roll_rad) || !std::isfinite(pose.pitch_rad)) return out;
  const Eigen::Matrix3d tilt = model::surface_rotation(surface.at(pose.x_m, pose.y_m, out.chart).gradient);
  const Eigen::Matrix3d turn =
      tilt.transpose() * model::rotation_from_zyx(pose.yaw_rad, pose.pitch_rad, pose.roll_rad);
  out.theta_rad = std::atan2(turn(1, 0), turn(0, 0));
  return out;
}

}  // namespace groma::filter
