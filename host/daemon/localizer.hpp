// Measurements in, poses out: one filter, started at the first pose prior or where its ranges tell.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "host/daemon/measurement_sink.hpp"
#include "host/filter/config.hpp"
#include "host/filter/filter.hpp"
#include "host/filter/tracker.hpp"
#include "host/model/calibration.hpp"
#include "host/model/pose.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::daemon {

// base_link in the map frame, at a time of the robot.
struct PoseEstimate {
  double t_s = 0.0;
  double x_m = 0.0;
  double y_m = 0.0;
  double z_m = 0.0;
  double roll_rad = 0.0;  // ZYX angles of R_WR
  double pitch_rad = 0.0;
  double yaw_rad = 0.0;  // heading on the surface: R_WR = R_WT(x, y) R_z(yaw)
  Eigen::Matrix3d planar_covariance = Eigen::Matrix3d::Zero();  // of x_m, y_m, yaw_rad
  // Of x, y, z, roll, pitch, yaw. Where the surface is exact, of rank 3: z, roll and pitch then follow from
  // x, y and yaw.
  Eigen::Matrix<double, 6, 6> covariance = Eigen::Matrix<double, 6, 6>::Zero();
  std::string_view floor;  // the chart's name, as long as the surface lives; empty where there is but one
  filter::State state = filter::State::kUninitialized;
  filter::Reason reason = filter::Reason::kNone;
};

// A planar estimate carried onto the surface.
[[nodiscard]] PoseEstimate pose_on(const model::Surface& surface, const filter::Estimate& estimate) noexcept;

class Localizer : public MeasurementSink {
 public:
  struct Setup {
    model::Surface surface;
    std::vector<model::Tag> tags;
    model::Calibration calibration;
    filter::Config filter;
    filter::TrackerConfig tracker = {};
  };

  // `on_pose` is called for each odometry row used once started, with the state at the row's time.
  Localizer(Setup setup, std::function<void(const PoseEstimate&)> on_pose);

  // Goes on by another calibration of the same site from where it is.
  void adopt(model::Calibration calibration);

  // Starts, or starts anew, at a known pose instead of the first pose prior.
  void start(const filter::Start& start);

  void on_odometry(const model::OdometrySample& row) override;
  void on_range(const model::RangeSample& range) override;
  void on_pose_prior(const model::PoseSample& pose) override;
  void on_sensor(const model::SensorSample& sample) override;
  void on_clock_set() override;  // begins anew

  [[nodiscard]] bool started() const noexcept { return tracker_->started(); }
  [[nodiscard]] filter::State state() const noexcept { return tracker_->state(); }
  [[nodiscard]] const filter::Filter& filter() const noexcept { return tracker_->filter().filter(); }

 private:
  void renew();

  Setup setup_;
  std::function<void(const PoseEstimate&)> on_pose_;
  std::unique_ptr<filter::Tracker> tracker_;
};

}  // namespace groma::daemon
