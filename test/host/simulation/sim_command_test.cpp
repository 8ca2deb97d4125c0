// groma sim as a child process: a folder with ports and a socket, signals.
#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <thread>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/daemon/session.hpp"
#include "host/link/byte_link.hpp"
#include "host/link/report_decoder.hpp"
#include "test/host/daemon/gromad_process.hpp"
#include "test/host/web/listener.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"
#include "test/support/tcp_client.hpp"

namespace groma::simulation {
namespace {

using ::testing::HasSubstr;
using Clock = std::chrono::steady_clock;

double since(Clock::time_point begin) {
  return std::chrono::duration<double>(Clock::now() - begin).count();
}

bool wait_for(const std::function<bool()>& condition, double most_s) {
  const Clock::time_point begin = Clock::now();
  while (!condition()) {
    if (since(begin) > most_s) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
  }
  return true;
}

// A child process, killed by the destructor if it still runs.
class Child {
 public:
  Child(const std::vector<std::string>& arguments, const std::filesystem::path& errors) {
    std::vector<std::string> words{GROMA_EXECUTABLE};
    words.insert(words.end(), arguments.begin(), arguments.end());
    std::vector<char*> argv;
    argv.reserve(words.size() + 1);
    for (std::string& word : words) argv.push_back(word.data());
    argv.push_back(nullptr);
    const std::string path = errors.string();
    pid_ = ::fork();
    if (pid_ == 0) {
      if (std::freopen("/dev/null", "w", stdout) == nullptr ||
          std::freopen(path.c_str(), "w", stderr) == nullptr) {
        ::_exit(127);
      }
      ::execv(argv[0], argv.data());
      ::_exit(127);
    }
  }
  ~Child() {
    if (pid_ > 0) {
      ::kill(pid_, SIGKILL);
      (void)exit_code();
    }
  }
  Child(const Child&) = delete;
  Child& operator=(const Child&) = delete;

  void signal(int number) const { ::kill(pid_, number); }
  // Waits for its end; -1 if a signal ended it.
  int exit_code() {
    int status = 0;
    ::waitpid(pid_, &status, 0);
    pid_ = -1;
    return WIFEXITED(status) ? WEXITSTATUS(status) : -1;
  }

 private:
  pid_t pid_ = -1;
};

std::string scenario(const std::string& name) {
  return std::string(GROMA_SCENARIOS) + "/" + name;
}

void runs_until(int signal_number) {
  const test::ScratchFolder scratch;
  const std::filesystem::path ports = scratch / "ports";
  Child child({"sim", "--scenario", scenario("open_field.yaml"), "--speed", "1", "--ports", ports.string()},
              scratch / "errors");
  ASSERT_TRUE(wait_for([&] { return std::filesystem::exists(ports / "tag-1"); }, 20.0))
      << test::read_text(scratch / "errors");
  const link::OpenedLink tag = link::open_link(ports / "tag-1", 1'000'000);
  const link::OpenedLink robot = link::open_link(ports / "robot.sock", 0);
  ASSERT_TRUE(tag.link) << tag.error.message;
  ASSERT_TRUE(robot.link) << robot.error.message;

  daemon::Session session;
  const std::size_t node = session.add_node("tag-1", 1'000'000);
  const Clock::time_point begin = Clock::now();
  std::array<std::uint8_t, 4096> chunk{};
  const bool enough = wait_for(
      [&] {
        const std::size_t lines = robot.link->read(chunk).bytes;
        if (lines > 0) session.robot_bytes(std::span(chunk).first(lines), since(begin));
        const std::size_t size = tag.link->read(chunk).bytes;
        if (size > 0) session.node_bytes(node, std::span(chunk).first(size), since(begin));
        return session.robot_counters().odometry >= 40 && session.robot_counters().pose_priors >= 5 &&
               session.node(node).decoder().counters().ranges >= 50;
      },
      30.0);
  EXPECT_TRUE(enough) << session.robot_counters().odometry << " odometry samples, "
                      << session.node(node).decoder().counters().ranges << " ranges";
  EXPECT_EQ(session.robot_counters().dropped(), 0U);
  child.signal(signal_number);
  const int code = child.exit_code();
  EXPECT_TRUE(code == 0 || code == 3) << code;  // 3: the machine was too slow for real time
  EXPECT_FALSE(std::filesystem::exists(ports));
}

TEST(SimCommand, RunsUntilInterrupted) {
  runs_until(SIGINT);
}
TEST(SimCommand, RunsUntilTerminated) {
  runs_until(SIGTERM);
}

// ---- the exchange of timestamps over a real port ----------------------------------------------------------

struct Instant {
  double t_s = 0.0;        // of the range, as mapped to the host's clock
  double network_s = 0.0;  // the same instant in network time
  double delay_s = 0.0;    // from this instant to the reading of its report
};

class Instants : public link::NodeSink {
 public:
  void on_range(const model::RangeSample& range) override {
    if (range.network_time_dtu == 0) return;
    seen.push_back({range.t_s, static_cast<double>(range.network_time_dtu) / 63.8976e9, now_s - range.t_s});
  }
  std::vector<Instant> seen;
  double now_s = 0.0;
};

// The largest residual of a line fit of host time over network time.
double largest_residual_s(const std::vector<Instant>& seen, double& slope) {
  double x_mean = 0.0;
  double y_mean = 0.0;
  for (const Instant& i : seen) {
    x_mean += (i.network_s - seen[0].network_s) / static_cast<double>(seen.size());
    y_mean += (i.t_s - seen[0].t_s) / static_cast<double>(seen.size());
  }
  double xx = 0.0;
  double xy = 0.0;
  for (const Instant& i : seen) {
    const double x = i.network_s - seen[0].network_s - x_mean;
    xx += x * x;
    xy += x * (i.t_s - seen[0].t_s - y_mean);
  }
  slope = xy / xx;
  double worst_s = 0.0;
  for (const Instant& i : seen) {
    const double x = i.network_s - seen[0].network_s - x_mean;
    worst_s = std::max(worst_s, std::abs(i.t_s - seen[0].t_s - y_mean - slope * x));
  }
  return worst_s;
}

TEST(SimCommand, RangesHaveTimestampsWithAConstantDelayOverARealPort) {
  const test::ScratchFolder scratch;
  const std::filesystem::path ports = scratch / "ports";
  Child child({"sim", "--scenario", scenario("open_field.yaml"), "--ports", ports.string()},
              scratch / "errors");
  ASSERT_TRUE(wait_for([&] { return std::filesystem::exists(ports / "tag-1"); }, 20.0))
      << test::read_text(scratch / "errors");
  const link::OpenedLink tag = link::open_link(ports / "tag-1", 1'000'000);
  ASSERT_TRUE(tag.link) << tag.error.message;
  link::ReportDecoder decoder(1'000'000);
  Instants instants;
  const Clock::time_point begin = Clock::now();
  double next_request_s = 0.5;
  std::array<std::uint8_t, 4096> chunk{};
  const auto serve = [&] {
    instants.now_s = since(begin);
    if (instants.now_s >= next_request_s) {
      next_request_s = instants.now_s + 0.25;
      (void)tag.link->write(link::time_request(instants.now_s));
    }
    const std::size_t size = tag.link->read(chunk).bytes;
    instants.now_s = since(begin);
    if (size > 0) decoder.take(std::span(chunk).first(size), instants.now_s, instants);
  };
  ASSERT_TRUE(wait_for(
      [&] {
        serve();
        return decoder.counters().time_replies >= 16 && instants.seen.size() >= 500;
      },
      40.0));
  instants.seen.clear();
  const double from_s = since(begin);
  (void)wait_for(
      [&] {
        serve();
        return since(begin) > from_s + 6.0;
      },
      20.0);
  child.signal(SIGINT);
  if (child.exit_code() == 3) GTEST_SKIP() << "this machine is too slow for the site in real time";

  ASSERT_TRUE(decoder.time().round_trip_s());
  const double round_trip_s = *decoder.time().round_trip_s();
  double slope = 0.0;
  ASSERT_GT(instants.seen.size(), 500U);
  const double residual_s = largest_residual_s(instants.seen, slope);
  double least_delay_s = 1.0;
  for (const Instant& i : instants.seen) least_delay_s = std::min(least_delay_s, i.delay_s);
  fmt::print("round trip {:.2f} ms, instants within {:.2f} ms, the least delay {:.2f} ms\n",
             1e3 * round_trip_s, 1e3 * residual_s, 1e3 * least_delay_s);
  // The simulation runs in steps of a few milliseconds, and answers in the next step.
  EXPECT_GE(round_trip_s, 0.0);
  EXPECT_LT(round_trip_s, 0.05);
  EXPECT_NEAR(slope, 1.0, 1e-3);
  EXPECT_LT(residual_s, 0.01);
  // A report is read after its measurement, by the report's delay to the host.
  EXPECT_GT(least_delay_s, -0.5 * round_trip_s);
  EXPECT_LT(least_delay_s, 0.1);
}

TEST(SimCommand, GromadReportsTheRoundTripOfASimulatedTagsPort) {
  const test::ScratchFolder scratch;
  const std::filesystem::path ports = scratch / "ports";
  Child child({"sim", "--scenario", scenario("open_field.yaml"), "--ports", ports.string()},
              scratch / "errors");
  ASSERT_TRUE(wait_for([&] { return std::filesystem::exists(ports / "robot.sock"); }, 20.0))
      << test::read_text(scratch / "errors");
  scratch.write("gromad.yaml", R"(schema: 1
nodes: [{path: ports/tag-1, baud: 1000000}]
robot_socket: ports/robot.sock
tags: [{id: 1, lever_arm_m: [0.4, 0, 1.2]}]
odometry: {sigma_vx_mps: 0.05, sigma_vy_mps: 0.05, sigma_omega_radps: 0.02}
range: {sigma_m: 0.05, beta_m: [0.3, 0.3], gamma: [1.0, 0.002]}
surface: {type: plane, z_m: 0, normal: [-0.01, 0.005, 1]}
calibration: {drive_s: 600}
pose_stream: {port: 0}
)");
  daemon::test::Gromad gromad({"--config", scratch / "gromad.yaml"});
  std::optional<daemon::test::StreamClient> client;
  std::vector<double> round_trips_s;
  const bool received = wait_for(
      [&] {
        if (!client) {
          if (const auto port = daemon::test::pose_stream_port(gromad)) client.emplace(*port);
          return !gromad.running();
        }
        for (const nlohmann::json& object : client->read()) {
          if (object.at("class") != "STATUS") continue;
          const nlohmann::json& round_trip = object.at("links").at(0).at("round_trip_s");
          if (round_trip.is_number()) round_trips_s.push_back(round_trip);
        }
        return round_trips_s.size() >= 5 || !gromad.running();
      },
      40.0);
  ASSERT_TRUE(received && gromad.running()) << gromad.log();
  for (const double round_trip_s : round_trips_s) {
    EXPECT_GE(round_trip_s, 0.0);
    EXPECT_LT(round_trip_s, 0.05);
  }
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), 0) << gromad.log();
}

TEST(SimCommand, UnconfiguredNodesWaitAtTheirPortsForAPlan) {
  const test::ScratchFolder scratch;
  const std::filesystem::path ports = scratch / "ports";
  Child child({"sim", "--scenario", scenario("open_field.yaml"), "--unconfigured", "--ports", ports.string()},
              scratch / "errors");
  ASSERT_TRUE(wait_for([&] { return std::filesystem::exists(ports / "robot.sock"); }, 20.0))
      << test::read_text(scratch / "errors");
  scratch.write("plan.yaml",
                "schema: 1\nnetwork_id: 7\nnodes:\n  - {id: 1, role: tag, port: ports/tag-1}\n"
                "  - {id: 10, role: anchor, port: ports/anchor-10}\n");
  const auto blinking = test::run_child({GROMA_EXECUTABLE, "identify", ports / "anchor-10"});
  EXPECT_EQ(blinking.exit_code, 0) << blinking.err;
  EXPECT_THAT(blinking.out, HasSubstr("an unconfigured node"));
  for (const char* result : {"configured", "unchanged"}) {
    const auto configured = test::run_child({GROMA_EXECUTABLE, "configure", "--plan", scratch / "plan.yaml"});
    EXPECT_EQ(configured.exit_code, 0) << configured.err;
    EXPECT_THAT(configured.out, HasSubstr(result));
  }
  child.signal(SIGINT);
  EXPECT_NE(child.exit_code(), -1);
  EXPECT_FALSE(std::filesystem::exists(ports));
}

TEST(SimCommand, AnUnknownKeyEndsItWithItsPlace) {
  const test::ScratchFolder scratch;
  scratch.write("site.yaml", "schema: 1\nname: x\ncolour: red\n");
  const test::ChildResult result = test::run_child(
      {GROMA_EXECUTABLE, "sim", "--scenario", scratch / "site.yaml", "--ports", scratch / "ports"});
  EXPECT_EQ(result.exit_code, 78);
  EXPECT_THAT(result.err, HasSubstr("site.yaml:3:1: unknown key"));
  EXPECT_FALSE(std::filesystem::exists(scratch / "ports"));
}

TEST(SimCommand, AMissingScenarioOrOptionEndsItAtOnce) {
  const test::ScratchFolder scratch;
  const std::string ports = scratch / "ports";
  const auto missing =
      test::run_child({GROMA_EXECUTABLE, "sim", "--scenario", scratch / "none.yaml", "--ports", ports});
  EXPECT_EQ(missing.exit_code, 78);
  EXPECT_THAT(missing.err, HasSubstr("none.yaml"));
  EXPECT_EQ(test::run_child({GROMA_EXECUTABLE, "sim", "--ports", ports}).exit_code, 2);
  EXPECT_EQ(test::run_child({GROMA_EXECUTABLE, "sim", "--scenario", scenario("open_field.yaml"), "--speed",
                             "-1", "--ports", ports})
                .exit_code,
            2);
}

// What gromad's web server answers there; empty: nobody listens.
std::string page_at(std::uint16_t port) {
  try {
    groma::test::TcpClient client(port);
    client.send("GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
    std::string answer;
    while (!client.ended()) answer += client.await(std::chrono::milliseconds(1000));
    return answer;
  } catch (const std::runtime_error&) {
    return {};
  }
}

class LiveSite : public ::testing::Test {
 protected:
  std::vector<std::string> arguments() const {
    return {"sim",
            "--scenario",
            scenario("open_field.yaml"),
            "--live",
            "--port",
            std::to_string(port_),
            "--ports",
            (scratch_ / "ports").string()};
  }
  bool is_served() const { return page_at(port_).starts_with("HTTP/1.1 200 "); }
  std::string errors() const { return test::read_text(scratch_ / "errors"); }

  const test::ScratchFolder scratch_;
  const std::uint16_t port_ = web::test::Listener().port();  // free again
};

TEST_F(LiveSite, EndsGromadWithIt) {
  for (const int signal_number : {SIGTERM, SIGINT, SIGKILL}) {
    Child child(arguments(), scratch_ / "errors");
    ASSERT_TRUE(wait_for([&] { return is_served(); }, 30.0)) << errors();
    EXPECT_TRUE(wait_for([&] { return errors().find("live page") != std::string::npos; }, 10.0)) << errors();
    child.signal(signal_number);
    EXPECT_EQ(child.exit_code(), signal_number == SIGKILL ? -1 : 0) << errors();
    EXPECT_TRUE(wait_for([&] { return page_at(port_).empty(); }, 10.0)) << signal_number;
  }
}

TEST_F(LiveSite, KeepsAConfigurationThatItDidNotWrite) {
  std::filesystem::create_directory(scratch_ / "ports");
  const std::filesystem::path path = scratch_ / "ports" / "gromad.yaml";
  std::ofstream(path) << "nodes: []\n";
  Child child(arguments(), scratch_ / "errors");
  EXPECT_EQ(child.exit_code(), 2);
  EXPECT_THAT(errors(), HasSubstr("gromad.yaml: is not from an earlier --live"));
  EXPECT_EQ(test::read_text(path), "nodes: []\n");
}

TEST_F(LiveSite, EndsWhenGromadDoes) {
  const web::test::Listener other;
  std::vector<std::string> words = arguments();
  words[5] = std::to_string(other.port());  // not free
  Child child(words, scratch_ / "errors");
  EXPECT_EQ(child.exit_code(), 69);
  EXPECT_THAT(errors(), HasSubstr("gromad has ended"));
  EXPECT_FALSE(std::filesystem::exists(scratch_ / "ports" / "tag-1"));
}

}  // namespace
}  // namespace groma::simulation
