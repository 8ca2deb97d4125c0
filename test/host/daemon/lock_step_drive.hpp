// A robot on a curved drive at changing speed, with one tag, in lock step with a session and a localizer, on
// simulated clocks and without sockets. Tests change the timestamps of the robot's messages.
#pragma once

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/LU>

#include "host/clock/time_mapper.hpp"
#include "host/daemon/localizer.hpp"
#include "host/daemon/session.hpp"
#include "host/model/calibration.hpp"
#include "test/host/link/node_frames.hpp"
#include "test/support/random.hpp"

namespace groma::daemon::test {

enum class Kind { kOdometry, kImu, kGnss, kAbsolutePose, kPosePrior };

class LockStepDrive {
 public:
  static constexpr double kBegin_s = 10.0;
  static constexpr double kReportPeriod_s = 0.05;

  // A message as sent: the content of one host time, with another timestamp.
  struct Sent {
    Sent(double timestamp_s) : t_s(timestamp_s) {}  // NOLINT: content of the present
    Sent(double timestamp_s, double time_s) : t_s(timestamp_s), of_s(time_s) {}
    double t_s = 0.0;
    std::optional<double> of_s{};  // only for odometry; none: the present
  };
  // Called with the correct t_s of each message; returns the messages to send instead, none to drop it.
  using Timestamps = std::function<std::vector<Sent>(Kind kind, double t_s)>;

  struct Options {
    double odometry_hz = 50.0;
    bool sensors = false;  // IMU at 100 Hz, GNSS at 5 Hz, absolute poses at 5 Hz
    bool ranges = true;
    SessionConfig session = {};
  };

  // A published pose.
  struct Moment {
    double host_s = 0.0;
    PoseEstimate pose;
    double error_m = 0.0;
    double squared = 0.0;  // e' P^-1 e of x, y, yaw
  };

  LockStepDrive() : LockStepDrive(Options{}) {}
  explicit LockStepDrive(const Options& options) : options_(options), session_(with_log(options.session)) {
    Localizer::Setup setup;
    setup.tags = {{1, {0.2, 0.0, 0.5}}};
    for (int i = 0; i < 6; ++i) {
      const double angle = i * 1.0472;
      anchors_.push_back({static_cast<model::NodeId>(100 + i),
                          {11.0 * std::cos(angle), 10.0 * std::sin(angle), 1.0 + 0.6 * (i % 3)}});
    }
    model::RangePriors priors;
    priors.sigma_m = 0.08;
    priors.beta_m = {0.0, 0.05};
    setup.calibration = model::surveyed_calibration(anchors_, setup.tags, priors, 0.02);
    setup.filter.odometry = {0.02, 0.02, 0.006};
    setup.filter.range_sigma_m = 0.08;
    tag_ = session_.add_node("tag-1", 0);
    localizer_ =
        std::make_unique<Localizer>(std::move(setup), [this](const PoseEstimate& pose) { note(pose); });
    session_.attach(*localizer_);
  }

  static model::PlanarPose truth(double host_s) {
    const double a = 0.2 * host_s;
    const double vx = std::cos(a);
    const double vy = 1.2 * std::cos(2.0 * a);
    return {5.0 * std::sin(a), 3.0 * std::sin(2.0 * a), std::atan2(vy, vx)};
  }

  // Runs until that host time.
  void run(double to_s) {
    while (now_s_ < to_s) {
      const double odometry_s = kBegin_s + static_cast<double>(odometry_) / options_.odometry_hz;
      const double sensor_s = options_.sensors ? kBegin_s + 0.003 + 0.01 * sensors_ : 1e300;
      const double report_s = kBegin_s + 0.002 + kReportPeriod_s * reports_;
      now_s_ = std::min({odometry_s, sensor_s, report_s});
      if (now_s_ == odometry_s) {
        send_odometry();
      } else if (now_s_ == sensor_s) {
        send_sensors();
      } else {
        send_report();
      }
      session_.advance(now_s_);
    }
  }

  void pause_ranges(bool pause) { options_.ranges = !pause; }
  // From now on the robot's clock is ahead of the host's by this; used to compare poses with the truth.
  void set_robot_clock(double ahead_s) { robot_ahead_s_ = ahead_s; }

  void send(const std::string& line) {
    session_.robot_bytes({reinterpret_cast<const std::uint8_t*>(line.data()), line.size()}, now_s_);
  }
  // Sends the odometry of host time of_s with the timestamp t_s.
  void send_odometry_at(double t_s, double of_s) {
    groma::test::Random random = noise(1, std::lround(of_s * options_.odometry_hz));
    constexpr double kStep_s = 1e-4;
    const double mid_s = of_s + 0.5 / options_.odometry_hz;
    const auto before = truth(mid_s - kStep_s);
    const auto after = truth(mid_s + kStep_s);
    const double speed = std::hypot(after.x_m - before.x_m, after.y_m - before.y_m) / (2.0 * kStep_s);
    const double turn = model::wrap_angle(after.theta_rad - before.theta_rad) / (2.0 * kStep_s);
    send(fmt::format("{{\"class\":\"ODOMETRY\",\"t_s\":{},\"vx_mps\":{},\"vy_mps\":{},\"omega_radps\":{}}}\n",
                     t_s, speed + 0.02 * random.gaussian(), 0.02 * random.gaussian(),
                     turn + 0.006 * random.gaussian()));
  }

  [[nodiscard]] double now_s() const { return now_s_; }
  [[nodiscard]] Session& session() { return session_; }
  [[nodiscard]] Localizer& localizer() { return *localizer_; }
  [[nodiscard]] const std::vector<Moment>& moments() const { return moments_; }
  [[nodiscard]] const std::vector<std::string>& log() const { return log_; }

  // Mean error of the poses published in that host time.
  [[nodiscard]] double mean_error_m(double from_s, double to_s = 1e9) const {
    double sum_m = 0.0;
    std::size_t count = 0;
    for (const Moment& moment : moments_) {
      if (moment.host_s < from_s || moment.host_s >= to_s) continue;
      sum_m += moment.error_m;
      ++count;
    }
    return count > 0 ? sum_m / static_cast<double>(count) : 1e9;
  }
  // TRACKING poses whose squared Mahalanobis distance (3 dimensions) is not below the bound.
  [[nodiscard]] int wrong_tracking(double bound = kFiveSigmas) const {
    int wrong = 0;
    for (const Moment& moment : moments_) {
      if (moment.pose.state == filter::State::kTracking && !(moment.squared < bound)) ++wrong;
    }
    return wrong;
  }
  [[nodiscard]] double worst_tracking_m(double from_s) const {
    double worst_m = 0.0;
    for (const Moment& moment : moments_) {
      if (moment.host_s >= from_s && moment.pose.state == filter::State::kTracking)
        worst_m = std::max(worst_m, moment.error_m);
    }
    return worst_m;
  }
  [[nodiscard]] double largest_gap_s(double from_s) const {
    double gap_s = 0.0;
    double last_s = from_s;
    for (const Moment& moment : moments_) {
      if (moment.host_s < from_s) continue;
      gap_s = std::max(gap_s, moment.host_s - last_s);
      last_s = moment.host_s;
    }
    return std::max(gap_s, now_s_ - last_s);
  }
  [[nodiscard]] double tracking_share(double from_s, double to_s = 1e9) const {
    double tracking = 0.0;
    double all = 0.0;
    for (const Moment& moment : moments_) {
      if (moment.host_s < from_s || moment.host_s >= to_s) continue;
      all += 1.0;
      if (moment.pose.state == filter::State::kTracking) tracking += 1.0;
    }
    return all > 0.0 ? tracking / all : 0.0;
  }

  // Bound of chi-squared with 3 degrees of freedom, at about 5 sigma of a Gaussian.
  static constexpr double kFiveSigmas = 34.6;
  Timestamps timestamps = [](Kind, double t_s) { return std::vector<Sent>{t_s}; };

 private:
  [[nodiscard]] SessionConfig with_log(SessionConfig config) {
    config.log = [this](std::string_view text) { log_.emplace_back(text); };
    return config;
  }

  void note(const PoseEstimate& pose) {
    const auto true_pose = truth(pose.t_s - robot_ahead_s_);
    const Eigen::Vector3d error(pose.x_m - true_pose.x_m, pose.y_m - true_pose.y_m,
                                model::wrap_angle(pose.yaw_rad - true_pose.theta_rad));
    moments_.push_back(
        {now_s_, pose, error.head<2>().norm(), error.dot(pose.planar_covariance.inverse() * error)});
  }

  void send_odometry() {
    for (const Sent& sent : timestamps(Kind::kOdometry, now_s_)) {
      send_odometry_at(sent.t_s, sent.of_s.value_or(now_s_));
    }
    if (odometry_ % std::lround(options_.odometry_hz) == 0) {
      const auto pose = truth(now_s_);
      for (const auto& [t_s, of_s] : timestamps(Kind::kPosePrior, now_s_)) {
        send(fmt::format(
            "{{\"class\":\"POSE_PRIOR\",\"t_s\":{},\"x_m\":{},\"y_m\":{},\"z_m\":0,\"yaw_rad\":{}}}\n", t_s,
            pose.x_m, pose.y_m, pose.theta_rad));
      }
    }
    ++odometry_;
  }

  // Each message has a random stream of its own, so its noise does not depend on the other messages.
  static groma::test::Random noise(std::uint64_t kind, long index) {
    return groma::test::Random(1'000'000'007U * kind + static_cast<std::uint64_t>(index));
  }

  void send_sensors() {
    groma::test::Random random = noise(2, sensors_);
    constexpr double kStep_s = 1e-4;
    const auto pose = truth(now_s_);
    const auto after = truth(now_s_ + kStep_s);
    const double turn = model::wrap_angle(after.theta_rad - pose.theta_rad) / kStep_s;
    for (const auto& [t_s, of_s] : timestamps(Kind::kImu, now_s_)) {
      send(fmt::format("{{\"class\":\"IMU\",\"t_s\":{},\"omega_radps\":{}}}\n", t_s,
                       turn + 0.005 * random.gaussian()));
    }
    if (sensors_ % 20 == 5) {
      for (const auto& [t_s, of_s] : timestamps(Kind::kGnss, now_s_)) {
        send(fmt::format(
            "{{\"class\":\"GNSS\",\"t_s\":{},\"x_m\":{},\"y_m\":{},\"covariance\":[0.25,0,0,0.25]}}\n", t_s,
            pose.x_m + 0.5 * random.gaussian(), pose.y_m + 0.5 * random.gaussian()));
      }
    }
    if (sensors_ % 20 == 10) {
      for (const auto& [t_s, of_s] : timestamps(Kind::kAbsolutePose, now_s_)) {
        send(fmt::format(
            "{{\"class\":\"ABSOLUTE_POSE\",\"t_s\":{},\"x_m\":{},\"y_m\":{},\"yaw_rad\":{},\"covariance\":"
            "[0.01,0,null,null,null,0,0,0.01,null,null,null,0,{},{},{},0,0,null,null,null,0.0025]}}\n",
            t_s, pose.x_m + 0.1 * random.gaussian(), pose.y_m + 0.1 * random.gaussian(),
            pose.theta_rad + 0.05 * random.gaussian(), kNulls, kNulls, kNulls));
      }
    }
    ++sensors_;
  }

  void send_report() {
    const auto ticks = [](double s) { return std::llround(s * clock::kDeviceTicksPerSecond); };
    groma::test::Random random = noise(3, reports_);
    std::vector<groma_Range> ranges;
    for (std::size_t i = 0; i < anchors_.size(); ++i) {
      const double age_s = 0.06 - 0.005 * static_cast<double>(i);
      const auto pose = truth(now_s_ - age_s);
      const Eigen::Vector3d tag(pose.x_m + 0.2 * std::cos(pose.theta_rad),
                                pose.y_m + 0.2 * std::sin(pose.theta_rad), 0.5);
      const double range_m = (tag - anchors_[i].position_m).norm() + 0.08 * random.gaussian();
      ranges.push_back(link::test::make_range(anchors_[i].id, range_m, ticks(-age_s)));
    }
    if (options_.ranges) {
      session_.node_bytes(
          tag_,
          link::test::frame_of(link::test::make_report(static_cast<std::uint32_t>(reports_), 1,
                                                       static_cast<std::uint64_t>(ticks(now_s_)), ranges)),
          now_s_);
    }
    ++reports_;
  }

  static constexpr const char* kNulls = "null,null,null,null,null,null";

  Options options_;
  std::vector<std::string> log_;
  Session session_;
  std::unique_ptr<Localizer> localizer_;
  std::vector<model::Anchor> anchors_;
  std::size_t tag_ = 0;
  double now_s_ = kBegin_s;
  double robot_ahead_s_ = 0.0;
  int odometry_ = 0;
  int sensors_ = 0;
  int reports_ = 0;
  std::vector<Moment> moments_;
};

}  // namespace groma::daemon::test
