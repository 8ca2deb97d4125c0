// Measurements in, poses out: one filter, started at the first pose prior or at a pose found from its ranges.
//
// The filter processes measurements in the order of their times; a session delays them for that. Each
// odometry sample gives a pose at once: a copy of the filter's state is propagated over the waiting
// odometry and yaw rates up to that sample. The filter itself does not change.
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
#include "host/model/odom_frame.hpp"
#include "host/model/pose.hpp"
#include "host/model/state_archive.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::daemon {

// base_link in the map frame.
struct PoseEstimate {
  double t_s = 0.0;  // robot time
  double x_m = 0.0;
  double y_m = 0.0;
  double z_m = 0.0;
  double roll_rad = 0.0;  // ZYX angles of R_WR
  double pitch_rad = 0.0;
  double yaw_rad = 0.0;                            // heading on the surface: R_WR = R_WT(x, y) R_z(yaw)
  Eigen::Vector4d quaternion{0.0, 0.0, 0.0, 1.0};  // x, y, z, w of R_WR; w is not negative
  Eigen::Matrix3d planar_covariance = Eigen::Matrix3d::Zero();  // of x_m, y_m, yaw_rad
  // Of x, y, z, roll, pitch, yaw. On an exact surface its rank is 3: z, roll and pitch follow from x, y and
  // yaw.
  Eigen::Matrix<double, 6, 6> covariance = Eigen::Matrix<double, 6, 6>::Zero();
  // Of base_link in base_link: vx, vy (m/s) and yaw rate (rad/s); NaN is unknown.
  Eigen::Vector3d velocity = Eigen::Vector3d::Zero();
  Eigen::Matrix3d velocity_covariance = Eigen::Matrix3d::Zero();
  std::optional<model::OdomPose> odom;  // at the same time; none: not known
  std::string_view floor;  // the chart's name, valid as long as the surface; empty if there is only one
  filter::State state = filter::State::kUninitialized;
  filter::Reason reason = filter::Reason::kNone;
};

// Maps a planar estimate onto the surface.
[[nodiscard]] PoseEstimate pose_on(const model::Surface& surface, const filter::Estimate& estimate) noexcept;

class Localizer : public MeasurementSink {
 public:
  struct Setup {
    model::Surface surface;
    std::vector<model::Tag> tags;
    model::Calibration calibration;
    filter::Config filter;
    filter::TrackerConfig tracker = {};
    // Receives each range, with what the filter did with it; may be empty.
    std::function<void(const model::RangeSample& range, const filter::RangeResult& result)> on_range = {};
  };

  using OnPose = std::function<void(const PoseEstimate&)>;

  // Waiting odometry samples and yaw rates that a prediction covers at most; the oldest are left out first.
  static constexpr std::size_t kMaxAhead = 1024;
  // A prediction is continued from sample to sample for this long, then restarted from the filter's state. So
  // the cost of a sample does not grow with the odometry rate. At 50 Hz and below each sample restarts it.
  static constexpr double kPredictionReuse_s = 0.018;

  // Once started, for each odometry sample:
  //   on_pose:     when the sample arrives, the pose at its time, predicted from the filter's state by the
  //                odometry and yaw rates that wait. State and reason are the filter's, but TRACKING requires
  //                that this pose is certain, odometry has not paused and its times are not suspect. Times
  //                increase.
  //   on_settled:  when the filter has used the sample, the filter's estimate at its newest time.
  Localizer(Setup setup, OnPose on_pose, OnPose on_settled = {});

  // Continues from the present pose with another calibration of the same site.
  void adopt(model::Calibration calibration);
  // Also with other lever arms of the same tags.
  void adopt(model::Calibration calibration, std::vector<model::Tag> tags);

  // Starts or restarts at a known pose instead of the first pose prior.
  void start(const filter::Start& start);
  // Starts at this pose, at the time of the next odometry sample, unless it has started by then.
  void start_at_next_odometry(const filter::Start& start) { next_start_ = start; }

  void on_odometry(const model::OdometrySample& sample) override;
  void on_range(const model::RangeSample& range) override;
  void on_pose_prior(const model::PoseSample& sample) override;
  void on_initial_pose(const model::PoseSample& sample) override;
  void on_sensor(const model::SensorSample& sample) override;
  void on_odometry_ahead(const model::OdometrySample& sample) override;
  void on_sensor_ahead(const model::SensorSample& sample) override;
  void on_clock_set() override;                                 // restarts without a pose
  void on_clock_step(double step_s, bool found_late) override;  // continues; CONVERGING until ranges agree
  void on_odometry_times(bool suspect) override { times_suspect_ = suspect; }

  [[nodiscard]] bool started() const noexcept { return tracker_->started(); }
  [[nodiscard]] filter::State state() const noexcept { return tracker_->state(); }
  // An error of the setup that the ranges show: map-mismatch, or nothing.
  [[nodiscard]] std::optional<diagnosis::Finding> finding() const;
  // Samples of odometry and other sensors that were dropped as physically impossible.
  [[nodiscard]] std::uint64_t implausible() const noexcept { return implausible_; }
  [[nodiscard]] const model::Calibration& calibration() const noexcept { return setup_.calibration; }
  [[nodiscard]] const filter::Filter& filter() const noexcept { return tracker_->filter().filter(); }

  // Of a localizer with the same surface and configuration; tags and calibration are part of it.
  void archive(model::StateArchive& state);

 private:
  using Ahead = std::vector<filter::MotionInput>;

  // The filter's own time stays continuous when the robot's clock is set.
  template <typename Sample>
  [[nodiscard]] Sample in_own_time(Sample sample) const noexcept {
    sample.t_s -= clock_s_;
    return sample;
  }
  void begin(const filter::Start& start);
  void make_tracker();
  void forget_times() noexcept;
  // Notes the arrival of an odometry sample of that time, late or not.
  void note_odometry_time(double t_s) noexcept;
  [[nodiscard]] PoseEstimate pose_of(const filter::Estimate& estimate) const;
  // The estimate after the inputs of ahead_ before `end`; continues the stored prediction or starts a new
  // one.
  [[nodiscard]] filter::Estimate predict(double t_s, Ahead::const_iterator end);
  // Inserts the input in order into ahead_; returns the position after it.
  Ahead::const_iterator insert_waiting(const filter::MotionInput& input);
  // Removes the input and all before it: the filter gets them now.
  void remove_waiting_until(const filter::MotionInput& input);

  Setup setup_;
  OnPose on_pose_;
  OnPose on_settled_;
  std::unique_ptr<filter::Tracker> tracker_;
  std::optional<filter::Start> next_start_;
  Ahead ahead_;             // in order; never exceeds the reserved capacity
  double last_odometry_s_;  // the newest odometry sample that arrived
  double paused_until_s_ = -std::numeric_limits<double>::infinity();  // the sample that ended a pause
  double clock_s_ = 0.0;                                              // robot time less filter time
  bool times_suspect_ = false;
  std::optional<filter::Filter::Prediction> prediction_;
  double predicted_since_s_ = 0.0;       // the sample that started it
  filter::MotionInput last_propagated_;  // the last input that it includes
  std::uint64_t implausible_ = 0;
};

}  // namespace groma::daemon
