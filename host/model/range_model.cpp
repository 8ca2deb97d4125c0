#include "host/model/range_model.hpp"

#include <cmath>

namespace groma::model {

RangePrediction predict_range(const RigidPose& pose, const Eigen::Vector3d& lever_arm_m,
                              const Eigen::Vector3d& anchor_m, const TermVector& terms) noexcept {
  RangePrediction out;
  static_cast<AntennaPrediction&>(out) =
      predict_antenna_range(pose.position_m + pose.rotation * lever_arm_m, anchor_m, terms);
  out.d_position = out.scale * out.direction.transpose();
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

SurfaceRange predict_surface_range(const SurfacePoint& ground, const PlanarPose& planar,
                                   const Eigen::Vector3d& lever_arm_m, const Eigen::Vector3d& anchor_m,
                                   const TermVector& terms) noexcept {
  const SurfaceRotation tilt = surface_rotation_with_derivatives(ground.gradient);
  const double c = std::cos(planar.theta_rad);
  const double s = std::sin(planar.theta_rad);
  // R_z l in the tangent plane's frame.
  const Eigen::Vector3d arm_m(c * lever_arm_m.x() - s * lever_arm_m.y(),
                              s * lever_arm_m.x() + c * lever_arm_m.y(), lever_arm_m.z());
  const Eigen::Vector3d position_m(planar.x_m, planar.y_m, ground.z_m);

  SurfaceRange out;
  static_cast<AntennaPrediction&>(out) =
      predict_antenna_range(position_m + tilt.rotation * arm_m, anchor_m, terms);
  out.d_position = out.scale * out.direction.transpose();
  out.d_anchor = -out.d_position;
  const Eigen::RowVector3d tangent = out.direction.transpose() * tilt.rotation;
  out.in_body << c * tangent.x() + s * tangent.y(), c * tangent.y() - s * tangent.x(), tangent.z();
  out.d_lever_arm = out.scale * out.in_body.transpose();
  out.d_gradient << out.d_position.dot(tilt.d_gx * arm_m), out.d_position.dot(tilt.d_gy * arm_m);
  const Eigen::RowVector2d by_slope = out.d_gradient * ground.hessian;
  out.d_pose << out.d_position.x() + out.d_position.z() * ground.gradient.x() + by_slope.x(),
      out.d_position.y() + out.d_position.z() * ground.gradient.y() + by_slope.y(),
      out.scale * (tangent.y() * arm_m.x() - tangent.x() * arm_m.y());
  const auto& r = tilt.rotation;
  out.sideways << r(0, 0) * c + r(0, 1) * s, r(0, 1) * c - r(0, 0) * s, r(1, 0) * c + r(1, 1) * s,
      r(1, 1) * c - r(1, 0) * s;
  return out;
}

}  // namespace groma::model
