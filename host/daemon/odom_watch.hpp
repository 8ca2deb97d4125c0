// base_link in the frame odom at each odometry sample: as the robot gave it, or from its velocities.
#pragma once

#include <cmath>
#include <optional>

#include "host/daemon/measurement_sink.hpp"
#include "host/daemon/session.hpp"
#include "host/model/odom_frame.hpp"
#include "host/model/state_archive.hpp"

namespace groma::daemon {

// To be attached before the sinks that give poses.
class OdomWatch : public MeasurementSink {
 public:
  void on_odometry(const model::OdometrySample& /*sample*/) override {}
  void on_range(const model::RangeSample& /*range*/) override {}
  void on_pose_prior(const model::PoseSample& /*pose*/) override {}
  void on_odometry_ahead(const model::OdometrySample& sample) override { integrated_.take(sample); }
  void on_clock_set() override { integrated_.forget_time(); }
  void on_clock_step(double step_s, bool /*found_late*/) override { integrated_.shift_time(step_s); }

  // At t_s; none if the newest odometry sample is of another time.
  [[nodiscard]] std::optional<model::OdomPose> at(double t_s, const Session& session) const {
    if (session.gives_odom()) return session.odom_pose(t_s);
    const std::optional<model::OdomPose> newest = integrated_.pose();
    constexpr double kSame_s = 1e-6;
    return newest && std::abs(newest->t_s - t_s) < kSame_s ? newest : std::nullopt;
  }

  void archive(model::StateArchive& state) { state(integrated_); }

 private:
  model::OdomFrame integrated_;
};

}  // namespace groma::daemon
