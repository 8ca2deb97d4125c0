// The receiver of a session's measurements.
#pragma once

#include "host/model/types.hpp"

namespace groma::daemon {

// All times are robot time (the t_s of its odometry). Measurements come in the order of their times. A
// measurement that was delayed by more than the session's reorder lag comes out of order, at most
// SessionConfig::max_delay_s behind the robot's present.
class MeasurementSink {
 public:
  MeasurementSink(const MeasurementSink&) = delete;
  MeasurementSink& operator=(const MeasurementSink&) = delete;
  virtual ~MeasurementSink() = default;

  virtual void on_odometry(const model::OdometrySample& sample) = 0;
  virtual void on_range(const model::RangeSample& range) = 0;
  virtual void on_pose_prior(const model::PoseSample& pose) = 0;
  // Localization is to restart at this pose.
  virtual void on_initial_pose(const model::PoseSample& /*pose*/) {}
  // Before on_range(): the range with its time as received, which on_range() has corrected by the
  // calibration's range_clock.
  virtual void on_uncorrected_range(const model::RangeSample& /*range*/) {}
  // A sample of a sensor other than odometry and ranges.
  virtual void on_sensor(const model::SensorSample& /*sample*/) {}
  // A sample that waits for its turn, as soon as it arrives; a late measurement, which does not wait, is not
  // announced. Odometry samples are announced in the order of their times.
  virtual void on_odometry_ahead(const model::OdometrySample& /*sample*/) {}
  virtual void on_sensor_ahead(const model::SensorSample& /*sample*/) {}
  // The robot's clock was set or the robot restarted: times before and after are not comparable.
  virtual void on_clock_set() = 0;
  // The robot's clock was set while the robot went on: a time of the old clock plus step_s is a time of the
  // new one. found_late: measurements with new times were passed on before the step was found. By default a
  // sink discards its data after a long step, and after a step back that was found at once. A short one found
  // late may also be a link that delayed for a while, so the data stays.
  static constexpr double kLongStep_s = 1.0;
  virtual void on_clock_step(double step_s, bool found_late) {
    if (step_s > kLongStep_s || (step_s < 0.0 && !found_late)) on_clock_set();
  }
  // Whether the times of odometry are suspect from now on: its clock seems to have been set, or it arrives
  // late.
  virtual void on_odometry_times(bool /*suspect*/) {}

 protected:
  MeasurementSink() = default;
};

}  // namespace groma::daemon
