#include "host/filter/propagation.hpp"

#include <cmath>

namespace groma::filter {

namespace {

// The tangent plane's axes projected to the xy-plane, A = sigma R_WT restricted to the plane, and its
// derivatives w.r.t. x and y.
struct Projection {
  Eigen::Matrix2d a;
  Eigen::Matrix2d d_x;
  Eigen::Matrix2d d_y;
};

Projection projection(const model::Surface& surface, int chart, const Eigen::Vector2d& position) noexcept {
  const model::SurfacePoint ground = surface.at(position.x(), position.y(), chart);
  // The upper left of model::surface_rotation: with c the normal's vertical part, 1 - m g gᵀ, m = c²/(1 + c).
  const Eigen::Vector2d& g = ground.gradient;
  const double c = 1.0 / std::sqrt(1.0 + g.squaredNorm());
  const double q = 1.0 / (1.0 + c);
  const double m = c * c * q;
  const double dm_by_slope = -c * c * c * c * (2.0 + c) * q * q;
  Projection out;
  const double xy = -m * g.x() * g.y();
  out.a << 1.0 - m * g.x() * g.x(), xy, xy, 1.0 - m * g.y() * g.y();
  const auto along = [&](double d_gx, double d_gy) {
    const double dm = dm_by_slope * (g.x() * d_gx + g.y() * d_gy);
    const double d_xy = -dm * g.x() * g.y() - m * (d_gx * g.y() + g.x() * d_gy);
    Eigen::Matrix2d d;
    d << -(dm * g.x() + 2.0 * m * d_gx) * g.x(), d_xy, d_xy, -(dm * g.y() + 2.0 * m * d_gy) * g.y();
    return d;
  };
  out.d_x = along(ground.hessian(0, 0), ground.hessian(1, 0));
  out.d_y = along(ground.hessian(0, 1), ground.hessian(1, 1));
  return out;
}

// Mean of R(theta + s) over s in 0..angle, R(theta + angle/2) sinc(angle/2), and its derivative w.r.t. angle.
struct MeanTurn {
  Eigen::Matrix2d r;
  Eigen::Matrix2d d_angle;
};

MeanTurn mean_turn(double theta_rad, double angle_rad) noexcept {
  const double half = 0.5 * angle_rad;
  double sinc = 1.0 - half * half / 6.0;
  double d_sinc = -half / 3.0;
  if (std::abs(half) > 1e-3) {
    sinc = std::sin(half) / half;
    d_sinc = (std::cos(half) - sinc) / half;
  }
  const double c = std::cos(theta_rad + half);
  const double s = std::sin(theta_rad + half);
  MeanTurn out;
  out.r << c * sinc, -s * sinc, s * sinc, c * sinc;
  out.d_angle << c * d_sinc - s * sinc, -s * d_sinc - c * sinc, s * d_sinc + c * sinc, c * d_sinc - s * sinc;
  out.d_angle *= 0.5;
  return out;
}

Eigen::Vector2d perpendicular(const Eigen::Vector2d& v) noexcept {
  return {-v.y(), v.x()};
}

// Of base_link in base_link: vx, vy (m/s) and yaw rate (rad/s).
Eigen::Vector3d corrected(const CoreVector& core, const model::OdometrySample& sample) noexcept {
  return {(1.0 + core(kScale)) * sample.vx_mps - core(kOdometryVx),
          (1.0 + core(kScale)) * sample.vy_mps - core(kOdometryVy),
          sample.omega_radps - core(kYawBias) - core(kOdometryOmega)};
}

}  // namespace

Motion move(const model::Surface& surface, const CoreVector& core, const model::OdometrySample& sample,
            double dt_s, int chart) noexcept {
  const Eigen::Vector2d start = core.segment<2>(kX);
  const Eigen::Vector3d velocity = corrected(core, sample);
  const Eigen::Vector2d v = velocity.head<2>();
  const Eigen::Vector2d v_sample(sample.vx_mps, sample.vy_mps);
  const double omega = velocity.z();

  // Midpoint rule: the slope halfway is used for the whole step.
  const double half_s = 0.5 * dt_s;
  const Projection first = projection(surface, chart, start);
  const MeanTurn half_turn = mean_turn(core(kTheta), omega * half_s);
  const Eigen::Vector2d u_half = half_turn.r * v;
  const Eigen::Vector2d middle = start + half_s * (first.a * u_half);

  const Projection mean = projection(surface, chart, middle);
  const MeanTurn turn = mean_turn(core(kTheta), omega * dt_s);
  const Eigen::Vector2d u = turn.r * v;

  Motion out;
  out.pose.head<2>() = start + dt_s * (mean.a * u);
  out.pose(2) = core(kTheta) + omega * dt_s;

  // Chain rule: derivative with the midpoint fixed, plus the derivative through the midpoint.
  Eigen::Matrix2d by_middle;
  by_middle << dt_s * (mean.d_x * u), dt_s * (mean.d_y * u);
  Eigen::Matrix<double, 2, kCoreSize> middle_by_core = Eigen::Matrix<double, 2, kCoreSize>::Zero();
  middle_by_core.col(kX) = Eigen::Vector2d::UnitX() + half_s * (first.d_x * u_half);
  middle_by_core.col(kY) = Eigen::Vector2d::UnitY() + half_s * (first.d_y * u_half);
  middle_by_core.col(kTheta) = half_s * (first.a * perpendicular(u_half));
  middle_by_core.col(kScale) = half_s * (first.a * (half_turn.r * v_sample));
  middle_by_core.col(kYawBias) = -half_s * half_s * (first.a * (half_turn.d_angle * v));
  middle_by_core.col(kOdometryVx) = -half_s * (first.a * half_turn.r.col(0));
  middle_by_core.col(kOdometryVy) = -half_s * (first.a * half_turn.r.col(1));
  middle_by_core.col(kOdometryOmega) = middle_by_core.col(kYawBias);

  auto d_xy = out.d_core.topRows<2>();
  d_xy.noalias() = by_middle * middle_by_core;
  d_xy.col(kX) += Eigen::Vector2d::UnitX();
  d_xy.col(kY) += Eigen::Vector2d::UnitY();
  d_xy.col(kTheta) += dt_s * (mean.a * perpendicular(u));
  d_xy.col(kScale) += dt_s * (mean.a * (turn.r * v_sample));
  const Eigen::Vector2d by_omega = dt_s * dt_s * (mean.a * (turn.d_angle * v));
  d_xy.col(kYawBias) -= by_omega;
  d_xy.col(kOdometryVx) -= dt_s * (mean.a * turn.r.col(0));
  d_xy.col(kOdometryVy) -= dt_s * (mean.a * turn.r.col(1));
  d_xy.col(kOdometryOmega) -= by_omega;

  auto d_theta = out.d_core.row(2);
  d_theta.setZero();
  d_theta(kTheta) = 1.0;
  d_theta(kYawBias) = -dt_s;
  d_theta(kOdometryOmega) = -dt_s;
  return out;
}

BodyVelocity body_velocity(const CoreVector& core, const model::OdometrySample& sample) noexcept {
  BodyVelocity out;
  out.value = corrected(core, sample);
  out.d_core.setZero();
  out.d_core(0, kScale) = sample.vx_mps;
  out.d_core(1, kScale) = sample.vy_mps;
  out.d_core(2, kYawBias) = -1.0;
  out.d_core.rightCols<3>().diagonal().setConstant(-1.0);
  return out;
}

Eigen::Vector3d pose_rate(const Eigen::Matrix2d& sideways, const CoreVector& core,
                          const model::OdometrySample& sample) noexcept {
  Eigen::Vector3d rate = corrected(core, sample);
  rate.head<2>() = sideways * rate.head<2>();
  return rate;
}

}  // namespace groma::filter
