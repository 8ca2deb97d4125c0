// The factors of the graph, with their Jacobians.
#pragma once

#include <ceres/cost_function.h>
#include <ceres/sized_cost_function.h>

#include <utility>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include "test/baseline/graph.hpp"
#include "test/baseline/motion.hpp"

namespace groma::baseline {

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using Jacobian = Eigen::Map<RowMajor>;

// Unknowns of the odometry and the ranges' clock.
enum : Eigen::Index { kScale, kYawRateBias, kDelay, kOdometrySize };

// A range's parameters as functions of standard normal unknowns u of the anchor, f of the frame, l of the
// tag.
struct PairModel {
  const Pair* pair = nullptr;
  Eigen::MatrixXd root;                    // of position and terms by u
  Eigen::Matrix<double, 3, 4> frame_root;  // of the position by f
};

// (z - prediction)/sigma, negated; blocks: pose of the keyframe, odometry, u, l, f, and the slow bias if any.
class RangeCost final : public ceres::CostFunction {
 public:
  RangeCost(const model::Surface& surface, int chart, int range_chart, const PairModel& pair,
            const Increment& increment, double range_m, double sigma_m, double bias_sigma_m)
      : surface_(surface),
        chart_(chart),
        range_chart_(range_chart),
        pair_(pair),
        increment_(increment),
        range_m_(range_m),
        information_(1.0 / sigma_m),
        bias_sigma_m_(bias_sigma_m) {
    set_num_residuals(1);
    *mutable_parameter_block_sizes() = {3, kOdometrySize, static_cast<int>(pair.root.cols()), 3, 4};
    if (bias_sigma_m > 0.0) mutable_parameter_block_sizes()->push_back(1);
  }

  bool Evaluate(double const* const* x, double* residuals, double** jacobians) const override {
    const Eigen::Map<const Eigen::Vector3d> from(x[0]);
    const Eigen::Map<const Eigen::Vector3d> odometry(x[1]);
    const Eigen::Map<const Eigen::VectorXd> u(x[2], pair_.root.cols());
    const Eigen::Map<const Eigen::Vector3d> l(x[3]);
    const Eigen::Map<const Eigen::Vector4d> f(x[4]);

    // The pose at the measurement.
    const model::SurfacePose ground =
        model::pose_on_surface(surface_, {from.x(), from.y(), from.z(), chart_});
    const Eigen::Matrix2d flat = ground.rotation_wt.topLeftCorner<2, 2>();
    const Eigen::Vector2d unscaled = increment_.moved.head<2>() + odometry(kYawRateBias) * increment_.by_bias;
    const Eigen::Vector2d moved =
        (1.0 + odometry(kScale)) * unscaled - odometry(kDelay) * increment_.velocity.head<2>();
    const Eigen::Matrix2d rotation = turn(from.z());
    const Eigen::Vector2d offset = rotation * moved;
    const Eigen::Vector2d at = from.head<2>() + flat * offset;
    const double theta_rad = from.z() + increment_.moved.z() - odometry(kYawRateBias) * increment_.passed_s -
                             odometry(kDelay) * increment_.velocity.z();
    const model::PlanarPose planar{at.x(), at.y(), theta_rad, range_chart_};

    const Eigen::Matrix<double, model::kPairSize, 1> values = pair_.root * u;
    const Eigen::Vector3d anchor_m = pair_.pair->anchor_m + values.head<3>() + pair_.frame_root * f;
    const model::TermVector terms = pair_.pair->terms + values.tail<model::kPairTermCount>();
    const model::SurfaceRange range =
        model::predict_surface_range(surface_.at(at.x(), at.y(), range_chart_), planar,
                                     pair_.pair->lever_arm_m + kLeverArmSigma_m * l, anchor_m, terms);
    const double bias_m = bias_sigma_m_ > 0.0 ? bias_sigma_m_ * x[5][0] : 0.0;
    residuals[0] = information_ * (range.range_m + bias_m - range_m_);
    if (jacobians == nullptr) return true;

    const Eigen::RowVector2d by_xy = information_ * range.d_pose.head<2>();
    const double by_theta = information_ * range.d_pose.z();
    if (jacobians[0] != nullptr) {
      Eigen::Map<Eigen::RowVector3d> out(jacobians[0]);
      out << by_xy.x() + by_xy.dot(ground.d_rotation_wt_d_x.topLeftCorner<2, 2>() * offset),
          by_xy.y() + by_xy.dot(ground.d_rotation_wt_d_y.topLeftCorner<2, 2>() * offset),
          by_xy.dot(flat * (turn_by_angle(from.z()) * moved)) + by_theta;
    }
    if (jacobians[1] != nullptr) {
      const Eigen::RowVector2d by_moved = by_xy * (flat * rotation);
      Eigen::Map<Eigen::RowVector3d> out(jacobians[1]);
      out(kScale) = by_moved.dot(unscaled);
      out(kYawRateBias) =
          (1.0 + odometry(kScale)) * by_moved.dot(increment_.by_bias) - by_theta * increment_.passed_s;
      out(kDelay) = -by_moved.dot(increment_.velocity.head<2>()) - by_theta * increment_.velocity.z();
    }
    if (jacobians[2] != nullptr) {
      Eigen::Matrix<double, 1, model::kPairSize> by_values;
      by_values << range.d_anchor, range.d_terms.transpose();
      Jacobian(jacobians[2], 1, pair_.root.cols()) = information_ * by_values * pair_.root;
    }
    if (jacobians[3] != nullptr)
      Jacobian(jacobians[3], 1, 3) = information_ * kLeverArmSigma_m * range.d_lever_arm;
    if (jacobians[4] != nullptr)
      Jacobian(jacobians[4], 1, 4) = information_ * range.d_anchor * pair_.frame_root;
    if (bias_sigma_m_ > 0.0 && jacobians[5] != nullptr) jacobians[5][0] = information_ * bias_sigma_m_;
    return true;
  }

 private:
  const model::Surface& surface_;  // NOLINT(*-avoid-const-or-ref-data-members)
  int chart_;
  int range_chart_;
  const PairModel& pair_;  // NOLINT(*-avoid-const-or-ref-data-members)
  Increment increment_;
  double range_m_;
  double information_;
  double bias_sigma_m_;
};

// The motion between two keyframes, in the first one's frame, less the odometry's, whitened. Blocks: both
// poses, odometry. The slope is the mean of both ends'.
class OdometryCost final : public ceres::SizedCostFunction<3, 3, 3, kOdometrySize> {
 public:
  OdometryCost(const model::Surface& surface, int from_chart, int to_chart, const Increment& increment)
      : surface_(surface),
        from_chart_(from_chart),
        to_chart_(to_chart),
        increment_(increment),
        whitening_(increment.covariance.llt().matrixL().solve(Eigen::Matrix3d::Identity())) {}

  bool Evaluate(double const* const* x, double* residuals, double** jacobians) const override {
    const Eigen::Map<const Eigen::Vector3d> from(x[0]);
    const Eigen::Map<const Eigen::Vector3d> to(x[1]);
    const Eigen::Map<const Eigen::Vector3d> odometry(x[2]);
    const model::SurfacePose first =
        model::pose_on_surface(surface_, {from.x(), from.y(), from.z(), from_chart_});
    const model::SurfacePose second = model::pose_on_surface(surface_, {to.x(), to.y(), to.z(), to_chart_});
    const Eigen::Matrix2d flat =
        0.5 * (first.rotation_wt.topLeftCorner<2, 2>() + second.rotation_wt.topLeftCorner<2, 2>());
    const Eigen::Vector2d unscaled = increment_.moved.head<2>() + odometry(kYawRateBias) * increment_.by_bias;
    const Eigen::Vector2d moved = (1.0 + odometry(kScale)) * unscaled;
    const Eigen::Matrix2d rotation = turn(from.z());
    const Eigen::Matrix2d back = rotation.transpose();
    const Eigen::Vector2d offset = rotation * moved;
    const Eigen::Vector2d error = to.head<2>() - from.head<2>() - flat * offset;
    Eigen::Map<Eigen::Vector3d> out(residuals);
    Eigen::Vector3d residual;
    residual << back * error,
        to.z() - from.z() - increment_.moved.z() + odometry(kYawRateBias) * increment_.passed_s;
    out = whitening_ * residual;
    if (jacobians == nullptr) return true;

    const auto slope_x = [&](const model::SurfacePose& pose) -> Eigen::Vector2d {
      return 0.5 * (pose.d_rotation_wt_d_x.topLeftCorner<2, 2>() * offset);
    };
    const auto slope_y = [&](const model::SurfacePose& pose) -> Eigen::Vector2d {
      return 0.5 * (pose.d_rotation_wt_d_y.topLeftCorner<2, 2>() * offset);
    };
    Eigen::Matrix3d by;
    if (jacobians[0] != nullptr) {
      const Eigen::Matrix2d turned = turn_by_angle(from.z());
      by.setZero();
      by.topLeftCorner<2, 1>() = back * (-Eigen::Vector2d::UnitX() - slope_x(first));
      by.block<2, 1>(0, 1) = back * (-Eigen::Vector2d::UnitY() - slope_y(first));
      by.topRightCorner<2, 1>() = turned.transpose() * error - back * (flat * (turned * moved));
      by(2, 2) = -1.0;
      Jacobian(jacobians[0], 3, 3) = whitening_ * by;
    }
    if (jacobians[1] != nullptr) {
      by.setZero();
      by.topLeftCorner<2, 1>() = back * (Eigen::Vector2d::UnitX() - slope_x(second));
      by.block<2, 1>(0, 1) = back * (Eigen::Vector2d::UnitY() - slope_y(second));
      by(2, 2) = 1.0;
      Jacobian(jacobians[1], 3, 3) = whitening_ * by;
    }
    if (jacobians[2] != nullptr) {
      const Eigen::Matrix2d body = back * flat * rotation;
      by.setZero();
      by.topLeftCorner<2, 1>() = -body * unscaled;
      by.block<2, 1>(0, kYawRateBias) = -(1.0 + odometry(kScale)) * (body * increment_.by_bias);
      by(2, kYawRateBias) = increment_.passed_s;
      Jacobian(jacobians[2], 3, kOdometrySize) = whitening_ * by;
    }
    return true;
  }

 private:
  const model::Surface& surface_;  // NOLINT(*-avoid-const-or-ref-data-members)
  int from_chart_;
  int to_chart_;
  Increment increment_;
  Eigen::Matrix3d whitening_;
};

// root (x - at) + offset over several blocks: independent priors, and what marginalization leaves.
class LinearCost final : public ceres::CostFunction {
 public:
  LinearCost(const std::vector<int>& sizes, Eigen::MatrixXd root, Eigen::VectorXd at, Eigen::VectorXd offset)
      : root_(std::move(root)), at_(std::move(at)), offset_(std::move(offset)) {
    set_num_residuals(static_cast<int>(root_.rows()));
    *mutable_parameter_block_sizes() = sizes;
  }

  bool Evaluate(double const* const* x, double* residuals, double** jacobians) const override {
    Eigen::VectorXd change(at_.size());
    Eigen::Index begin = 0;
    for (std::size_t i = 0; i < parameter_block_sizes().size(); ++i) {
      const Eigen::Index size = parameter_block_sizes()[i];
      change.segment(begin, size) = Eigen::Map<const Eigen::VectorXd>(x[i], size) - at_.segment(begin, size);
      if (jacobians != nullptr && jacobians[i] != nullptr)
        Jacobian(jacobians[i], root_.rows(), size) = root_.middleCols(begin, size);
      begin += size;
    }
    Eigen::Map<Eigen::VectorXd>(residuals, root_.rows()) = root_ * change + offset_;
    return true;
  }

 private:
  Eigen::MatrixXd root_;
  Eigen::VectorXd at_;
  Eigen::VectorXd offset_;
};

}  // namespace groma::baseline
