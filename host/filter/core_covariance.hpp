// The covariance of the core, and what the ground is to it, apart from the site's parameters: all that a look
// ahead by odometry needs, which corrects nothing.
#pragma once

#include <Eigen/Core>

#include "host/filter/state.hpp"

namespace groma::filter {

using GroundRows = Eigen::Matrix<double, kGroundSize, kCoreSize>;

// P <- F P F^T with F the identity but for the pose's rows, whose derivatives by the delay are zero.
void propagate_core(CoreMatrix& core, const PoseRows& pose_rows) noexcept;

// As JointCovariance's functions of the same names. Slow errors of ranges are not in it: they fade for
// nothing.
class CoreCovariance {
 public:
  // Of the core, of the ground with the core, and of the ground's height (m) and slopes, independent.
  CoreCovariance(const CoreMatrix& core, const GroundRows& ground_cross,
                 const Eigen::Vector3d& ground_variances)
      : core_(core), ground_cross_(ground_cross), ground_variances_(ground_variances) {}

  void renew_row(const Eigen::Vector3d& variances) noexcept;
  void renew(CoreIndex index, double variance) noexcept;
  void grow(CoreIndex index, double variance) noexcept { core_(index, index) += variance; }
  void propagate(const PoseRows& pose_rows) noexcept;
  void renew_ground(const Eigen::Vector3d& variances) noexcept;
  void fade_ground(double factor) noexcept { ground_cross_ *= factor; }
  void fade_slow_errors(double /*factor*/) noexcept {}

  [[nodiscard]] const CoreMatrix& core() const noexcept { return core_; }
  [[nodiscard]] const Eigen::Vector3d& ground_variances() const noexcept { return ground_variances_; }
  [[nodiscard]] const GroundRows& ground_cross() const noexcept { return ground_cross_; }

 private:
  CoreMatrix core_;
  GroundRows ground_cross_;
  Eigen::Vector3d ground_variances_;
};

}  // namespace groma::filter
