// Motion on the surface, equations (1) to (3) of the source paper, and the models that the methods share.
#pragma once

#include <cmath>

#include <Eigen/Core>

#include "host/model/pose.hpp"
#include "host/model/range_model.hpp"
#include "host/model/surface.hpp"
#include "test/baseline/drive.hpp"

namespace groma::baseline {

[[nodiscard]] inline Eigen::Matrix2d turn(double angle_rad) noexcept {
  const double c = std::cos(angle_rad);
  const double s = std::sin(angle_rad);
  return (Eigen::Matrix2d() << c, -s, s, c).finished();
}
// Of turn(angle) by the angle.
[[nodiscard]] inline Eigen::Matrix2d turn_by_angle(double angle_rad) noexcept {
  const double c = std::cos(angle_rad);
  const double s = std::sin(angle_rad);
  return (Eigen::Matrix2d() << -s, -c, c, -s).finished();
}

// The pose after dt_s at a constant velocity of base_link (vx, vy, yaw rate), with Jacobians. The slope is
// that of the start: the error on curved ground is of second order in dt_s.
struct Step {
  model::PlanarPose pose;
  Eigen::Matrix3d by_pose;
  Eigen::Matrix3d by_velocity;
};
[[nodiscard]] Step step(const model::Surface& surface, const model::PlanarPose& from,
                        const Eigen::Vector3d& velocity, double dt_s) noexcept;

[[nodiscard]] inline Eigen::Vector3d velocity_of(const model::OdometrySample& sample) noexcept {
  return {sample.vx_mps, sample.vy_mps, sample.omega_radps};
}
[[nodiscard]] inline Eigen::Vector3d variances_of(const model::OdometryNoise& noise, double factor) noexcept {
  return model::square(factor) *
         Eigen::Vector3d(noise.sigma_vx_mps, noise.sigma_vy_mps, noise.sigma_omega_radps).cwiseAbs2();
}

// A range as a method predicts it: equation (4) without biases, or (12).
enum class RangeModel { kPure, kBiased };
struct Prediction {
  double range_m = 0.0;
  Eigen::RowVector3d by_pose;            // x, y, theta
  Eigen::RowVector3d by_anchor;          // its position
  double calibration_variance_m2 = 0.0;  // J Pc J^T of anchor, terms and lever arm; 0 for kPure
  double other_variance_m2 = 0.0;        // the same without the anchor's position
};
[[nodiscard]] Prediction predict(RangeModel model, const model::Surface& surface,
                                 const model::PlanarPose& pose, const Pair& pair,
                                 const Eigen::Vector3d& anchor_m) noexcept;

}  // namespace groma::baseline
