#include "test/baseline/motion.hpp"

namespace groma::baseline {

Step step(const model::Surface& surface, const model::PlanarPose& from, const Eigen::Vector3d& velocity,
          double dt_s) noexcept {
  const model::SurfacePose ground = model::pose_on_surface(surface, from);
  const Eigen::Matrix2d flat = ground.rotation_wt.topLeftCorner<2, 2>();
  const double middle_rad = from.theta_rad + 0.5 * velocity.z() * dt_s;
  const Eigen::Matrix2d rotation = turn(middle_rad);
  const Eigen::Vector2d moved = dt_s * (rotation * velocity.head<2>());
  const Eigen::Vector2d by_theta = dt_s * (flat * (turn_by_angle(middle_rad) * velocity.head<2>()));

  Step out;
  const Eigen::Vector2d to = Eigen::Vector2d(from.x_m, from.y_m) + flat * moved;
  out.pose = {to.x(), to.y(), model::wrap_angle(from.theta_rad + velocity.z() * dt_s),
              surface.follow(from.chart, to.x(), to.y())};
  out.by_pose.setIdentity();
  out.by_pose.topLeftCorner<2, 1>() += ground.d_rotation_wt_d_x.topLeftCorner<2, 2>() * moved;
  out.by_pose.block<2, 1>(0, 1) += ground.d_rotation_wt_d_y.topLeftCorner<2, 2>() * moved;
  out.by_pose.topRightCorner<2, 1>() = by_theta;
  out.by_velocity.setZero();
  out.by_velocity.topLeftCorner<2, 2>() = dt_s * flat * rotation;
  out.by_velocity.topRightCorner<2, 1>() = 0.5 * dt_s * by_theta;
  out.by_velocity(2, 2) = dt_s;
  return out;
}

Prediction predict(RangeModel model, const model::Surface& surface, const model::PlanarPose& pose,
                   const Pair& pair, const Eigen::Vector3d& anchor_m) noexcept {
  model::TermVector terms = pair.terms;
  if (model == RangeModel::kPure)
    terms = model::each_term([](const model::PairTerm& term) { return term.neutral; });
  const model::SurfaceRange range = model::predict_surface_range(surface.at(pose.x_m, pose.y_m, pose.chart),
                                                                 pose, pair.lever_arm_m, anchor_m, terms);
  Prediction out;
  out.range_m = range.range_m;
  out.by_pose = range.d_pose;
  out.by_anchor = range.d_anchor;
  if (model == RangeModel::kPure) return out;
  Eigen::Matrix<double, 1, model::kPairSize> by_pair;
  by_pair << range.d_anchor, range.d_terms.transpose();
  const double lever_arm_m2 = model::square(kLeverArmSigma_m) * range.d_lever_arm.squaredNorm();
  out.calibration_variance_m2 = by_pair.dot(by_pair * pair.covariance) + lever_arm_m2;
  const auto terms_covariance =
      pair.covariance.bottomRightCorner<model::kPairTermCount, model::kPairTermCount>();
  out.other_variance_m2 = range.d_terms.dot(terms_covariance * range.d_terms) + lever_arm_m2;
  return out;
}

}  // namespace groma::baseline
