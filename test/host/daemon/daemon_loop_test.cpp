// The daemon in this process, on an injected clock: its links are Unix sockets, which the test fills.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/socket.h>
#include <sys/un.h>

#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <map>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "host/daemon/daemon.hpp"
#include "test/host/daemon/circle_drive.hpp"
#include "test/host/daemon/prometheus_parser.hpp"
#include "test/host/daemon/tcp_client.hpp"
#include "test/host/daemon/temporary_folder.hpp"

namespace groma::daemon {
namespace {

using groma::test::TemporaryFolder;
using test::CircleDrive;
using test::Labels;
using test::TcpClient;
using ::testing::HasSubstr;
using ::testing::StartsWith;

// The other side of a link.
class Peer {
 public:
  explicit Peer(const std::filesystem::path& path)
      : listener_(::socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0)) {
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    path.string().copy(address.sun_path, sizeof(address.sun_path) - 1);
    if (::bind(listener_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0 ||
        ::listen(listener_.get(), 4) != 0) {
      throw std::runtime_error(path.string());
    }
  }
  void accept() { peer_ = io::Descriptor(::accept4(listener_.get(), nullptr, nullptr, SOCK_CLOEXEC)); }
  void send(const std::vector<std::uint8_t>& bytes) const {
    ASSERT_EQ(::send(peer_.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL | MSG_DONTWAIT),
              static_cast<ssize_t>(bytes.size()));
  }
  void hang_up() { peer_.close(); }

 private:
  io::Descriptor listener_;
  io::Descriptor peer_;
};

class DaemonLoop : public ::testing::Test {
 protected:
  DaemonLoop() {
    config_.nodes[0].path = folder_ / "tag-1";
    config_.robot_socket = folder_ / "robot.sock";
    config_.web = Endpoint{.address = "127.0.0.1", .port = 0};
  }

  void start() {
    log_.clear();
    now_s_ = CircleDrive::kBegin_s;
    daemon_ = std::make_unique<Daemon>(
        config_, drive_.surveyed(), [this](std::string_view text) { log_ += std::string(text) + "\n"; },
        [this] { return now_s_; });
    const link::LinkError error = daemon_->open();
    if (error.fault != link::LinkFault::kNone) throw std::runtime_error(error.message);
    tag_.accept();
    robot_.accept();
    daemon_->poll();
  }
  // Gives the daemon the part of the drive up to that time; after each arrival calls `then`.
  template <typename Then>
  void run(double duration_s, Then then) {
    for (const CircleDrive::Arrival& arrival : drive_.arrivals(duration_s)) {
      if (arrival.host_s <= now_s_) continue;
      now_s_ = arrival.host_s;
      (arrival.robot ? robot_ : tag_).send(arrival.bytes);
      daemon_->poll();
      then(arrival);
    }
  }
  // The port that the log names.
  [[nodiscard]] std::uint16_t port(const std::string& of) const {
    const std::string key = of + " on 127.0.0.1 port ";
    return static_cast<std::uint16_t>(std::stoi(log_.substr(log_.find(key) + key.size())));
  }
  std::string get(const std::string& path) {
    TcpClient client(port("web server"));
    EXPECT_TRUE(client.send("GET " + path + " HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"));
    std::string text;
    for (int i = 0; i < 1000 && !client.ended(); ++i) {
      daemon_->poll();
      text += client.receive();
    }
    return text;
  }
  std::map<std::string, test::MetricFamily> metrics() {
    now_s_ += 0.2;  // /metrics may be 0.1 s old
    const std::string answer = get("/metrics");
    EXPECT_THAT(answer, StartsWith("HTTP/1.1 200 "));
    EXPECT_THAT(answer, HasSubstr("\r\nContent-Type: text/plain; version=0.0.4; charset=utf-8\r\n"));
    return test::PrometheusParser::parse(answer.substr(answer.find("\r\n\r\n") + 4));
  }
  static double value(const std::map<std::string, test::MetricFamily>& of, const std::string& name,
                      const Labels& labels = {}) {
    return of.at(name).samples.at(name).at(labels);
  }

  static std::string poses_of(const std::string& stream) {
    std::string poses;
    std::istringstream lines(stream);
    for (std::string line; std::getline(lines, line);) {
      if (line.starts_with("{\"class\":\"POSE\"")) poses += line + "\n";
    }
    return poses;
  }
  static std::size_t lines_of(const std::string& text) {
    return static_cast<std::size_t>(std::count(text.begin(), text.end(), '\n'));
  }

  TemporaryFolder folder_;
  CircleDrive drive_;
  Config config_ = drive_.config();
  Peer tag_{folder_ / "tag-1"};
  Peer robot_{folder_ / "robot.sock"};
  double now_s_ = 0.0;
  std::string log_;
  std::unique_ptr<Daemon> daemon_;
};

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

  EXPECT_THAT(get("/"), StartsWith("HTTP/1.1 404 "));
  EXPECT_THAT(get("/live"), StartsWith("HTTP/1.1 404 "));
}

TEST_F(DaemonLoop, HasNoWebServerUnlessConfigured) {
  config_.web.reset();
  start();
  EXPECT_EQ(log_.find("web server"), std::string::npos);
}

}  // namespace
}  // namespace groma::daemon
