// Who takes the measurements of a session.
#pragma once

#include "host/model/types.hpp"

namespace groma::daemon {

// All times are the robot's (the t_s of its odometry). Measurements come in the order of their times; one
// that was delayed by more than the session waits comes late, out of order, but at most SessionConfig::
// max_lateness_s behind the robot's present.
class MeasurementSink {
 public:
  MeasurementSink(const MeasurementSink&) = delete;
  MeasurementSink& operator=(const MeasurementSink&) = delete;
  virtual ~MeasurementSink() = default;

  virtual void on_odometry(const model::OdometrySample& row) = 0;
  virtual void on_range(const model::RangeSample& range) = 0;
  virtual void on_pose_prior(const model::PoseSample& pose) = 0;
  // Of a sensor beside odometry and ranges.
  virtual void on_sensor(const model::SensorSample& /*sample*/) {}
  // What waits for its turn, as soon as it is there: of a measurement that is passed on without a wait
  // nothing is told ahead. Rows of odometry come in the order of their times.
  virtual void on_odometry_ahead(const model::OdometrySample& /*row*/) {}
  virtual void on_sensor_ahead(const model::SensorSample& /*sample*/) {}
  // The robot's clock was set or the robot restarted: times before and after do not compare.
  virtual void on_clock_set() = 0;
  // The robot's clock was set by no more than SessionConfig::max_clock_error_s: its times before, plus that
  // step, are its times now. found_late: measurements with the new times were passed on before that.
  // Times fall back only where a step back was found at once; otherwise a link that delays for a while looks
  // the same, and what was collected stays.
  virtual void on_clock_step(double step_s, bool found_late) {
    if (step_s < 0.0 && !found_late) on_clock_set();
  }
  // Whether the times of odometry are in doubt from now on: its clock seems to have been set, or it arrives
  // late.
  virtual void on_odometry_times(bool /*doubtful*/) {}

 protected:
  MeasurementSink() = default;
};

}  // namespace groma::daemon
