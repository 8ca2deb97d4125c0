#include "test/baseline/trilateration.hpp"

#include <algorithm>

#include <Eigen/Eigenvalues>

namespace groma::baseline {

namespace {

constexpr double kPlainKernel = 2.0;  // sigmas
constexpr std::size_t kLeastRanges = 4;
constexpr double kMostSigma_m = 1.0;  // of a fix, along its worst axis
constexpr double kMostSigma_rad = 0.5;
constexpr int kRounds = 10;

// The pose after `moved` in the frame of `from`; the slope within a window is neglected.
Eigen::Vector3d compose(const Eigen::Vector3d& from, const Eigen::Vector3d& moved) {
  Eigen::Vector3d out = from;
  out.head<2>() += turn(from.z()) * moved.head<2>();
  out.z() += moved.z();
  return out;
}

}  // namespace

Trilateration::Trilateration(const Drive& drive, const Parameters& parameters)
    : PoseFilter(drive, parameters),
      variance_m2_(square(parameters.range_factor * drive.range_sigma_m)),
      kernel_(parameters.kernel > 0.0 ? parameters.kernel : kPlainKernel),
      gate_(parameters.gate),
      window_s_(parameters.window_s),
      begin_(drive.start.pose) {}

void Trilateration::move(double dt_s) {
  const double angle_rad = held_.sample.omega_radps * dt_s;
  moved_.head<2>() += dt_s * (turn(moved_.z() + 0.5 * angle_rad) * velocity_of(held_.sample).head<2>());
  moved_.z() += angle_rad;
  passed_s_ += dt_s;
  transition(dt_s);
}

bool Trilateration::measure(const Range& range) {
  sightings_.push_back({range, moved_});
  return true;
}

void Trilateration::begin_window() {
  begin_ = pose_;
  moved_.setZero();
  passed_s_ = 0.0;
  sightings_.clear();
}

model::PlanarEstimate Trilateration::estimate(double t_s) {
  if (passed_s_ >= window_s_) {
    Fix fix;
    if (solve(fix)) fuse(fix);
    begin_window();
  }
  return PoseFilter::estimate(t_s);
}

bool Trilateration::solve(Fix& fix) const {
  if (sightings_.size() < kLeastRanges) return false;
  const Pair* first = sightings_.front().range.pair;
  fix.has_heading = std::any_of(sightings_.begin(), sightings_.end(), [first](const Sighting& sighting) {
    return sighting.range.pair->tag != first->tag;
  });
  Eigen::Vector3d at(begin_.x_m, begin_.y_m, begin_.theta_rad);
  Eigen::Matrix3d information;
  bool converged = false;
  for (int round = 0; round < kRounds && !converged; ++round) {
    information.setZero();
    Eigen::Vector3d right = Eigen::Vector3d::Zero();
    for (const auto& [range, moved] : sightings_) {
      const Eigen::Vector3d there = compose(at, moved);
      const Prediction predicted =
          predict(RangeModel::kBiased, surface_, {there.x(), there.y(), there.z(), begin_.chart}, *range.pair,
                  range.pair->anchor_m);
      Eigen::RowVector3d by_pose = predicted.by_pose;
      by_pose.z() += predicted.by_pose.head<2>().dot(turn_by_angle(at.z()) * moved.head<2>());
      if (!fix.has_heading) by_pose.z() = 0.0;
      const double variance_m2 = variance_m2_ + predicted.calibration_variance_m2;
      const double residual_m = range.range_m - predicted.range_m;
      const double weight = 1.0 / (variance_m2 * (1.0 + square(residual_m / kernel_) / variance_m2));
      information += weight * by_pose.transpose() * by_pose;
      right += weight * by_pose.transpose() * residual_m;
    }
    if (!fix.has_heading) information(2, 2) = 1.0;
    const Eigen::LDLT<Eigen::Matrix3d> root(information);
    if (root.info() != Eigen::Success || !(root.vectorD().minCoeff() > 0.0)) return false;
    const Eigen::Vector3d change = root.solve(right);
    if (!change.allFinite() || change.head<2>().norm() > 100.0) return false;
    at += change;
    converged = change.norm() < 1e-4;
    fix.covariance = root.solve(Eigen::Matrix3d::Identity());
  }
  fix.pose = at;
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> axes(
      Eigen::Matrix2d(fix.covariance.topLeftCorner<2, 2>()), Eigen::EigenvaluesOnly);
  if (fix.has_heading && fix.covariance(2, 2) > square(kMostSigma_rad)) return false;
  return converged && axes.eigenvalues()(1) < square(kMostSigma_m);
}

void Trilateration::fuse(const Fix& fix) {
  // The fix at the window's end.
  const Eigen::Vector3d there = compose(fix.pose, moved_);
  Eigen::Matrix3d by_begin = Eigen::Matrix3d::Identity();
  by_begin.topRightCorner<2, 1>() = turn_by_angle(fix.pose.z()) * moved_.head<2>();
  Eigen::Matrix3d noise = by_begin * fix.covariance * by_begin.transpose();
  Eigen::Vector3d innovation = there - state().template head<3>();
  innovation.z() = model::wrap_angle(innovation.z());
  Eigen::Matrix<double, 3, 5> by_state = Eigen::Matrix<double, 3, 5>::Identity();
  if (!fix.has_heading) {
    // The position alone: its heading came from the filter.
    noise = fix.covariance;
    noise(2, 2) = 1.0;
    innovation.z() = 0.0;
    by_state.row(2).setZero();
  }
  const Eigen::Matrix<double, 5, 3> with_fix = covariance_ * by_state.transpose();
  const Eigen::LDLT<Eigen::Matrix3d> root(Eigen::Matrix3d(by_state * with_fix + noise));
  if (gate_ > 0.0 && innovation.dot(root.solve(innovation)) > 3.0 * square(gate_)) return;
  correct(with_fix * root.solve(innovation));
  covariance_ -= with_fix * root.solve(with_fix.transpose());
  covariance_ = 0.5 * (covariance_ + covariance_.transpose()).eval();
}

}  // namespace groma::baseline
