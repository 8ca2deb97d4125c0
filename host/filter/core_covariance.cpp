#include "host/filter/core_covariance.hpp"

namespace groma::filter {

void propagate_core(CoreMatrix& core, const PoseRows& f) noexcept {
  // The heading's row has three terms. lazyProduct: Eigen would go through its kernels for large matrices.
  PoseRows fp;
  fp.topRows<2>() = f.topRows<2>().lazyProduct(core);
  fp.row(kTheta) = core.row(kTheta) + f(kTheta, kYawBias) * core.row(kYawBias) +
                   f(kTheta, kRowOmega) * core.row(kRowOmega);
  const Eigen::Matrix<double, 3, 2> by_position = fp.lazyProduct(f.topRows<2>().transpose());
  const double heading = fp(kTheta, kTheta) + f(kTheta, kYawBias) * fp(kTheta, kYawBias) +
                         f(kTheta, kRowOmega) * fp(kTheta, kRowOmega);
  core.topRows<3>() = fp;
  core.leftCols<3>() = fp.transpose();
  core.topLeftCorner<3, 2>() = by_position;
  core(kX, kY) = core(kY, kX);
  core(kX, kTheta) = core(kTheta, kX);
  core(kY, kTheta) = core(kTheta, kY);
  core(kTheta, kTheta) = heading;
}

void CoreCovariance::renew_row(const Eigen::Vector3d& variances) noexcept {
  core_.bottomRows<3>().setZero();
  core_.rightCols<3>().setZero();
  core_.diagonal().tail<3>() = variances;
  ground_cross_.rightCols<3>().setZero();
}

void CoreCovariance::renew(CoreIndex index, double variance) noexcept {
  core_.row(index).setZero();
  core_.col(index).setZero();
  core_(index, index) = variance;
  ground_cross_.col(index).setZero();
}

void CoreCovariance::propagate(const PoseRows& pose_rows) noexcept {
  propagate_core(core_, pose_rows);
  const Eigen::Matrix3d moved = ground_cross_.lazyProduct(pose_rows.transpose());
  ground_cross_.leftCols<3>() = moved;
}

void CoreCovariance::renew_ground(const Eigen::Vector3d& variances) noexcept {
  ground_cross_.setZero();
  ground_variances_ = variances;
}

}  // namespace groma::filter
