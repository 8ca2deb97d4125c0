// The daemon on a CAN bus: the recorded frames of three tags (record_can_site) arrive at their recorded times
// over real sockets.
#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <chrono>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <optional>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/io/exit_code.hpp"
#include "host/link/byte_link.hpp"
#include "host/link/can_log.hpp"
#include "host/link/report_decoder.hpp"
#include "host/simulation/site_server.hpp"
#include "test/host/daemon/gromad_process.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"
#include "test/support/virtual_can.hpp"

namespace groma::daemon {
namespace {

using groma::test::CanParticipant;
using groma::test::read_text;
using groma::test::ScratchFolder;
using groma::test::VirtualCan;
using nlohmann::json;
using test::Gromad;
using test::StreamClient;
using ::testing::HasSubstr;

const std::filesystem::path kRecording = GROMA_CAN_RECORDING;
constexpr unsigned kTags[] = {1, 2, 3};

link::CanLog bus_log(const std::string& name) {
  link::CanLog log = link::read_candump_log(kRecording / name);
  if (log.frames.empty()) throw std::runtime_error("no recording: " + log.error.message);
  return log;
}

// The robot's lines, sorted by time.
std::multimap<double, std::string> robot_lines() {
  std::multimap<double, std::string> lines;
  std::istringstream all(read_text(kRecording / "robot.jsonl"));
  for (std::string line; std::getline(all, line);)
    lines.emplace(json::parse(line).at("t_s").get<double>(), line + "\n");
  return lines;
}

struct Position {
  double x_m, y_m;
};
std::map<double, Position> truth() {
  std::map<double, Position> rows;
  std::istringstream all(read_text(kRecording / "truth.csv"));
  std::string line;
  std::getline(all, line);
  while (std::getline(all, line)) {
    std::istringstream fields(line);
    double t_s = 0.0;
    char comma = ',';
    Position at{};
    if (fields >> t_s >> comma >> at.x_m >> comma >> at.y_m) rows[t_s] = at;
  }
  return rows;
}

// The counters that the daemon should reach with the recording.
link::ReportCounters recorded(const std::string& name) {
  class Ignored : public link::NodeSink {
    void on_range(const model::RangeSample& /*range*/) override {}
  } sink;
  link::ReportCounters all;
  for (const unsigned tag : kTags) {
    const std::string path = fmt::format("can-log:{}/{}", (kRecording / name).string(), tag);
    const link::OpenedLink opened = link::open_link(path, 0);
    if (!opened.link) throw std::runtime_error(opened.error.message);
    link::ReportDecoder decoder(0);
    std::uint8_t buffer[4096];
    for (link::ReadResult result; !(result = opened.link->read(buffer)).gone;) {
      decoder.take(std::span(buffer).first(result.bytes), 0.0, sink);
    }
    all.ranges += decoder.counters().ranges;
    all.reports += decoder.counters().reports;
    all.ranges_not_ok += decoder.counters().ranges_not_ok;
    all.frames_lost += decoder.counters().frames_lost;
  }
  return all;
}

class GromadOnCan : public ::testing::Test {
 protected:
  void SetUp() override {
    if (!std::filesystem::exists(kRecording / "fd.log")) GTEST_SKIP() << "no recording by record_can_site";
    // Loads the executable into the page cache: a late page from the virtual machine's file system would
    // delay it.
    static_cast<void>(read_text(GROMAD_PATH));
  }

  // robot: where the odometry comes from.
  std::string config(const std::string& scheme,
                     const std::string& robot = "robot_socket: robot.sock\n") const {
    std::string text = "schema: 1\nnodes:\n";
    for (const unsigned tag : kTags)
      text += fmt::format("  - {{path: {}:{}/{}}}\n", scheme, bus_.name(), tag);
    // A long lag: on a busy machine the virtual machine is slow, and this test is not about delay.
    text += robot + "pose_stream: {port: 0}\nreorder_lag_s: 0.5\n";
    folder_.write("gromad.yaml", text + read_text(kRecording / "site.yaml"));
    return (folder_ / "gromad.yaml").string();
  }

  void listen(Gromad& gromad) {
    if (!client_) {
      if (const auto port = pose_stream_port(gromad)) client_.emplace(*port);
    }
    if (!client_) return;
    for (json& object : client_->read()) {
      if (object.at("class") == "POSE") poses_.push_back(object);
      if (object.at("class") == "STATUS") status_ = object;
    }
  }

  bool listen_until(Gromad& gromad, const std::function<bool()>& done) {
    const auto deadline = std::chrono::steady_clock::now() + std::chrono::seconds(10);
    while (!done()) {
      if (std::chrono::steady_clock::now() > deadline || !gromad.running()) return false;
      listen(gromad);
      robot_.give({});
      std::this_thread::sleep_for(std::chrono::milliseconds(5));
    }
    return true;
  }

  // Plays all recorded frames and lines, each at its time.
  void play(const link::CanLog& log, Gromad& gromad) {
    const CanParticipant tags(bus_.name());
    const auto lines = robot_lines();
    auto line = lines.begin();
    auto frame = log.frames.begin();
    const auto start = std::chrono::steady_clock::now();
    while (line != lines.end() || frame != log.frames.end()) {
      const bool robots_turn =
          frame == log.frames.end() || (line != lines.end() && line->first <= frame->t_s);
      const double t_s = robots_turn ? line->first : frame->t_s;
      const auto due = start + std::chrono::duration_cast<std::chrono::steady_clock::duration>(
                                   std::chrono::duration<double>(t_s));
      if (due > std::chrono::steady_clock::now()) {
        listen(gromad);
        std::this_thread::sleep_until(due);
      }
      if (robots_turn) {
        give_line((line++)->second, tags);
      } else {
        tags.send((frame++)->frame);
      }
    }
  }

  // By the socket, or odometry by a frame of kDbc.
  void give_line(const std::string& line, const CanParticipant& bus) {
    if (!odometry_over_can_) return robot_.give(line);
    const json object = json::parse(line);
    if (object.at("class") != "ODOMETRY") return;
    const auto raw = [&](const char* key, double step) {
      return static_cast<std::int32_t>(std::lround(object.at(key).get<double>() / step));
    };
    const auto vx = static_cast<std::int16_t>(raw("vx_mps", 5e-4));
    const auto vy = static_cast<std::int16_t>(raw("vy_mps", 5e-4));
    const std::int32_t omega = raw("omega_radps", 1e-6);
    can_frame frame{};
    frame.can_id = 0x101;
    frame.can_dlc = 8;
    std::memcpy(frame.data, &vx, sizeof(vx));
    std::memcpy(frame.data + 2, &vy, sizeof(vy));
    std::memcpy(frame.data + 4, &omega, sizeof(omega));
    bus.send_raw(frame);
    ++odometry_sent_;
    // Beside it by the socket, with this computer's time, once gromad knows the time of the odometry.
    constexpr std::uint64_t kKnown = 20;
    if (odometry_sent_ < kKnown) return;
    const std::chrono::duration<double> now = std::chrono::system_clock::now().time_since_epoch();
    robot_.give(
        fmt::format("{{\"class\":\"IMU\",\"t_s\":{},\"omega_radps\":{}}}\n", now.count(), 1e-6 * omega));
  }

  void replay(const std::string& scheme, const std::string& name) {
    const link::CanLog log = bus_log(name);
    const link::ReportCounters expected = recorded(name);
    ASSERT_GT(expected.ranges, 5000U);
    Gromad gromad({"--config", config(scheme)});
    ASSERT_TRUE(listen_until(gromad, [&] { return client_ && robot_.clients() == 1; })) << gromad.log();
    play(log, gromad);
    // Each range of the recording is delivered or counted as dropped.
    const std::uint64_t all = expected.ranges + expected.ranges_not_ok;
    const auto accounted_for = [&] { return status_.value("ranges", 0U) + status_.value("dropped", 0U); };
    EXPECT_TRUE(listen_until(gromad, [&] { return accounted_for() >= all; })) << status_ << "\n"
                                                                              << gromad.log();
    EXPECT_EQ(accounted_for(), all);
    EXPECT_EQ(status_.value("frames_lost", 0U), expected.frames_lost);
    dropped_late_ = status_.value("dropped", 0U) - expected.ranges_not_ok;
    frames_lost_ = expected.frames_lost;
    ASSERT_GT(poses_.size(), 200U);
    EXPECT_EQ(poses_.back().at("state"), "TRACKING");
    const auto where = truth();
    double worst_m = 0.0;
    for (const json& pose : poses_) {
      const auto at = where.lower_bound(pose.at("t_s").get<double>() - 1e-6);
      if (at == where.end()) continue;
      worst_m = std::max(worst_m, std::hypot(pose.at("x_m").get<double>() - at->second.x_m,
                                             pose.at("y_m").get<double>() - at->second.y_m));
    }
    EXPECT_LT(worst_m, 0.3);
    gromad.terminate();
    EXPECT_EQ(gromad.exit_code(), io::kGood);
    RecordProperty("ranges", static_cast<int>(expected.ranges));
    fmt::print("{} reports, {} ranges, worst error {:.3f} m\n", expected.reports, expected.ranges, worst_m);
  }

  ScratchFolder folder_;
  VirtualCan bus_{"bus0"};
  simulation::LineServer robot_{folder_ / "robot.sock"};
  std::optional<StreamClient> client_;
  std::vector<json> poses_;
  json status_ = json::object();
  std::uint64_t frames_lost_ = 0;
  std::uint64_t dropped_late_ = 0;
  bool odometry_over_can_ = false;
  std::uint64_t odometry_sent_ = 0;
};

TEST_F(GromadOnCan, LosesNoRangeOfThreeTagsInClassicFrames) {
  replay("can", "classic.log");
  EXPECT_EQ(frames_lost_, 0U);
  EXPECT_EQ(dropped_late_, 0U);
}

TEST_F(GromadOnCan, LosesNoRangeOfThreeTagsInFdFrames) {
  replay("canfd", "fd.log");
  EXPECT_EQ(frames_lost_, 0U);
  EXPECT_EQ(dropped_late_, 0U);
}

TEST_F(GromadOnCan, LosesNothingWithOdometryOnTheSameBusAndAnImuBySocket) {
  odometry_over_can_ = true;
  folder_.write("robot.dbc", R"(BO_ 257 Drive: 8 Base
 SG_ Speed : 0|16@1- (0.0005,0) [-16|16] "m/s" Robot
 SG_ Side : 16|16@1- (0.0005,0) [-16|16] "m/s" Robot
 SG_ Rate : 32|32@1- (0.000001,0) [-10|10] "rad/s" Robot
)");
  const link::CanLog log = bus_log("classic.log");
  const link::ReportCounters expected = recorded("classic.log");
  Gromad gromad({"--config", config("can",
                                    "log: drive.glog\n"
                                    "robot: {can: bus0, dbc: robot.dbc, signals: {vx_mps: Drive.Speed, "
                                    "vy_mps: Drive.Side, omega_radps: Drive.Rate}}\n"
                                    "robot_socket: robot.sock\n")});
  ASSERT_TRUE(listen_until(gromad, [&] { return client_ && robot_.clients() == 1; })) << gromad.log();
  play(log, gromad);
  const std::uint64_t all = expected.ranges + expected.ranges_not_ok;
  const auto has_all = [&] {
    return status_.value("ranges", 0U) + status_.value("dropped", 0U) >= all &&
           status_.value("odometry", 0U) >= odometry_sent_;
  };
  EXPECT_TRUE(listen_until(gromad, has_all)) << status_ << "\n" << gromad.log();
  EXPECT_GT(odometry_sent_, 100U);
  EXPECT_EQ(status_.value("odometry", 0U), odometry_sent_);
  EXPECT_EQ(status_.value("frames_lost", 1U), 0U);
  EXPECT_EQ(status_.value("dropped", 0U), expected.ranges_not_ok);
  const json& robots = status_.at("robots");
  EXPECT_EQ(robots[0].at("open"), true);
  EXPECT_EQ(robots[1].at("can").at("frames"), odometry_sent_);
  EXPECT_EQ(robots[1].at("can").at("frames_overrun"), 0);
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), io::kGood);

  // The capture repeats the poses.
  static_cast<void>(client_->read());
  const std::filesystem::path again = folder_ / "again.jsonl";
  const auto replayed = groma::test::run_child(
      {GROMA_PATH, "replay", (folder_ / "drive.glog").string(), "--stream", again.string()});
  EXPECT_EQ(replayed.exit_code, io::kGood) << replayed.err << replayed.out;
  EXPECT_FALSE(client_->pose_lines().empty());
  EXPECT_TRUE(read_text(again).ends_with(client_->pose_lines()));
}

TEST_F(GromadOnCan, CountsFramesThatModulesLoseWhileBusOffAndContinues) {
  replay("canfd", "bus_off.log");
  EXPECT_GT(frames_lost_, 0U);
  // Ranges that had waited in a module for longer than reorder_lag_s.
  EXPECT_LT(dropped_late_, 100U);
}

TEST_F(GromadOnCan, RequestsNodeIdentitiesAndSurvivesTheBusGoingDown) {
  const CanParticipant tags(bus_.name());
  Gromad gromad({"--config", config("can")});
  ASSERT_TRUE(listen_until(gromad, [&] { return client_ && robot_.clients() == 1; })) << gromad.log();
  const auto asked = tags.receive();
  ASSERT_TRUE(asked);
  EXPECT_EQ(asked->id, wire::can_id({wire::CanDirection::kToNode, 1}));
  can_frame bus_off{};
  bus_off.can_id = CAN_ERR_FLAG | 0x40U;  // CAN_ERR_BUSOFF
  bus_off.can_dlc = 8;
  tags.send_raw(bus_off);
  EXPECT_TRUE(listen_until(gromad, [&] { return gromad.log().find("(bus-off)") != std::string::npos; }))
      << gromad.log();

  bus_.down();
  EXPECT_TRUE(listen_until(gromad, [&] {
    return gromad.log().find("can:bus0/3: bus0 is down") != std::string::npos;
  })) << gromad.log();
  EXPECT_THAT(gromad.log(), HasSubstr("can:bus0/1: the link is lost"));
  bus_.up();
  EXPECT_TRUE(listen_until(gromad, [&] {
    return gromad.log().find("can:bus0/3: reopened") != std::string::npos;
  })) << gromad.log();
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), io::kGood);
}

TEST_F(GromadOnCan, WaitsForAnInterfaceThatDoesNotExist) {
  folder_.write("gromad.yaml",
                "schema: 1\nnodes: [{path: can:can7/1}]\nrobot_socket: robot.sock\npose_stream: {port: 0}\n" +
                    read_text(kRecording / "site.yaml"));
  Gromad gromad({"--config", (folder_ / "gromad.yaml").string()});
  const auto has_logged = [&](const std::string& text) {
    return listen_until(gromad, [&] { return gromad.log().find(text) != std::string::npos; });
  };
  EXPECT_TRUE(has_logged("can:can7/1: there is no interface can7")) << gromad.log();
  const VirtualCan late("can7");
  EXPECT_TRUE(has_logged("can:can7/1: opened")) << gromad.log();
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), io::kGood);
}

}  // namespace
}  // namespace groma::daemon
