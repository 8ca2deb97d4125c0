// What the links of a robot on a circle give gromad, byte for byte, at given times.
#pragma once

#include <fmt/format.h>

#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

#include "host/clock/time_mapper.hpp"
#include "host/daemon/config.hpp"
#include "host/model/calibration.hpp"
#include "test/host/link/node_frames.hpp"

namespace groma::daemon::test {

class CircleDrive {
 public:
  static constexpr double kRadius_m = 4.0;
  static constexpr double kOmega_radps = 0.25;
  static constexpr double kTagHeight_m = 0.5;
  static constexpr double kRobotOrigin_s = 5000.0;  // of the robot's clock
  static constexpr double kBegin_s = 1000.0;        // host time

  struct Arrival {
    double host_s = 0.0;
    bool robot = false;  // otherwise the tag's link
    std::vector<std::uint8_t> bytes;
  };
  struct Point {
    double x_m, y_m, yaw_rad;
  };

  CircleDrive() {
    for (int i = 0; i < 6; ++i) {
      const double angle = 2.0 * 3.14159265358979 * i / 6.0;
      anchors.push_back({static_cast<model::NodeId>(100 + i),
                         {9.0 * std::cos(angle), 4.0 + 9.0 * std::sin(angle), 1.0 + 0.7 * (i % 3)}});
    }
  }

  // At a time of the robot's clock.
  static Point truth(double robot_s) {
    const double angle = kOmega_radps * (robot_s - kRobotOrigin_s);
    return {kRadius_m * std::sin(angle), kRadius_m * (1.0 - std::cos(angle)),
            std::remainder(angle, 2.0 * 3.14159265358979)};
  }

  // Odometry at 100 Hz with a pose prior at the begin, and ranges at 60 a second, in the order of time.
  [[nodiscard]] std::vector<Arrival> arrivals(double duration_s) const {
    std::vector<Arrival> all;
    for (int i = 0; 0.01 * i < duration_s; ++i) {
      const double t_s = 0.01 * i;
      all.push_back({kBegin_s + t_s + 0.001, true, odometry(t_s, i == 0)});
      if (i % 10 == 3) all.push_back({kBegin_s + t_s + 0.004, false, report(t_s, i / 10)});
    }
    return all;
  }

  // With the calibration of surveyed().
  [[nodiscard]] Config config() const {
    Config config;
    config.nodes = {{"tag-1", 1'000'000}};
    config.robot_socket = "robot.sock";
    config.tags = {{1, {0.0, 0.0, kTagHeight_m}}};
    config.odometry = {0.05, 0.05, 0.02};
    config.range.sigma_m = 0.05;
    config.range.beta_m = {0.0, 0.05};
    config.pose_stream.port = 0;
    return config;
  }
  [[nodiscard]] model::Calibration surveyed() const {
    model::Calibration calibration =
        model::surveyed_calibration(anchors, config().tags, config().range, 0.02);
    calibration.verdict = model::Verdict::kUsable;
    return calibration;
  }

  std::vector<model::Anchor> anchors;

  // The bytes of one time since the begin.
  static std::vector<std::uint8_t> odometry(double t_s, bool with_prior) {
    std::string lines =
        fmt::format("{{\"class\":\"ODOMETRY\",\"t_s\":{},\"vx_mps\":{},\"vy_mps\":0,\"omega_radps\":{}}}\n",
                    kRobotOrigin_s + t_s, kRadius_m * kOmega_radps, kOmega_radps);
    if (with_prior) {
      lines +=
          fmt::format("{{\"class\":\"POSE_PRIOR\",\"t_s\":{},\"x_m\":0,\"y_m\":0,\"z_m\":0,\"yaw_rad\":0}}\n",
                      kRobotOrigin_s + t_s);
    }
    return {lines.begin(), lines.end()};
  }

  // Of a tag `ahead_m` in front of base_link, with a counter of its own.
  [[nodiscard]] std::vector<std::uint8_t> report(double t_s, int number, std::uint32_t tag_id = 1,
                                                 double ahead_m = 0.0) const {
    const auto ticks = [](double s) { return std::llround(s * clock::kDeviceTicksPerSecond); };
    std::vector<groma_Range> ranges;
    for (std::size_t i = 0; i < anchors.size(); ++i) {
      const double age_s = 0.08 - 0.002 * static_cast<double>(i);
      const Point at = truth(kRobotOrigin_s + t_s - age_s);
      const Eigen::Vector3d tag(at.x_m + ahead_m * std::cos(at.yaw_rad),
                                at.y_m + ahead_m * std::sin(at.yaw_rad), kTagHeight_m);
      const double range_m = (tag - anchors[i].position_m).norm();
      // A deterministic ripple of 3 cm instead of noise.
      const double ripple_m = 0.03 * std::sin(1.7 * number + 2.3 * static_cast<double>(i));
      ranges.push_back(link::test::make_range(anchors[i].id, range_m + ripple_m, ticks(-age_s)));
    }
    return link::test::frame_of(
        link::test::make_report(static_cast<std::uint32_t>(number), tag_id,
                                static_cast<std::uint64_t>(ticks(1000.0 * tag_id - 923.0 + t_s)), ranges));
  }
};

}  // namespace groma::daemon::test
