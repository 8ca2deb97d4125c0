// Dead reckoning: propagates the state by odometry, with the yaw rate of an IMU in place of odometry's where
// there is one. Works on the filter's own state or on a copy that predicts ahead.
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

// The yaw rate of an IMU, used in place of odometry's: wheels slip, gyros do not.
struct Gyro {
  double used_s = -std::numeric_limits<double>::infinity();  // time of the last accepted sample
  double radps = 0.0;
  bool holds = false;  // whether it replaces odometry's yaw rate

  // Whether the sample is plausible after the last accepted one: no robot changes its yaw rate faster than
  // the bound. After a gap the sample is compared with odometry's rate, so that a constant wrong rate is
  // never accepted.
  [[nodiscard]] bool follows(const model::YawRateSample& sample, double odometry_radps,
                             double sigma_radps) const noexcept;
  [[nodiscard]] bool is_silent(double t_s) const noexcept;
};

// The timestamps of ranges and of odometry each have their own delay. Only the difference is observable from
// motion. Independent priors separate the two: mean and sigma of the range delay, and sigma of the odometry
// delay, whose mean is zero.
struct LinkDelays {
  double range_s = 0.0;
  double range_sigma_s = 0.0;
  double odometry_sigma_s = 0.0;

  // Prior variance of the difference, range delay minus odometry delay, whose mean is range_s.
  [[nodiscard]] double difference_variance_s2() const noexcept {
    return model::square(range_sigma_s) + model::square(odometry_sigma_s);
  }
  // Share (0 to 1) of a deviation of the difference from its mean that is attributed to the odometry delay,
  // with opposite sign.
  [[nodiscard]] double odometry_share() const noexcept {
    const double variance_s2 = difference_variance_s2();
    return variance_s2 > 0.0 ? model::square(odometry_sigma_s) / variance_s2 : 0.0;
  }
  // Mean and variance of the odometry delay given the difference.
  [[nodiscard]] double odometry_s(double difference_s) const noexcept {
    return odometry_share() * (range_s - difference_s);
  }
  [[nodiscard]] double odometry_variance_s2() const noexcept {
    return odometry_share() * range_sigma_s * range_sigma_s;
  }
};

// The pose now: the core state's pose, which lags by the odometry delay, propagated by that delay.
struct PresentPose {
  Eigen::Vector3d pose;   // x, y, theta, not wrapped
  PoseRows d_core;        // of pose, w.r.t. the core state
  Eigen::Matrix3d noise;  // covariance from the odometry delay's variance given the core state
  int chart = 0;
};
[[nodiscard]] PresentPose present_pose(const model::Surface& surface, const CoreVector& core,
                                       const model::OdometrySample& sample, const LinkDelays& delays,
                                       int chart = 0) noexcept;

// Everything that motion changes, except the covariance.
struct MotionState {
  explicit MotionState(const Config& config)
      : watch(config.max_acceleration_mps2), odometry_tuning(config.odometry), hold_s(config.max_hold_s) {}

  OdometryGate odometry_gate;
  OdometryWatch watch;
  SlipInflation slip;
  Gyro gyro;
  OdometryTuning odometry_tuning;
  CoreVector core = CoreVector::Zero();
  model::OdometrySample odometry{};
  bool has_sample = false;
  double hold_s;  // for how long the velocity of `odometry` is trusted: max_hold_s, or until the first
                  // implausible sample after it
  double t_s = 0.0;
  double way_m = 0.0;  // driven so far, horizontally
  int chart = 0;       // of the surface
};

// An input that propagates the state.
using MotionInput = std::variant<model::OdometrySample, model::YawRateSample>;

// Works on a state and covariance owned by the caller. Covariance: JointCovariance, or CoreCovariance for
// prediction without updates.
template <class Covariance>
struct DeadReckoning {
  const model::Surface& surface;
  const Config& config;
  double bias_length_m;  // correlation length of the slow range bias; 0: there is none
  const Gate* gate;      // the pose covariance grows while it suspects divergence; null: ignored
  MotionState& now;
  Covariance& covariance;

  // Propagates to a later time with the sample held.
  void advance_to(double t_s) noexcept;
  // Holds this sample from now on. If it is physically impossible: returns false and keeps the previous one.
  bool hold(const model::OdometrySample& sample) noexcept;
  // Holds this yaw rate in place of odometry's. If it is implausible after the previous one: returns false
  // and does nothing.
  bool turn(const model::YawRateSample& sample) noexcept;
  void set_chart(int chart) noexcept;
  void follow_chart() noexcept;

 private:
  void step(double dt_s) noexcept;
  void grow_position(double variance_m2) noexcept;
  // Bounds the variances of a pose that has become unknown.
  void bound_pose() noexcept;
  // Re-initializes one core state: zero, with this variance, uncorrelated.
  void renew(CoreIndex index, double variance) noexcept;
};

}  // namespace groma::filter
