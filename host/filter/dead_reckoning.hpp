// How the state goes on by odometry, and by the yaw rate of an IMU in the place of odometry's: the filter's
// own, or a copy of it that looks ahead.
#pragma once

#include <variant>

#include "host/filter/config.hpp"
#include "host/filter/gate.hpp"
#include "host/filter/gyro.hpp"
#include "host/filter/odometry_gate.hpp"
#include "host/filter/odometry_watch.hpp"
#include "host/filter/self_tuning.hpp"
#include "host/filter/slip_watch.hpp"
#include "host/filter/state.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// All that motion changes, but for the covariance.
struct MotionState {
  OdometryGate odometry_gate;
  OdometryWatch watch;
  SlipDoubt slip;
  Gyro gyro;
  OdometryTuning odometry_tuning;
  CoreVector core = CoreVector::Zero();
  model::OdometrySample row{};
  bool has_row = false;
  double hold_s = 0.0;  // for how long the velocity of row is trusted: max_hold_s, or to the first
                        // implausible sample after it
  double t_s = 0.0;
  int chart = 0;  // of the surface
};

// What moves the state.
using MotionInput = std::variant<model::OdometrySample, model::YawRateSample>;

// Works on a state and its covariance that live elsewhere. Covariance: JointCovariance, or CoreCovariance
// where nothing is to be corrected.
template <class Covariance>
class DeadReckoning {
 public:
  // slow_time_s: of the ranges' slow errors, 0 where there are none. While the gate doubts the state, the
  // covariance of the pose grows; without a gate by odometry's noise alone.
  DeadReckoning(const model::Surface& surface, const Config& config, double slow_time_s, const Gate* gate,
                MotionState& now, Covariance& covariance) noexcept
      : surface_(surface),
        config_(config),
        slow_time_s_(slow_time_s),
        gate_(gate),
        now_(now),
        covariance_(covariance) {}

  // To a later time, by the row held.
  void advance_to(double t_s) noexcept;
  // The row holds from now on; false, and the one before goes on holding, where no robot can do it.
  bool hold(const model::OdometrySample& row) noexcept;
  // The yaw rate does, in the place of the row's; false, and nothing done, where it cannot follow the one
  // before it.
  bool turn(const model::YawRateSample& sample) noexcept;
  // The errors of the row begin anew.
  void renew_row(const model::OdometryNoise& noise, const OdometryDoubt& doubt) noexcept;
  void stand_on(int chart) noexcept;
  void follow_chart() noexcept;

 private:
  void step(double dt_s) noexcept;
  // Where nothing is known of the pose any more, its variances stay as they are.
  void bound_pose() noexcept;
  // The state is unknown anew, but for that variance.
  void renew(CoreIndex index, double variance) noexcept;

  const model::Surface& surface_;
  const Config& config_;
  double slow_time_s_;
  const Gate* gate_;
  MotionState& now_;
  Covariance& covariance_;
};

}  // namespace groma::filter
