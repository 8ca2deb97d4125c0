// The daemon in this process, on an injected clock: its links are Unix sockets, which the test fills.
#include <arpa/inet.h>
#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <sys/socket.h>

#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/daemon/daemon.hpp"
#include "host/io/descriptor.hpp"
#include "test/host/daemon/daemon_loop_fixture.hpp"

namespace groma::daemon {
namespace {

// Two runs at the same times of the injected clock give the same lines, however long they take.
TEST_F(DaemonLoop, RepeatsItselfOnAnInjectedClock) {
  std::vector<std::string> runs;
  for (int i = 0; i < 2; ++i) {
    start();
    TcpClient client(port("pose stream"));
    std::string stream;
    run(5.0, [&](const auto& /*arrival*/) { stream += client.receive(); });
    daemon_.reset();
    stream += client.receive();
    runs.push_back(stream);
  }
  EXPECT_GT(lines_of(poses_of(runs[0])), 400U);
  EXPECT_EQ(runs[0], runs[1]);
}

TEST_F(DaemonLoop, ReportsItsStatusByTheClock) {
  start();
  TcpClient client(port("pose stream"));
  const auto statuses = [&] {
    for (int i = 0; i < 10; ++i) daemon_->poll();
    const std::string text = client.receive();
    std::size_t count = 0;
    for (std::size_t at = 0; (at = text.find("\"STATUS\"", at)) != std::string::npos; ++at) ++count;
    return count;
  };
  statuses();
  EXPECT_EQ(statuses(), 0U);
  now_s_ += 0.9;
  EXPECT_EQ(statuses(), 0U);
  now_s_ += 0.11;
  EXPECT_EQ(statuses(), 1U);
  EXPECT_EQ(statuses(), 0U);
}

TEST_F(DaemonLoop, AClientThatNeverReadsDelaysNoOne) {
  start();
  const TcpClient slow(port("pose stream"), 4096);
  TcpClient good(port("pose stream"));
  std::size_t poses = 0;
  std::size_t late = 0;
  // Until the slow one is dropped.
  bool dropped = false;
  for (double until_s = 30.0; until_s <= 300.0 && !dropped; until_s += 30.0) {
    run(until_s, [&](const CircleDrive::Arrival& arrival) {
      const std::size_t now = lines_of(poses_of(good.receive()));
      poses += now;
      if (arrival.robot && arrival.host_s > CircleDrive::kBegin_s + 1.0 && now != 1) ++late;
    });
    dropped = value(metrics(), "groma_stream_clients_total", {{"event", "too_slow"}}) == 1.0;
  }
  EXPECT_TRUE(dropped);
  EXPECT_GT(poses, 2900U);
  EXPECT_EQ(late, 0U);
}

TEST_F(DaemonLoop, ServesItsCounters) {
  start();
  TcpClient client(port("pose stream"));
  std::string stream;
  run(5.0, [&](const auto& /*arrival*/) { stream += client.receive(); });
  const std::string broken = "not a line\n";
  robot_.send({broken.begin(), broken.end()});
  auto all = metrics();
  stream += client.receive();
  const Labels link{{"link", (folder_ / "tag-1").string()}};
  EXPECT_EQ(value(all, "groma_state", {{"state", "TRACKING"}}), 1.0);
  EXPECT_EQ(value(all, "groma_state", {{"state", "LOST"}}), 0.0);
  EXPECT_EQ(all.at("groma_pose_latency_seconds").samples.at("groma_pose_latency_seconds_count").at({}),
            static_cast<double>(lines_of(poses_of(stream))));
  EXPECT_EQ(value(all, "groma_robot_lines_total", {{"class", "ODOMETRY"}}), 500.0);
  EXPECT_EQ(value(all, "groma_robot_lines_total", {{"class", "POSE_PRIOR"}}), 1.0);
  EXPECT_EQ(value(all, "groma_robot_lines_dropped_total", {{"reason", "torn"}}), 1.0);
  EXPECT_EQ(value(all, "groma_node_reports_total", link), 50.0);
  EXPECT_EQ(value(all, "groma_node_ranges_total", link), 300.0);
  EXPECT_EQ(value(all, "groma_node_frames_total", link), 50.0);
  EXPECT_GT(value(all, "groma_filter_ranges_total", {{"outcome", "used"}}), 200.0);
  EXPECT_EQ(value(all, "groma_link_open", link), 1.0);
  EXPECT_EQ(value(all, "groma_link_lost_total", link), 0.0);
  EXPECT_EQ(value(all, "groma_stream_clients"), 1.0);
  EXPECT_EQ(value(all, "groma_calibrations_adopted_total"), 1.0);

  tag_.hang_up();
  daemon_->poll();
  all = metrics();
  EXPECT_EQ(value(all, "groma_link_lost_total", link), 1.0);
  tag_.accept();
  all = metrics();
  EXPECT_EQ(value(all, "groma_link_opened_total", link), 2.0);
  EXPECT_EQ(value(all, "groma_link_open", link), 1.0);

  EXPECT_THAT(get("/"), StartsWith("HTTP/1.1 200 "));  // the page, or that there is none
  EXPECT_THAT(get("/other"), StartsWith("HTTP/1.1 404 "));
  EXPECT_THAT(get("/live"), StartsWith("HTTP/1.1 426 "));
}

// A port that is free now.
std::uint16_t free_port(int type) {
  const io::Descriptor fd(::socket(AF_INET, type | SOCK_CLOEXEC, 0));
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  socklen_t size = sizeof(address);
  if (::bind(fd.get(), reinterpret_cast<const sockaddr*>(&address), size) != 0 ||
      ::getsockname(fd.get(), reinterpret_cast<sockaddr*>(&address), &size) != 0) {
    throw std::runtime_error("no free port");
  }
  return ntohs(address.sin_port);
}

class Datagrams {
 public:
  explicit Datagrams(std::uint16_t port) : fd_(::socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0)) {
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_port = htons(port);
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (::connect(fd_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0)
      throw std::runtime_error("connect");
  }
  void send(const std::string& text) const {
    ASSERT_EQ(::send(fd_.get(), text.data(), text.size(), MSG_NOSIGNAL), static_cast<ssize_t>(text.size()));
  }

 private:
  io::Descriptor fd_;
};

// Odometry comes from the robot's socket in two parts, and between them other lines by UDP and TCP.
TEST_F(DaemonLoop, ReadsSeveralLinksOfTheRobotAtOnce) {
  const std::uint16_t imu_port = free_port(SOCK_DGRAM);
  const std::uint16_t gnss_port = free_port(SOCK_STREAM);
  config_.robot_listen = {fmt::format("udp://127.0.0.1:{}", imu_port),
                          fmt::format("tcp://127.0.0.1:{}", gnss_port)};
  start();
  const Datagrams imu(imu_port);
  const TcpClient gnss(gnss_port);
  TcpClient client(port("pose stream"));
  std::string stream;
  constexpr int kSamples = 300;
  for (int i = 0; i < kSamples; ++i) {
    const double t_s = 0.01 * i;
    const auto at = CircleDrive::truth(CircleDrive::kRobotOrigin_s + t_s);
    now_s_ = CircleDrive::kBegin_s + t_s + 0.001;
    const std::vector<std::uint8_t> line = CircleDrive::odometry(t_s, i == 0);
    const auto middle = line.begin() + static_cast<std::ptrdiff_t>(line.size() / 2);
    robot_.send({line.begin(), middle});
    daemon_->poll();
    imu.send(fmt::format("{{\"class\":\"IMU\",\"t_s\":{},\"omega_radps\":{}}}\n",
                         CircleDrive::kRobotOrigin_s + t_s, CircleDrive::kOmega_radps));
    EXPECT_TRUE(gnss.send(
        fmt::format("{{\"class\":\"GNSS\",\"t_s\":{},\"x_m\":{},\"y_m\":{},\"covariance\":[1,0,0,1]}}\n",
                    CircleDrive::kRobotOrigin_s + t_s, at.x_m, at.y_m)));
    daemon_->poll();
    robot_.send({middle, line.end()});
    daemon_->poll();
    stream += client.receive();
  }
  const auto all = metrics();
  EXPECT_EQ(value(all, "groma_robot_lines_total", {{"class", "ODOMETRY"}}), kSamples);
  EXPECT_EQ(value(all, "groma_robot_lines_total", {{"class", "sensor"}}), 2.0 * kSamples);
  for (const std::string reason : {"torn", "unknown_class", "bad_value"})
    EXPECT_EQ(value(all, "groma_robot_lines_dropped_total", {{"reason", reason}}), 0.0) << reason;
  EXPECT_GT(lines_of(poses_of(stream)), kSamples - 50U);
  const std::size_t status = stream.rfind(R"({"class":"STATUS")");
  ASSERT_NE(status, std::string::npos);
  const auto object = nlohmann::json::parse(stream.substr(status, stream.find('\n', status) - status));
  ASSERT_EQ(object.at("robots").size(), 3U);
  for (const auto& robot : object.at("robots")) EXPECT_EQ(robot.at("open"), true) << robot;
  EXPECT_EQ(object.at("robot").at("link"), (folder_ / "robot.sock").string());
}

TEST_F(DaemonLoop, HasNoWebServerUnlessConfigured) {
  config_.web.reset();
  start();
  EXPECT_EQ(log_.find("web server"), std::string::npos);
}

}  // namespace
}  // namespace groma::daemon
