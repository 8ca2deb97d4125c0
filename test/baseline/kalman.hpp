// The Kalman filters: the source paper's error-state filters, and what an iterated update changes.
#pragma once

#include <cmath>
#include <limits>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include "test/baseline/method.hpp"

namespace groma::baseline {

inline constexpr double kScaleSigma = 0.01;  // as the filter's configuration has them
inline constexpr double kYawRateBiasSigma_radps = 0.002;

// Pose on the surface: x, y, theta; with kSize 5 also the odometry's scale and yaw-rate bias, as
// v = (1 + scale) v_odometry and omega = omega_odometry - bias.
template <int kSize>
class PoseFilter : public Method {
  static_assert(kSize == 3 || kSize == 5);

 public:
  using Vector = Eigen::Matrix<double, kSize, 1>;
  using Matrix = Eigen::Matrix<double, kSize, kSize>;
  using Row = Eigen::Matrix<double, 1, kSize>;

  PoseFilter(const Drive& drive, const Parameters& parameters)
      : surface_(*drive.surface),
        pose_(drive.start.pose),
        odometry_variances_(variances_of(drive.odometry_noise, parameters.odometry_factor)) {
    covariance_.setZero();
    covariance_.diagonal().template head<3>() << square(kStartSigma_m), square(kStartSigma_m),
        square(kStartSigma_rad);
    if constexpr (kSize == 5)
      covariance_.diagonal().template tail<2>() << square(kScaleSigma), square(kYawRateBiasSigma_radps);
  }

  void move(double dt_s) override { transition(dt_s); }

  model::PlanarEstimate estimate(double t_s) override {
    return {t_s, pose_.x_m, pose_.y_m, pose_.theta_rad, covariance_.template topLeftCorner<3, 3>()};
  }

 protected:
  static double square(double x) { return model::square(x); }

  // Moves the pose and the covariance by the held sample; returns the transition's Jacobian.
  Matrix transition(double dt_s) {
    const Eigen::Vector3d measured = velocity_of(held_.sample);
    const Eigen::Vector2d moved_mps = (1.0 + odometry_.x()) * measured.head<2>();
    const Eigen::Vector3d velocity(moved_mps.x(), moved_mps.y(), measured.z() - odometry_.y());
    const Step moved = step(surface_, pose_, velocity, dt_s);
    Matrix by_state = Matrix::Identity();
    by_state.template topLeftCorner<3, 3>() = moved.by_pose;
    if constexpr (kSize == 5) {
      by_state.template block<3, 1>(0, 3) = moved.by_velocity.leftCols<2>() * measured.head<2>();
      by_state.template block<3, 1>(0, 4) = -moved.by_velocity.col(2);
    }
    pose_ = moved.pose;
    covariance_ = by_state * covariance_ * by_state.transpose();
    // White noise with the variance of one sample over its interval.
    covariance_.template topLeftCorner<3, 3>() +=
        moved.by_velocity * (odometry_variances_ * held_.interval_s / dt_s).asDiagonal() *
        moved.by_velocity.transpose();
    return by_state;
  }

  [[nodiscard]] Vector state() const {
    Vector out;
    out.template head<3>() << pose_.x_m, pose_.y_m, pose_.theta_rad;
    if constexpr (kSize == 5) out.template tail<2>() = odometry_;
    return out;
  }
  void set_state(const Vector& state) {
    pose_ = {state(0), state(1), model::wrap_angle(state(2)),
             surface_.follow(pose_.chart, state(0), state(1))};
    if constexpr (kSize == 5) odometry_ = state.template tail<2>();
  }
  void correct(const Vector& correction) { set_state(state() + correction); }

  const model::Surface&
      surface_;  // NOLINT(*-non-private-member-variables-in-classes,*-avoid-const-or-ref-data-members)
  model::PlanarPose pose_;  // NOLINT(*-non-private-member-variables-in-classes)
  // Scale and yaw-rate bias; zero with kSize 3.
  Eigen::Vector2d odometry_ = Eigen::Vector2d::Zero();  // NOLINT(*-non-private-member-variables-in-classes)
  Matrix covariance_;                                   // NOLINT(*-non-private-member-variables-in-classes)

 private:
  Eigen::Vector3d odometry_variances_;
};

// Without ranges.
class OdometryOnly final : public PoseFilter<3> {
 public:
  using PoseFilter::PoseFilter;
  bool measure(const Range& /*range*/) override { return false; }
};

// The source paper's filter: core states x, y, theta; kPure is its original formulation, kBiased the adapted
// one with R + J Pc J^T (18).
class PaperFilter final : public PoseFilter<3> {
 public:
  PaperFilter(const Drive& drive, const Parameters& parameters, RangeModel model);
  bool measure(const Range& range) override;

 private:
  RangeModel model_;
  double variance_m2_;
  double gate_;
};

// The same with the anchors' positions as auxiliary states, each with its cross-covariance to the core. As in
// the framework that the paper uses, a correction acts on the core and the measured anchor alone, and the
// cross-covariances between anchors are neglected.
class AnchorStatesFilter final : public PoseFilter<3> {
 public:
  AnchorStatesFilter(const Drive& drive, const Parameters& parameters);
  void move(double dt_s) override;
  bool measure(const Range& range) override;
  [[nodiscard]] std::vector<Eigen::Vector3d> anchors_m() const override;

 private:
  struct Anchor {
    Eigen::Vector3d position_m;
    Eigen::Matrix3d covariance;
    Eigen::Matrix3d with_core;  // core by anchor
  };
  std::vector<Anchor> anchors_;
  double variance_m2_;
  double gate_;
};

// Gauss-Newton on each range's update, with Huber's kernel on the range; states also the odometry's scale and
// yaw-rate bias.
class IteratedFilter final : public PoseFilter<5> {
 public:
  IteratedFilter(const Drive& drive, const Parameters& parameters);
  bool measure(const Range& range) override;

 private:
  static constexpr int kIterations = 5;
  double variance_m2_;
  double gate_;
  double kernel_;
};

}  // namespace groma::baseline
