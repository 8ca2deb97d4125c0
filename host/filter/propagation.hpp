// Motion on the surface: t' = sigma(R_WT(t) R_z(theta) v), theta' = omega, over one step of constant body
// velocity, with the derivatives of the step.
#pragma once

#include <Eigen/Core>

#include "host/filter/state.hpp"
#include "host/model/pose.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// Longer steps are to be cut: the error of a step on a curved surface grows with its third power.
inline constexpr double kMaxStep_s = 0.05;

struct Motion {
  Eigen::Vector3d pose;                        // x, y, theta (not wrapped) after the step
  Eigen::Matrix<double, 3, kCoreSize> d_core;  // of them by the core state before it
};

// One step of dt_s from the core state, with the row's velocity v = (1 + scale) v_row - e_v and
// omega = omega_row - bias - e_omega. Exact for planes; second order in dt_s for curved surfaces, its
// derivatives exact for what it computes. `chart`: of the surface, for the whole step.
[[nodiscard]] Motion move(const model::Surface& surface, const CoreVector& core,
                          const model::OdometrySample& row, double dt_s, int chart = 0) noexcept;

// x', y', theta' of the core state now; sideways: the upper left of R_WR where it is.
[[nodiscard]] Eigen::Vector3d pose_rate(const Eigen::Matrix2d& sideways, const CoreVector& core,
                                        const model::OdometrySample& row) noexcept;

}  // namespace groma::filter
