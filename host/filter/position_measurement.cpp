#include "host/filter/position_measurement.hpp"

#include "host/model/pose.hpp"

namespace groma::filter {

CoreMeasurement<2> measure_position(const model::Surface& surface, const PresentPose& now,
                                    const SensorConfig& config,
                                    const model::PositionSample& sample) noexcept {
  const Eigen::Vector3d& lever_arm = config.position_lever_arm_m;
  const model::SurfacePose pose =
      model::pose_on_surface(surface, {now.pose.x(), now.pose.y(), now.pose.z(), now.chart});
  const Eigen::Vector3d antenna = pose.pose.rotation * lever_arm;
  Eigen::Matrix3d d_antenna;
  d_antenna << pose.d_rotation_d_x * lever_arm, pose.d_rotation_d_y * lever_arm,
      pose.d_rotation_d_theta * lever_arm;
  Eigen::Matrix<double, 2, 3> d_pose = d_antenna.topRows<2>();
  d_pose.leftCols<2>() += Eigen::Matrix2d::Identity();

  const auto& [xx, xy, yy] = sample.covariance_m2;
  CoreMeasurement<2> out;
  out.innovation << sample.x_m - now.pose.x() - antenna.x(), sample.y_m - now.pose.y() - antenna.y();
  out.d_core = d_pose.lazyProduct(now.d_core);
  out.noise << xx, xy, xy, yy;
  out.noise += (d_pose * now.noise).lazyProduct(d_pose.transpose());
  return out;
}

}  // namespace groma::filter
