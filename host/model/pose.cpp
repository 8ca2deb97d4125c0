#include "host/model/pose.hpp"

#include <cmath>
#include <numbers>

#include <Eigen/Eigenvalues>
#include <Eigen/Geometry>

namespace groma::model {

double wrap_angle(double theta_rad) noexcept {
  if (theta_rad > -std::numbers::pi && theta_rad <= std::numbers::pi) return theta_rad;
  const double wrapped = std::remainder(theta_rad, 2.0 * std::numbers::pi);
  return wrapped <= -std::numbers::pi ? std::numbers::pi : wrapped;
}

namespace {

// The unit normal (a, b, c), and k = 1/(1 + c).
struct Normal {
  double a;
  double b;
  double c;
  double k;
};

Normal normal_of(const Eigen::Vector2d& gradient) noexcept {
  Normal out{};
  out.c = 1.0 / std::sqrt(1.0 + gradient.x() * gradient.x() + gradient.y() * gradient.y());
  out.a = -gradient.x() * out.c;
  out.b = -gradient.y() * out.c;
  out.k = 1.0 / (1.0 + out.c);
  return out;
}

// The smallest rotation of z to the normal is
//   [ 1 - k a a   -k a b     a ]
//   [ -k a b      1 - k b b  b ]
//   [ -a          -b         c ]
Eigen::Matrix3d rotation_to(const Normal& n) noexcept {
  const auto& [a, b, c, k] = n;
  Eigen::Matrix3d out;
  out << 1.0 - k * a * a, -k * a * b, a, -k * a * b, 1.0 - k * b * b, b, -a, -b, c;
  return out;
}

}  // namespace

SurfaceRotation surface_rotation_with_derivatives(const Eigen::Vector2d& gradient) noexcept {
  const double gx = gradient.x();
  const double gy = gradient.y();
  const Normal normal = normal_of(gradient);
  const double a = normal.a;
  const double b = normal.b;
  const double c = normal.c;
  const double k = normal.k;

  SurfaceRotation out;
  out.rotation = rotation_to(normal);

  const auto derivative = [&](double dc, double da, double db) {
    const double dk = -k * k * dc;
    const double aa = dk * a * a + 2.0 * k * a * da;
    const double bb = dk * b * b + 2.0 * k * b * db;
    const double ab = dk * a * b + k * (da * b + a * db);
    Eigen::Matrix3d d;
    d << -aa, -ab, da, -ab, -bb, db, -da, -db, dc;
    return d;
  };
  const double c3 = c * c * c;
  const double dc_gx = -gx * c3;
  const double dc_gy = -gy * c3;
  out.d_gx = derivative(dc_gx, -c - gx * dc_gx, -gy * dc_gx);
  out.d_gy = derivative(dc_gy, -gx * dc_gy, -c - gy * dc_gy);
  return out;
}

Eigen::Matrix3d surface_rotation(const Eigen::Vector2d& gradient) noexcept {
  return rotation_to(normal_of(gradient));
}

Eigen::Matrix3d rotation_from_zyx(double yaw_rad, double pitch_rad, double roll_rad) noexcept {
  const double cy = std::cos(yaw_rad);
  const double sy = std::sin(yaw_rad);
  const double cp = std::cos(pitch_rad);
  const double sp = std::sin(pitch_rad);
  const double cr = std::cos(roll_rad);
  const double sr = std::sin(roll_rad);
  Eigen::Matrix3d r;
  r << cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, sy * cp, sy * sp * sr + cy * cr,
      sy * sp * cr - cy * sr, -sp, cp * sr, cp * cr;
  return r;
}

SurfacePose pose_on_surface(const Surface& surface, const PlanarPose& planar) noexcept {
  const SurfacePoint ground = surface.at(planar.x_m, planar.y_m, planar.chart);
  const SurfaceRotation tilt = surface_rotation_with_derivatives(ground.gradient);
  const double c = std::cos(planar.theta_rad);
  const double s = std::sin(planar.theta_rad);
  Eigen::Matrix3d rz;
  rz << c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0;
  Eigen::Matrix3d drz;
  drz << -s, -c, 0.0, c, -s, 0.0, 0.0, 0.0, 0.0;

  SurfacePose out;
  out.pose.position_m << planar.x_m, planar.y_m, ground.z_m;
  out.rotation_wt = tilt.rotation;
  out.pose.rotation = tilt.rotation * rz;
  out.d_position_d_xy << 1.0, 0.0, 0.0, 1.0, ground.gradient.x(), ground.gradient.y();
  out.d_rotation_wt_d_gx = tilt.d_gx;
  out.d_rotation_wt_d_gy = tilt.d_gy;
  out.d_rotation_wt_d_x = tilt.d_gx * ground.hessian(0, 0) + tilt.d_gy * ground.hessian(1, 0);
  out.d_rotation_wt_d_y = tilt.d_gx * ground.hessian(0, 1) + tilt.d_gy * ground.hessian(1, 1);
  out.d_rotation_d_x = out.d_rotation_wt_d_x * rz;
  out.d_rotation_d_y = out.d_rotation_wt_d_y * rz;
  out.d_rotation_d_theta = tilt.rotation * drz;
  return out;
}

Eigen::Vector4d quaternion_of(const Eigen::Matrix3d& rotation) noexcept {
  const Eigen::Quaterniond turned(rotation);
  return turned.w() < 0.0 ? Eigen::Vector4d(-turned.coeffs()) : turned.coeffs();
}

SpatialEstimate on_surface(const Surface& surface, const PlanarPose& planar,
                           const Eigen::Matrix<double, 6, 6>& covariance) noexcept {
  const SurfacePose at = pose_on_surface(surface, planar);
  const Eigen::Matrix3d& rotation = at.pose.rotation;
  // R_WR = R_z(yaw) R_y(pitch) R_x(roll): its last row is (-sin p, cos p sin r, cos p cos r).
  const double cos_pitch = std::hypot(rotation(2, 1), rotation(2, 2));
  SpatialEstimate out;
  out.z_m = at.pose.position_m.z();
  out.roll_rad = std::atan2(rotation(2, 1), rotation(2, 2));
  // Not -0 on level ground.
  out.pitch_rad = std::atan2(0.0 - rotation(2, 0), cos_pitch);
  out.quaternion = quaternion_of(rotation);
  out.chart = planar.chart;

  Eigen::Matrix<double, 6, 6> by = Eigen::Matrix<double, 6, 6>::Zero();
  const auto turns = [&](Eigen::Index column, const Eigen::RowVector3d& d_row) {
    by(3, column) = (d_row.y() * rotation(2, 2) - rotation(2, 1) * d_row.z()) / (cos_pitch * cos_pitch);
    by(4, column) = -d_row.x() / cos_pitch;
  };
  const Eigen::Matrix3d turn = at.rotation_wt.transpose() * rotation;  // R_z(theta)
  by.topLeftCorner<3, 2>() = at.d_position_d_xy;
  turns(0, at.d_rotation_d_x.row(2));
  turns(1, at.d_rotation_d_y.row(2));
  turns(2, at.d_rotation_d_theta.row(2));
  by(5, 2) = 1.0;
  by(2, 3) = 1.0;
  turns(4, at.d_rotation_wt_d_gx.row(2) * turn);
  turns(5, at.d_rotation_wt_d_gy.row(2) * turn);
  const Eigen::Matrix<double, 6, 6> spread = by * covariance * by.transpose();
  out.covariance = 0.5 * (spread + spread.transpose());
  return out;
}

Eigen::Matrix3d to_matrix(const PoseCovariance& covariance) noexcept {
  const auto& [xx, xy, xt, yy, yt, tt] = covariance;
  Eigen::Matrix3d out;
  out << xx, xy, xt,  //
      xy, yy, yt,     //
      xt, yt, tt;
  return out;
}

bool is_covariance(const std::array<double, 3>& covariance_m2) noexcept {
  const auto& [xx, xy, yy] = covariance_m2;
  return std::isfinite(xx + xy + yy) && xx > 0.0 && xx * yy > xy * xy;
}

bool is_covariance(const PoseCovariance& covariance) noexcept {
  constexpr double kRounding = 1e-5;  // numerics: some 170 roundings of a float, 6e-8
  const Eigen::Matrix3d matrix = to_matrix(covariance);
  if (!matrix.allFinite() || !(matrix.diagonal().minCoeff() > 0.0)) return false;
  const Eigen::Vector3d inverse_sigma = matrix.diagonal().cwiseSqrt().cwiseInverse();
  const Eigen::Matrix3d correlation = inverse_sigma.asDiagonal() * matrix * inverse_sigma.asDiagonal();
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> axes(correlation, Eigen::EigenvaluesOnly);
  return axes.eigenvalues()(0) > -kRounding;
}

}  // namespace groma::model
