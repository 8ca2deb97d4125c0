// Motion on the surface, equations (1)-(3): t' = sigma(R_WT(t) R_z(theta) v), theta' = omega, over one step
// of constant body velocity, and the Jacobian of the step.
#pragma once

#include <Eigen/Core>

#include "host/filter/state.hpp"
#include "host/model/pose.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// The caller splits longer steps: the error of a step on a curved surface is of third order in its length.
// Numerics: 1e-6 m on hills of 0.5 m (Move.FollowsACurvedSurfaceToSecondOrder), 8 times that if doubled.
inline constexpr double kMaxStep_s = 0.05;

struct Motion {
  Eigen::Vector3d pose;                        // x, y, theta (not wrapped) after the step
  Eigen::Matrix<double, 3, kCoreSize> d_core;  // of pose, w.r.t. the core state before the step
};

// One step of dt_s from the core state, with v = (1 + scale) v_odo - e_v and
// omega = omega_odo - bias - e_omega, v_odo and omega_odo from the odometry sample. Exact on planes, second
// order in dt_s on curved surfaces; the Jacobian is that of the computed step. `chart`: the surface's chart
// for the whole step.
[[nodiscard]] Motion move(const model::Surface& surface, const CoreVector& core,
                          const model::OdometrySample& sample, double dt_s, int chart = 0) noexcept;

// Velocity of base_link in base_link: vx, vy (m/s) and yaw rate (rad/s), by the corrected odometry.
struct BodyVelocity {
  Eigen::Vector3d value;
  Eigen::Matrix<double, 3, kCoreSize> d_core;  // of value, w.r.t. the core state
};
[[nodiscard]] BodyVelocity body_velocity(const CoreVector& core,
                                         const model::OdometrySample& sample) noexcept;

// Time derivatives of x, y, theta; sideways: the upper left 2 x 2 of R_WR at the pose.
[[nodiscard]] Eigen::Vector3d pose_rate(const Eigen::Matrix2d& sideways, const CoreVector& core,
                                        const model::OdometrySample& sample) noexcept;

}  // namespace groma::filter
