// How the state goes on by odometry, and by the yaw rate of an IMU in the place of odometry's: the filter's
// own, or a copy of it that looks ahead.
#pragma once

#include <limits>
#include <variant>

#include <Eigen/Core>

#include "host/filter/config.hpp"
#include "host/filter/gate.hpp"
#include "host/filter/odometry_gate.hpp"
#include "host/filter/self_tuning.hpp"
#include "host/filter/slip_watch.hpp"
#include "host/filter/state.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// The yaw rate of an IMU in the place of odometry's: wheels slip, gyros do not.
struct Gyro {
  double used_s = -std::numeric_limits<double>::infinity();  // time of the last sample that was used
  double radps = 0.0;
  bool holds = false;  // in the place of odometry's

  // Whether the sample can follow the last one that was used, or after a gap the rate that holds in its
  // place: no robot turns that much faster within that time. A rate that jumped away does not become right by
  // lasting: after the gap it has to be near odometry's.
  [[nodiscard]] bool follows(const model::YawRateSample& sample, double odometry_radps,
                             double sigma_radps) const noexcept;
  [[nodiscard]] bool is_silent(double t_s) const noexcept;
};

// Ranges and odometry each come late by a time of their own. The motion shows only the difference; their
// independent priors separate it: of the ranges' delay a mean and sigma, of the odometry's a sigma about
// zero.
struct LinkDelays {
  double range_s = 0.0;
  double range_sigma_s = 0.0;
  double odometry_sigma_s = 0.0;

  // Variance of the difference, ranges' less odometry's, whose mean is range_s.
  [[nodiscard]] double difference_variance_s2() const noexcept {
    return model::square(range_sigma_s) + model::square(odometry_sigma_s);
  }
  // How much of a surprise in the difference is the odometry's, 0 .. 1: by that share its delay is shorter
  // where the difference is larger.
  [[nodiscard]] double odometry_share() const noexcept {
    const double variance_s2 = difference_variance_s2();
    return variance_s2 > 0.0 ? model::square(odometry_sigma_s) / variance_s2 : 0.0;
  }
  // The odometry's delay by a difference, and its variance were that difference known.
  [[nodiscard]] double odometry_s(double difference_s) const noexcept {
    return odometry_share() * (range_s - difference_s);
  }
  [[nodiscard]] double odometry_variance_s2() const noexcept {
    return odometry_share() * range_sigma_s * range_sigma_s;
  }
};

// The pose now. The core state's is where the robot was when its odometry was true: where odometry comes
// late, some way behind.
struct PresentPose {
  Eigen::Vector3d pose;  // x, y, theta, not wrapped
  PoseRows d_core;
  Eigen::Matrix3d noise;  // covariance by what the core does not tell of the odometry's delay
  int chart = 0;
};
[[nodiscard]] PresentPose present_pose(const model::Surface& surface, const CoreVector& core,
                                       const model::OdometrySample& row, const LinkDelays& delays,
                                       int chart = 0) noexcept;

// All that motion changes, but for the covariance.
struct MotionState {
  explicit MotionState(const Config& config)
      : watch(config.max_acceleration_mps2), odometry_tuning(config.odometry), hold_s(config.max_hold_s) {}

  OdometryGate odometry_gate;
  OdometryWatch watch;
  SlipDoubt slip;
  Gyro gyro;
  OdometryTuning odometry_tuning;
  CoreVector core = CoreVector::Zero();
  model::OdometrySample row{};
  bool has_row = false;
  double hold_s;  // for how long the velocity of row is trusted: max_hold_s, or to the first implausible
                  // sample after it
  double t_s = 0.0;
  int chart = 0;  // of the surface
};

// What moves the state.
using MotionInput = std::variant<model::OdometrySample, model::YawRateSample>;

// Works on a state and its covariance that live elsewhere. Covariance: JointCovariance, or CoreCovariance
// where nothing is to be corrected.
template <class Covariance>
struct DeadReckoning {
  const model::Surface& surface;
  const Config& config;
  double slow_time_s;  // of the ranges' slow errors, 0 where there are none
  const Gate* gate;    // while it suspects divergence the pose's covariance grows; without, by odometry alone
  MotionState& now;
  Covariance& covariance;

  // To a later time, by the row held.
  void advance_to(double t_s) noexcept;
  // The row holds from now on; false, and the one before goes on holding, where no robot can do it.
  bool hold(const model::OdometrySample& row) noexcept;
  // The yaw rate does, in the place of the row's; false, and nothing done, where it cannot follow the one
  // before it.
  bool turn(const model::YawRateSample& sample) noexcept;
  void stand_on(int chart) noexcept;
  void follow_chart() noexcept;

 private:
  void step(double dt_s) noexcept;
  void grow_position(double variance_m2) noexcept;
  // Where nothing is known of the pose any more, its variances stay as they are.
  void bound_pose() noexcept;
  // The state is unknown anew, but for that variance.
  void renew(CoreIndex index, double variance) noexcept;
};

}  // namespace groma::filter
