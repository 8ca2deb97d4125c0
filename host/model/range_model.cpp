#include "host/model/range_model.hpp"

namespace groma::model {

RangePrediction predict_range(const RigidPose& pose, const Eigen::Vector3d& lever_arm_m,
                              const Eigen::Vector3d& anchor_m, double beta_m, double gamma) noexcept {
  const AntennaPrediction antenna =
      predict_antenna_range(pose.position_m + pose.rotation * lever_arm_m, anchor_m, beta_m, gamma);
  RangePrediction out;
  out.range_m = antenna.range_m;
  out.distance_m = antenna.distance_m;
  out.direction = antenna.direction;
  out.d_position = gamma * out.direction.transpose();
  out.d_anchor = -out.d_position;
  out.d_lever_arm = out.d_position * pose.rotation;
  return out;
}

Eigen::RowVector3d range_by_planar_pose(const RangePrediction& prediction, const SurfacePose& pose,
                                        const Eigen::Vector3d& lever_arm_m) noexcept {
  const Eigen::RowVector3d& g = prediction.d_position;
  const double dx = g.dot(pose.d_position_d_xy.col(0) + pose.d_rotation_d_x * lever_arm_m);
  const double dy = g.dot(pose.d_position_d_xy.col(1) + pose.d_rotation_d_y * lever_arm_m);
  const double dtheta = g.dot(pose.d_rotation_d_theta * lever_arm_m);
  return {dx, dy, dtheta};
}

}  // namespace groma::model
