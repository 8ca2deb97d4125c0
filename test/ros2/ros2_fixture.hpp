// gromad on a simulated site with ROS 2, and a peer by Fast DDS, in a network of the test's own.
#pragma once

#include <fmt/format.h>
#include <gtest/gtest.h>

#include <chrono>
#include <cmath>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/dds/node.hpp"
#include "host/ros2/cdr_writer.hpp"
#include "host/ros2/message.hpp"
#include "host/ros2/messages.hpp"
#include "host/ros2/schemas.hpp"
#include "test/host/daemon/gromad_fixture.hpp"
#include "test/ros2/network_namespace.hpp"
#include "test/ros2/peer_process.hpp"

namespace groma::daemon {

using groma::test::Peer;
using groma::test::PeerMessage;

class Ros2Test : public GromadTest {
 public:
  static void SetUpTestSuite() { has_network_ = has_network_ || groma::test::enter_network_namespace(); }

 protected:
  void SetUp() override {
    if (!has_network_) GTEST_SKIP() << "a network namespace cannot be made here";
  }

  static double unix_time_s() {
    return std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count();
  }
  // The robot's clock counts from 1970.
  static void set_clock(SimulatedSite& site) {
    site.robot_clock_s = unix_time_s() - SimulatedSite::kRobotOrigin_s;
  }

  [[nodiscard]] std::string ros2_config(const std::string& settings, bool has_socket = true) const {
    std::string text = config_text("{file: calibration.yaml}") + "ros2: " + settings + "\n";
    if (!has_socket) text.erase(text.find("robot_socket"), std::string("robot_socket: robot.sock\n").size());
    return folder_.write("gromad.yaml", text).string();
  }

  static Peer::Endpoint reads(const std::string& topic, const std::string& type,
                              const char* reliability = "reliable", const char* durability = "volatile",
                              const char* depth = "100") {
    return {"read", "rt" + topic, dds::dds_type_name(type), reliability, durability, depth};
  }
  static Peer::Endpoint writes(const std::string& topic, const std::string& type,
                               const char* reliability = "reliable") {
    return {"write", "rt" + topic, dds::dds_type_name(type), reliability, "volatile", "10"};
  }
  // As nodes of ROS 2 read what gromad publishes.
  static std::vector<Peer::Endpoint> all_readers() {
    return {reads("/groma/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", "best-effort"),
            reads("/groma/odometry", "nav_msgs/msg/Odometry"),
            reads("/groma/anchors", "visualization_msgs/msg/MarkerArray", "reliable", "latched", "1"),
            reads("/groma/links", "visualization_msgs/msg/MarkerArray"),
            reads("/tf", "tf2_msgs/msg/TFMessage"),
            reads("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")};
  }

  // Runs site, gromad and peer until `done`.
  bool run_with(Peer& peer, SimulatedSite& site, Gromad& gromad, const std::function<bool()>& done) {
    return run_until(site, gromad, [&] {
      peer.read();
      return done();
    });
  }

  // ---- messages

  ros2::MessageValue decode(const std::string& type, const std::string& cdr) {
    const ros2::MessageDefinition& definition =
        definitions_.try_emplace(type, type, ros2::schema_of(type)).first->second;
    auto value = definition.read(cdr);
    if (!value) throw std::runtime_error("no " + type);
    return *std::move(value);
  }
  static double number(const ros2::MessageValue& message, const std::string& path) {
    const ros2::MessageValue& value = *ros2::values_at(message, *ros2::FieldPath::parse(path)).at(0);
    if (const auto* whole = std::get_if<std::int64_t>(&value.content)) return static_cast<double>(*whole);
    return std::get<double>(value.content);
  }
  static std::string text(const ros2::MessageValue& message, const std::string& path) {
    return std::get<std::string>(ros2::values_at(message, *ros2::FieldPath::parse(path)).at(0)->content);
  }
  static double timestamp_s(const ros2::MessageValue& message) {
    return number(message, "header.stamp.sec") + 1e-9 * number(message, "header.stamp.nanosec");
  }

  struct RobotMotion {
    double t_s = 0.0;
    double vx_mps = 0.0;
    double omega_radps = 0.0;
    double x_m = 0.0;  // in odom
    double y_m = 0.0;
    double yaw_rad = 0.0;
  };
  static std::string odometry_message(const RobotMotion& of, const char* frame = "odom",
                                      const char* child = "base_link") {
    ros2::CdrWriter out;
    ros2::put_header(out, of.t_s, frame);
    out.put(child);
    ros2::put_pose(
        out, {{of.x_m, of.y_m, 0.0}, {0.0, 0.0, std::sin(0.5 * of.yaw_rad), std::cos(0.5 * of.yaw_rad)}});
    ros2::put_covariance(out, 0.01 * ros2::Covariance::Identity());
    ros2::put_twist(out, {of.vx_mps, 0.0, of.omega_radps}, 0.01 * Eigen::Matrix3d::Identity());
    return out.message();
  }

  static std::string imu_message(double t_s, double omega_radps) {
    ros2::CdrWriter out;
    ros2::put_header(out, t_s, "imu_link");
    ros2::put_quaternion(out, {0.0, 0.0, 0.0, 1.0});
    for (int i = 0; i < 9; ++i) out.put(i == 0 ? -1.0 : 0.0);
    ros2::put_vector(out, {0.0, 0.0, omega_radps});
    for (int i = 0; i < 9; ++i) out.put(i % 4 == 0 ? 1e-4 : 0.0);
    ros2::put_vector(out, {0.0, 0.0, 9.81});
    for (int i = 0; i < 9; ++i) out.put(i % 4 == 0 ? 0.01 : 0.0);
    return out.message();
  }

  // The site's odometry goes to /odom of the peer instead of the socket. wheels: scale of the yaw rate that
  // it claims; if it is not 1, the peer's /imu has the true one.
  static void send_by(Peer& peer, SimulatedSite& site, double wheels = 1.0) {
    site.pose_priors = false;
    site.on_lines = [&peer, &site, wheels](double t_s, const std::string& lines) {
      const json sample = json::parse(lines);
      const double omega_radps = sample.at("omega_radps");
      if (wheels != 1.0) peer.write("rt/imu", imu_message(t_s, omega_radps));
      // In odom the circle is turned and moved against the map.
      const auto truth = SimulatedSite::truth(t_s - site.robot_clock_s);
      peer.write("rt/odom", odometry_message({t_s, sample.at("vx_mps"), wheels * omega_radps, truth.y_m - 2.0,
                                              -truth.x_m, truth.yaw_rad - 0.5 * 3.14159265358979}));
      return std::string();
    };
  }

  [[nodiscard]] double largest_error_m(const SimulatedSite& site, std::size_t skip) const {
    double worst_m = 0.0;
    std::size_t seen = 0;
    for (const json& object : objects_) {
      if (object.at("class") != "POSE" || seen++ < skip) continue;
      const auto truth = SimulatedSite::truth(object.at("t_s").get<double>() - site.robot_clock_s);
      worst_m = std::max(worst_m, std::hypot(object.at("x_m").get<double>() - truth.x_m,
                                             object.at("y_m").get<double>() - truth.y_m));
    }
    return worst_m;
  }

 private:
  static inline bool has_network_ = false;
  std::map<std::string, ros2::MessageDefinition> definitions_;
};

}  // namespace groma::daemon
