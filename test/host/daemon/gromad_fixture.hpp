// Fixture of tests that run gromad on a simulated site.
#pragma once

#include <fmt/format.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <functional>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/model/calibration.hpp"
#include "test/host/daemon/gromad_process.hpp"
#include "test/host/daemon/simulated_site.hpp"
#include "test/host/daemon/temporary_folder.hpp"

namespace groma::daemon {

using groma::test::TemporaryFolder;
using nlohmann::json;
using test::Gromad;
using test::kPatience;
using test::pose_stream_port;
using test::SimulatedSite;
using test::StreamClient;

inline constexpr double kSpeed = 2.0;

class GromadTest : public ::testing::Test {
 protected:
  std::string config_text(const std::string& calibration, double speed = kSpeed) const {
    return fmt::format(R"(schema: 1
nodes:
  - {{path: tag-1, baud: 1000000}}
robot_socket: robot.sock
tags:
  - {{id: 1, lever_arm_m: [0, 0, {}]}}
odometry: {{sigma_vx_mps: 0.05, sigma_vy_mps: 0.05, sigma_omega_radps: 0.02}}
range: {{sigma_m: 0.05, beta_m: [0.3, 0.3], gamma: [1.0, 0.002]}}
surface: {{type: plane, z_m: 0, normal: [0, 0, 1]}}
calibration: {}
pose_stream: {{port: 0}}
speed: {}
)",
                       SimulatedSite::kTagHeight_m, calibration, speed);
  }

  // Runs the site until `done`; false after kPatience or if the daemon has ended.
  bool run_until(SimulatedSite& site, Gromad& gromad, const std::function<bool()>& done) {
    const auto deadline = std::chrono::steady_clock::now() + kPatience;
    while (std::chrono::steady_clock::now() < deadline) {
      site.step();
      gromad.log();
      if (!client_) connect(gromad);
      if (client_) {
        for (json& object : client_->read()) {
          if (object.at("class") == "POSE") {
            const double t_s = object.at("t_s");
            ages_s_.push_back(site.site_time_s() + SimulatedSite::kRobotOrigin_s - t_s);
          }
          objects_.push_back(std::move(object));
        }
      }
      if (done()) return true;
      if (!gromad.running()) return false;
      std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
    return false;
  }

  [[nodiscard]] std::size_t poses(const std::string& state) const {
    std::size_t n = 0;
    for (const json& object : objects_) {
      if (object.at("class") == "POSE" && object.at("state") == state) ++n;
    }
    return n;
  }

  // The POSE lines that the client received, byte for byte.
  [[nodiscard]] std::string poses_received() {
    client_->read();
    return client_->pose_lines();
  }

  [[nodiscard]] double largest_error_m(std::size_t skip) const {
    double worst_m = 0.0;
    std::size_t seen = 0;
    for (const json& object : objects_) {
      if (object.at("class") != "POSE" || seen++ < skip) continue;
      const auto truth = SimulatedSite::truth(object.at("t_s"));
      worst_m = std::max(worst_m, std::hypot(object.at("x_m").get<double>() - truth.x_m,
                                             object.at("y_m").get<double>() - truth.y_m));
    }
    return worst_m;
  }

  // `renumbered`: anchors have swapped ids.
  void write_surveyed(const SimulatedSite& site, bool renumbered = false,
                      std::optional<model::ClockError> range_clock = std::nullopt) const {
    const std::vector<model::Tag> tags{{1, {0.0, 0.0, SimulatedSite::kTagHeight_m}}};
    model::RangePriors priors;
    priors.beta_m = {0.0, 0.05};
    model::Calibration calibration = model::surveyed_calibration(site.anchors, tags, priors, 0.02);
    calibration.verdict = model::Verdict::kUsable;
    calibration.range_clock = range_clock;
    // Not a rotation or mirror image of the ring, which would fit the ranges as well.
    constexpr std::array<std::size_t, 6> kExchanged{0, 2, 4, 1, 3, 5};
    for (std::size_t i = 0; renumbered && i < kExchanged.size(); ++i)
      calibration.anchors[i].position_m = site.anchors[kExchanged.at(i)].position_m;
    folder_.write("calibration.yaml", io::format_calibration(calibration));
  }

  TemporaryFolder folder_;
  std::vector<json> objects_;
  std::vector<double> ages_s_;  // of poses on arrival, by the site's clock
  std::optional<StreamClient> client_;

 private:
  void connect(Gromad& gromad) {
    if (const auto port = pose_stream_port(gromad)) client_.emplace(*port);
  }
};

}  // namespace groma::daemon
