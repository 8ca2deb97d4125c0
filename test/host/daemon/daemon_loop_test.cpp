// The daemon in this process, on an injected clock: its links are Unix sockets, which the test fills.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdint>
#include <string>
#include <vector>

#include "host/daemon/daemon.hpp"
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
