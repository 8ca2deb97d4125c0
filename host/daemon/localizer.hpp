// Measurements in, poses out: one filter, started at the first pose prior or where its ranges tell.
//
// The filter takes measurements in their order, which a session makes them wait for. Each row of odometry is
// answered as soon as it is there: the filter's state is carried on over what waits, up to that row, and the
// filter stays as it is.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <memory>
#include <optional>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "host/daemon/measurement_sink.hpp"
#include "host/diagnosis/finding.hpp"
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

  using OnPose = std::function<void(const PoseEstimate&)>;

  // Rows and yaw rates that are carried over; of more that wait the oldest are left out.
  static constexpr std::size_t kMaxAhead = 1024;
  // A prediction is carried on from row to row for so long, then it begins at the filter's state again: what
  // a row costs does not grow with their rate. At 50 Hz and below it begins there with each row.
  static constexpr double kPredictionLasts_s = 0.018;

  // Once started, for each row of odometry:
  //   on_pose:     when it comes in, at its time, by the measurements that were passed on and by odometry and
  //                yaw rates since. State and reason are those of the measurements that were passed on, but
  //                TRACKING only where this very pose is certain and its odometry neither paused nor is in
  //                doubt. Times increase.
  //   on_settled:  when it is passed on and used, by all until then, at the time of the newest.
  Localizer(Setup setup, OnPose on_pose, OnPose on_settled = {});

  // Goes on by another calibration of the same site from where it is.
  void adopt(model::Calibration calibration);

  // Starts, or starts anew, at a known pose instead of the first pose prior.
  void start(const filter::Start& start);

  void on_odometry(const model::OdometrySample& sample) override;
  void on_range(const model::RangeSample& range) override;
  void on_pose_prior(const model::PoseSample& sample) override;
  void on_sensor(const model::SensorSample& sample) override;
  void on_odometry_ahead(const model::OdometrySample& sample) override;
  void on_sensor_ahead(const model::SensorSample& sample) override;
  void on_clock_set() override;                                 // begins anew
  void on_clock_step(double step_s, bool found_late) override;  // goes on, and proves its pose again
  void on_odometry_times(bool doubtful) override { times_doubtful_ = doubtful; }

  [[nodiscard]] bool started() const noexcept { return tracker_->started(); }
  [[nodiscard]] filter::State state() const noexcept { return tracker_->state(); }
  // What the ranges show to be wrong with the setup, if anything.
  [[nodiscard]] std::optional<diagnosis::Finding> finding() const;
  // Samples of odometry and other sensors that were dropped, for no robot can do what they say.
  [[nodiscard]] std::uint64_t implausible() const noexcept { return implausible_; }
  [[nodiscard]] const filter::Filter& filter() const noexcept { return tracker_->filter().filter(); }

 private:
  using Ahead = std::vector<filter::MotionInput>;

  // The filter's own time goes on evenly while the robot's clock is set.
  template <typename Sample>
  [[nodiscard]] Sample in_own_time(Sample sample) const noexcept {
    sample.t_s -= clock_s_;
    return sample;
  }
  void begin(const filter::Start& start);
  void renew();
  void forget_times() noexcept;
  // A row of that time, late or not.
  void came_in(double t_s) noexcept;
  [[nodiscard]] PoseEstimate pose_of(const filter::Estimate& estimate) const;
  // The estimate at `end` of what waits, by the prediction kept or by a new one.
  [[nodiscard]] filter::Estimate predict(double t_s, Ahead::const_iterator end);
  // Puts it in its place among what waits; returns the place behind it.
  Ahead::const_iterator await(const filter::MotionInput& input);
  // It was passed on, and with it all before it.
  void arrived(const filter::MotionInput& input);

  Setup setup_;
  OnPose on_pose_;
  OnPose on_settled_;
  std::unique_ptr<filter::Tracker> tracker_;
  Ahead ahead_;        // in order; never grows beyond what is reserved
  double last_row_s_;  // of the rows that came in
  double paused_until_s_ = -std::numeric_limits<double>::infinity();  // the row that ended a pause
  double clock_s_ = 0.0;                                              // the robot's time less the filter's
  bool times_doubtful_ = false;
  std::optional<filter::Filter::Prediction> prediction_;
  double predicted_since_s_ = 0.0;  // the row that it began with
  filter::MotionInput carried_;     // the last input that it has
  std::uint64_t implausible_ = 0;
};

}  // namespace groma::daemon
