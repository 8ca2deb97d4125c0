// A robot pose on a surface: R_WR = R_WT(x, y) R_z(theta), with derivatives.
#pragma once

#include <Eigen/Core>

#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::model {

// theta wrapped to (-pi, pi].
[[nodiscard]] double wrap_angle(double theta_rad) noexcept;

// Core state of the M-ESEKF: planar position t_R and heading theta_R.
struct PlanarPose {
  double x_m = 0.0;
  double y_m = 0.0;
  double theta_rad = 0.0;
  int chart = 0;  // of the surface
};

// A rigid pose: R_WR takes base_link vectors into the map frame.
struct RigidPose {
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();
};

// The same with a unit quaternion: x, y, z, w.
struct QuaternionPose {
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Vector4d quaternion{0.0, 0.0, 0.0, 1.0};
};

// R_WT: the smallest rotation that takes the world's z to the surface normal (-gx, -gy, 1)/norm.
[[nodiscard]] Eigen::Matrix3d surface_rotation(const Eigen::Vector2d& gradient) noexcept;

// R_WT with its derivatives with respect to both gradient components.
struct SurfaceRotation {
  Eigen::Matrix3d rotation;
  Eigen::Matrix3d d_gx;
  Eigen::Matrix3d d_gy;
};
[[nodiscard]] SurfaceRotation surface_rotation_with_derivatives(const Eigen::Vector2d& gradient) noexcept;

// ZYX Euler angles to a rotation.
[[nodiscard]] Eigen::Matrix3d rotation_from_zyx(double yaw_rad, double pitch_rad, double roll_rad) noexcept;

// x, y, z, w; w is not negative.
[[nodiscard]] Eigen::Vector4d quaternion_of(const Eigen::Matrix3d& rotation) noexcept;

// sigma^-1 and R_WR of a planar pose, with derivatives by x, y and theta.
struct SurfacePose {
  RigidPose pose;
  Eigen::Matrix3d rotation_wt;                  // R_WT
  Eigen::Matrix<double, 3, 2> d_position_d_xy;  // of sigma^-1
  Eigen::Matrix3d d_rotation_d_x;
  Eigen::Matrix3d d_rotation_d_y;
  Eigen::Matrix3d d_rotation_d_theta;
  Eigen::Matrix3d d_rotation_wt_d_x;
  Eigen::Matrix3d d_rotation_wt_d_y;
  Eigen::Matrix3d d_rotation_wt_d_gx;  // by the gradient itself
  Eigen::Matrix3d d_rotation_wt_d_gy;
};
[[nodiscard]] SurfacePose pose_on_surface(const Surface& surface, const PlanarPose& planar) noexcept;

// A planar estimate as a pose in space. Roll and pitch are the ZYX angles of R_WR, yaw is the heading on the
// surface.
struct SpatialEstimate {
  double z_m = 0.0;
  double roll_rad = 0.0;
  double pitch_rad = 0.0;
  Eigen::Vector4d quaternion{0.0, 0.0, 0.0, 1.0};  // x, y, z, w of R_WR; w is not negative
  int chart = 0;
  Eigen::Matrix<double, 6, 6> covariance = Eigen::Matrix<double, 6, 6>::Zero();  // x, y, z, roll, pitch, yaw
};
// covariance: of x, y, theta and of the errors of the surface's height, dS/dx and dS/dy there.
[[nodiscard]] SpatialEstimate on_surface(const Surface& surface, const PlanarPose& planar,
                                         const Eigen::Matrix<double, 6, 6>& covariance) noexcept;

[[nodiscard]] Eigen::Matrix3d to_matrix(const PoseCovariance& covariance) noexcept;
// Whether the matrix is a covariance: finite, each variance positive, positive semidefinite up to the
// rounding of floats.
[[nodiscard]] bool is_covariance(const PoseCovariance& covariance) noexcept;
// Covariance of x and y: xx, xy, yy; it has to be positive definite.
[[nodiscard]] bool is_covariance(const std::array<double, 3>& covariance_m2) noexcept;

}  // namespace groma::model
