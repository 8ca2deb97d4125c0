// A site for end-to-end tests of the daemon: a robot drives a circle. Its tag is on a real pseudo-terminal,
// its odometry and pose priors on a real Unix socket.
#pragma once

#include <fcntl.h>
#include <fmt/format.h>
#include <pb_decode.h>
#include <poll.h>
#include <pty.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <termios.h>
#include <unistd.h>

#include <chrono>
#include <cmath>
#include <filesystem>
#include <functional>
#include <memory>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "host/clock/time_mapper.hpp"
#include "host/io/descriptor.hpp"
#include "host/model/types.hpp"
#include "proto/frame_codec.hpp"
#include "test/host/link/node_frames.hpp"

namespace groma::daemon::test {

class SimulatedSite {
 public:
  static constexpr double kRadius_m = 4.0;
  static constexpr double kOmega = 0.25;
  static constexpr double kOdometryPeriod_s = 0.02;
  static constexpr double kReportPeriod_s = 0.1;
  static constexpr double kRobotOrigin_s = 5000.0;  // of the robot's clock
  static constexpr double kDeviceOrigin_s = 77.0;   // of the tag's counter
  static constexpr double kDeviceSkew = 15e-6;
  static constexpr double kTagHeight_m = 0.5;

  // speed: rate of the site's clocks over the computer's. folder: for tag-1 and robot.sock.
  SimulatedSite(std::filesystem::path folder, double speed)
      : folder_(std::move(folder)), speed_(speed), start_(std::chrono::steady_clock::now()) {
    for (int i = 0; i < 6; ++i) {
      const double angle = 2.0 * 3.14159265358979 * i / 6.0;
      anchors.push_back({static_cast<model::NodeId>(100 + i),
                         {9.0 * std::cos(angle), 4.0 + 9.0 * std::sin(angle), 1.0 + 0.7 * (i % 3)}});
    }
    plug_in();
    listener_ = io::Descriptor(::socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    (folder_ / "robot.sock").string().copy(address.sun_path, sizeof(address.sun_path) - 1);
    if (::bind(listener_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0 ||
        ::listen(listener_.get(), 4) != 0) {
      throw std::runtime_error("robot.sock");
    }
  }

  // tag-1 becomes a new pseudo-terminal, like a USB port that is plugged in again.
  void plug_in() {
    int master = -1;
    int slave = -1;
    char name[128];
    if (::openpty(&master, &slave, nullptr, nullptr, nullptr) != 0 ||
        ::ttyname_r(slave, name, sizeof(name)) != 0) {
      throw std::runtime_error("openpty");
    }
    termios raw{};
    ::tcgetattr(slave, &raw);
    ::cfmakeraw(&raw);
    ::cfsetspeed(&raw, B1000000);
    ::tcsetattr(slave, TCSANOW, &raw);
    ::close(slave);
    ::fcntl(master, F_SETFL, O_NONBLOCK);
    // The daemon must not inherit the other end of its port.
    ::fcntl(master, F_SETFD, FD_CLOEXEC);
    master_ = io::Descriptor(master);
    std::filesystem::remove(folder_ / "tag-1");
    std::filesystem::create_symlink(name, folder_ / "tag-1");
  }
  void unplug() {
    master_.close();
    std::filesystem::remove(folder_ / "tag-1");
  }

  // Sends everything due by now.
  void step() {
    const int peer = ::accept4(listener_.get(), nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC);
    if (peer >= 0) robot_ = io::Descriptor(peer);
    const double now_s = site_time_s();
    for (; next_odometry_s_ <= now_s; next_odometry_s_ += odometry_period_s, ++odometry_sent_)
      send_robot(next_odometry_s_);
    for (; kReportPeriod_s * reports_sent_ <= now_s; ++reports_sent_)
      send_report(kReportPeriod_s * reports_sent_);
    drain();
  }

  void send_to_robot_socket(const std::string& text) const {
    if (robot_.valid()) static_cast<void>(!::send(robot_.get(), text.data(), text.size(), MSG_NOSIGNAL));
  }
  // As on a wire: without a reader the bytes are lost; one with another bit rate than 1 Mbit/s gets other
  // bytes.
  void send_to_tag_link(std::vector<std::uint8_t> bytes) const {
    if (!master_.valid() || tag_silent) return;
    pollfd line_end{master_.get(), POLLOUT, 0};
    if (::poll(&line_end, 1, 0) >= 0 && (line_end.revents & POLLHUP) != 0) return;
    termios line{};
    if (::tcgetattr(master_.get(), &line) == 0 && ::cfgetospeed(&line) != B1000000) {
      for (std::uint8_t& byte : bytes) byte = static_cast<std::uint8_t>(byte * 37U + 11U);
    }
    static_cast<void>(!::write(master_.get(), bytes.data(), bytes.size()));
  }

  struct Pose {
    double x_m, y_m, yaw_rad;
  };
  // At a time of the robot's clock.
  [[nodiscard]] static Pose truth(double robot_s) {
    const double angle = kOmega * (robot_s - kRobotOrigin_s);
    return {kRadius_m * std::sin(angle), kRadius_m * (1.0 - std::cos(angle)),
            std::remainder(angle, 2.0 * 3.14159265358979)};
  }
  [[nodiscard]] double site_time_s() const {
    return speed_ * std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
  }
  // Bytes that the daemon sent to the tag.
  [[nodiscard]] const std::vector<std::uint8_t>& received() const { return received_; }

  std::vector<model::Anchor> anchors;
  double range_bias_m = 0.0;   // of all pairs
  double ranges_late_s = 0.0;  // against the robot's motion
  bool pose_priors = true;
  double odometry_period_s = kOdometryPeriod_s;
  // Change the lines for a time of the robot's clock, and the frames of the tag, before they are sent.
  std::function<std::string(double t_s, std::string lines)> on_lines;
  std::function<std::vector<std::uint8_t>(std::vector<std::uint8_t> frame)> on_frame;
  std::uint32_t tag_id = 1;
  bool tag_silent = false;
  bool odometry = true;        // is sent
  bool odometry_moves = true;  // else it says that the robot is stationary
  double robot_clock_s = 0.0;  // added to the times that the robot sends

 private:
  void send_robot(double site_s) const {
    const double t_s = kRobotOrigin_s + site_s + robot_clock_s;
    std::string lines;
    const double omega = odometry_moves ? kOmega : 0.0;
    if (odometry) {
      lines = fmt::format(R"({{"class":"ODOMETRY","t_s":{},"vx_mps":{},"vy_mps":0,"omega_radps":{}}})"
                          "\n",
                          t_s, kRadius_m * omega, omega);
    }
    if (pose_priors && odometry_sent_ % 5 == 0) {
      const Pose pose = truth(t_s - robot_clock_s);
      lines += fmt::format(R"({{"class":"POSE_PRIOR","t_s":{},"x_m":{},"y_m":{},"z_m":0,"yaw_rad":{}}})"
                           "\n",
                           t_s, pose.x_m, pose.y_m, pose.yaw_rad);
    }
    send_to_robot_socket(on_lines ? on_lines(t_s, std::move(lines)) : lines);
  }

  void send_report(double site_s) {
    const auto dtu = [](double s) {
      return std::llround(s * (1.0 + kDeviceSkew) * clock::kDeviceTicksPerSecond);
    };
    std::vector<groma_Range> ranges;
    for (std::size_t i = 0; i < anchors.size(); ++i) {
      const double age_s = 0.08 - 0.002 * static_cast<double>(i);
      const Pose pose = truth(kRobotOrigin_s + site_s - age_s - ranges_late_s);
      const double range_m =
          (Eigen::Vector3d(pose.x_m, pose.y_m, kTagHeight_m) - anchors[i].position_m).norm();
      // A deterministic ripple of 3 cm instead of noise.
      const double ripple_m = 0.03 * std::sin(1.7 * reports_sent_ + 2.3 * static_cast<double>(i));
      ranges.push_back(link::test::make_range(anchors[i].id, range_m + range_bias_m + ripple_m, dtu(-age_s)));
    }
    std::vector<std::uint8_t> frame = link::test::frame_of(
        link::test::make_report(static_cast<std::uint32_t>(reports_sent_), tag_id,
                                static_cast<std::uint64_t>(dtu(kDeviceOrigin_s + site_s)), ranges));
    send_to_tag_link(on_frame ? on_frame(std::move(frame)) : frame);
  }

  void drain() {
    std::uint8_t buffer[512];
    ssize_t n = 0;
    while (master_.valid() && (n = ::read(master_.get(), buffer, sizeof(buffer))) > 0) {
      received_.insert(received_.end(), buffer, buffer + n);
      for (ssize_t i = 0; i < n; ++i) {
        if (commands_.push(buffer[i])) answer(commands_.payload());
      }
    }
  }

  // Answers a request for its time or its hello as a node does.
  void answer(std::span<const std::uint8_t> payload) {
    groma_HostToNode command = groma_HostToNode_init_zero;
    pb_istream_t stream = pb_istream_from_buffer(payload.data(), payload.size());
    if (!pb_decode(&stream, groma_HostToNode_fields, &command)) return;
    if (command.which_body == groma_HostToNode_get_hello_tag) {
      return send_to_tag_link(link::test::frame_of(link::test::make_hello(tag_id, "0.0.0")));
    }
    if (command.which_body != groma_HostToNode_time_request_tag) return;
    const auto now = static_cast<std::uint64_t>(
        std::llround((kDeviceOrigin_s + site_time_s()) * (1.0 + kDeviceSkew) * clock::kDeviceTicksPerSecond));
    groma_NodeToHost reply = groma_NodeToHost_init_zero;
    reply.which_body = groma_NodeToHost_time_reply_tag;
    reply.body.time_reply = {command.body.time_request.host_time_ns, now, now};
    send_to_tag_link(link::test::frame_of(reply));
  }

  wire::FrameDecoder commands_;
  std::filesystem::path folder_;
  double speed_;
  std::chrono::steady_clock::time_point start_;
  io::Descriptor master_;
  io::Descriptor listener_;
  io::Descriptor robot_;
  double next_odometry_s_ = 0.0;
  int odometry_sent_ = 0;
  int reports_sent_ = 0;
  std::vector<std::uint8_t> received_;
};

}  // namespace groma::daemon::test
