// groma monitor: what it draws, and as a process on a pseudo-terminal beside gromad and a simulated site.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <random>

#include "host/doctor/monitor_view.hpp"
#include "host/io/exit_code.hpp"
#include "test/host/doctor/doctor_fixture.hpp"
#include "test/host/doctor/terminal_screen.hpp"

namespace groma::doctor {
namespace {

using daemon::Gromad;
using daemon::SimulatedSite;
using nlohmann::json;
using test::TerminalProgram;
using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::Not;

std::size_t width(const Line& line) {
  return rendered(line, false).size();
}

std::string text_of(const MonitorView& view, const ScreenSize& size = {}) {
  std::string out;
  for (const Line& line : view.draw(size)) out += rendered(line, false) + "\n";
  return out;
}

json status(int second) {
  json pairs;
  json anchors;
  for (int anchor = 100; anchor < 130; ++anchor) {
    anchors.push_back({{"id", anchor}, {"verdict", anchor == 101 ? "weak" : "ok"}});
    pairs.push_back({{"tag", 1},
                     {"anchor", anchor},
                     {"ranges", 10 * second},
                     {"innovation_m", 0.05},
                     {"used", anchor == 107 ? 2 * second : 10 * second},
                     {"gated", anchor == 107 ? 8 * second : 0},
                     {"range_m", 3.0}});
  }
  const json link{
      {"link", "/dev/ttyACM0"}, {"open", true},          {"error", nullptr},
      {"round_trip_s", 0.0012}, {"frames", 20 * second}, {"frames_dropped", 0},
      {"bytes_discarded", 0},   {"ranges", 60 * second}, {"node", {{"id", 1}, {"sync", "locked"}}}};
  return {{"class", "STATUS"},
          {"state", "DEGRADED"},
          {"odometry", 50 * second},
          {"ranges", 60 * second},
          {"frames_lost", 0},
          {"dropped", 3 * second},
          {"links", {link}},
          {"robot", {{"link", "robot.sock"}, {"open", false}, {"error", "no such device"}}},
          {"diagnosis", json::array()},
          {"pose_latency_s", {{"p50", 0.0001}, {"p99", 0.0005}}},
          {"anchors", anchors},
          {"pairs", pairs}};
}

MonitorView complete_view() {
  MonitorView view("tcp://127.0.0.1:4721");
  view.take({{"class", "VERSION"}, {"version", "1.2.3"}}, 0.0);
  view.take(status(1), 1.0);
  view.take({{"class", "POSE"}, {"state", "DEGRADED"}, {"reason", "no-odometry"}, {"x_m", 12.3456}}, 1.5);
  view.take(status(2), 2.0);
  return view;
}

TEST(MonitorView, ShowsStateWithRemedyRatesLinksAnchorsAndTheWorstPairsFirst) {
  const std::string text = text_of(complete_view());
  EXPECT_THAT(text,
              AllOf(HasSubstr("gromad 1.2.3  tcp://127.0.0.1:4721"), HasSubstr("DEGRADED  no-odometry"),
                    HasSubstr("-> check the program that sends the robot's odometry"),
                    HasSubstr("x    12.346 +-- m"), HasSubstr("odometry 50.0/s"), HasSubstr("dropped 3.0/s"),
                    HasSubstr("99 % below 0.50 ms"), HasSubstr("no such device"), HasSubstr("more")));
  EXPECT_THAT(text, testing::ContainsRegex("ttyACM0 +open +1 +20.0 +60.0 +0.0 +1.20\n"));
  EXPECT_THAT(text, testing::ContainsRegex(" 100 ok +10.0 +1-107 +10.0 +20 % +0.05\n")) << text;
}

TEST(MonitorView, FitsIntoAnySize) {
  for (const std::size_t rows : {1U, 2U, 5U, 10U, 13U, 14U, 24U, 60U}) {
    for (const std::size_t columns : {1U, 20U, 40U, 80U, 200U}) {
      const std::vector<Line> lines = complete_view().draw({rows, columns});
      EXPECT_LE(lines.size(), rows);
      for (const Line& line : lines) EXPECT_LE(width(line), columns);
    }
  }
  EXPECT_EQ(complete_view().draw({24, 80}).size(), 24U);
}

TEST(MonitorView, SaysThatItWaits) {
  MonitorView view("tcp://127.0.0.1:4721");
  EXPECT_THAT(text_of(view), HasSubstr("waits for gromad"));
  view = complete_view();
  view.lost("nobody\x1b[2J listens");
  EXPECT_THAT(text_of(view), HasSubstr("nobody?[2J listens"));
  EXPECT_FALSE(view.is_complete());
}

// Whatever the other side sends, no control character reaches the terminal, and nothing throws.
class AnyObject : public testing::TestWithParam<unsigned> {};
TEST_P(AnyObject, IsTaken) {
  std::mt19937 random(GetParam());
  const std::vector<json> values{nullptr,
                                 true,
                                 -1,
                                 1e308,
                                 "a\x1b[2J\n",
                                 json::array(),
                                 json::object(),
                                 json::array({1, "x"}),
                                 json::object({{"id", "x"}})};
  for (int i = 0; i < 500; ++i) {
    MonitorView view("tcp://127.0.0.1:4721");
    for (int second = 1; second < 4; ++second) {
      json message = status(second);
      for (int change = 0; change < 3; ++change) {
        // Any value below the object, except its class.
        json* at = &message;
        while (at->is_structured() && !at->empty() && (at == &message || random() % 2 == 0))
          at = &*std::next(at->begin(), static_cast<std::ptrdiff_t>(random() % at->size()));
        if (at != &message.at("class")) *at = values.at(random() % values.size());
      }
      view.take(message, second);
    }
    for (const char c : text_of(view)) ASSERT_TRUE(c == '\n' || (c >= ' ' && c <= '~'));
  }
}

INSTANTIATE_TEST_SUITE_P(Seeds, AnyObject, testing::Range(0U, 4U));

class Monitor : public daemon::DoctorTest {
 protected:
  [[nodiscard]] std::string address() const { return "127.0.0.1:" + std::to_string(stream_port_); }
  // Runs the site until the screen has that text.
  bool run_until_shown(SimulatedSite& site, Gromad& gromad, TerminalProgram& monitor,
                       const std::string& text) {
    return run_until(site, gromad, [&] {
      monitor.update();
      return monitor.screen().find(text) != std::string::npos;
    });
  }
};

TEST_F(Monitor, RedrawsInPlaceResizesAndQuits) {
  SimulatedSite site(folder_.path(), daemon::kSpeed);
  write_surveyed(site);
  Gromad gromad({"--config", write_config("{file: calibration.yaml}").string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") > 0; })) << gromad.log();
  TerminalProgram monitor({GROMA_PATH, "monitor", address()}, 24, 80);
  ASSERT_TRUE(run_until_shown(site, gromad, monitor, "1-105")) << monitor.screen();
  ASSERT_TRUE(run_until_shown(site, gromad, monitor, "100 %")) << monitor.screen();
  const std::string screen = monitor.screen();
  EXPECT_EQ(screen.rfind("gromad ", 0), 0U);
  EXPECT_THAT(screen, AllOf(HasSubstr("TRACKING"), HasSubstr("q: quit\n"), HasSubstr("robot.sock"),
                            HasSubstr("tag-1"), HasSubstr("105 ok")));
  EXPECT_TRUE(monitor.is_alternate());
  EXPECT_THAT(monitor.output(), HasSubstr("\x1b[32mTRACKING")) << "green";
  EXPECT_EQ(monitor.settings().c_lflag & static_cast<tcflag_t>(ECHO), 0U);

  const auto run_for_frames = [&](int count) {
    const int end = monitor.frames() + count;
    return run_until(site, gromad, [&] {
      monitor.update();
      return monitor.frames() >= end;
    });
  };
  const std::vector<std::pair<int, int>> sizes{{12, 40}, {3, 10}, {40, 100}};
  for (const auto& [rows, columns] : sizes) {
    monitor.resize(static_cast<unsigned short>(rows), static_cast<unsigned short>(columns));
    ASSERT_TRUE(run_for_frames(2)) << "those of the old size";
    monitor.forget_overflows();
    ASSERT_TRUE(run_for_frames(3));
    EXPECT_EQ(monitor.overflows(), 0) << rows << "x" << columns;
    EXPECT_THAT(monitor.screen(), HasSubstr("TRACKING"));
  }
  ASSERT_TRUE(run_until_shown(site, gromad, monitor, "1-105")) << monitor.screen();

  gromad.terminate();
  ASSERT_EQ(gromad.exit_code(), io::kGood);
  Gromad again({"--config", (folder_ / "gromad.yaml").string()});
  client_.reset();
  ASSERT_TRUE(run_until(site, again, [&] {
    monitor.update();
    return monitor.output().find("gromad has ended") != std::string::npos;
  }));
  ASSERT_TRUE(run_until_shown(site, again, monitor, "TRACKING")) << "it connects again";

  monitor.type("q");
  ASSERT_TRUE(run_until(site, again, [&] {
    monitor.update();
    return !monitor.running();
  }));
  EXPECT_EQ(monitor.exit_code(), io::kGood);
  monitor.update();
  EXPECT_FALSE(monitor.is_alternate());
  EXPECT_EQ(monitor.overflows(), 0);
  EXPECT_NE(monitor.settings().c_lflag & static_cast<tcflag_t>(ECHO), 0U) << "as before";
}

TEST_F(Monitor, HasNoColoursWhereTheyAreNotWanted) {
  SimulatedSite site(folder_.path(), daemon::kSpeed);
  write_surveyed(site);
  Gromad gromad({"--config", write_config("{file: calibration.yaml}").string()});
  TerminalProgram monitor({GROMA_PATH, "monitor", "--config", (folder_ / "gromad.yaml").string()}, 24, 80,
                          {{"NO_COLOR", "1"}});
  ASSERT_TRUE(run_until_shown(site, gromad, monitor, "TRACKING")) << monitor.screen();
  EXPECT_THAT(monitor.output(), Not(testing::ContainsRegex("\x1b\\[[0-9]*m")));
  monitor.type("\x03");
  ASSERT_TRUE(run_until(site, gromad, [&] {
    monitor.update();
    return !monitor.running();
  }));
  EXPECT_EQ(monitor.exit_code(), io::kGood) << "Ctrl-C ends it as q does";
  monitor.update();
  EXPECT_FALSE(monitor.is_alternate());
}

TEST_F(Monitor, PrintsPlainBlocksWithoutATerminal) {
  SimulatedSite site(folder_.path(), daemon::kSpeed);
  write_surveyed(site);
  Gromad gromad({"--config", write_config("{file: calibration.yaml}").string()});
  ASSERT_TRUE(run_until(site, gromad, [&] { return poses("TRACKING") > 0; })) << gromad.log();
  client_.reset();
  const auto result = run_beside(site, {GROMA_PATH, "monitor", "--once", address()});
  EXPECT_EQ(result.exit_code, io::kGood) << result.err;
  EXPECT_THAT(result.out, AllOf(HasSubstr("TRACKING\n"), HasSubstr("1-105"), Not(HasSubstr("\x1b"))));
  EXPECT_TRUE(result.out.ends_with("\n\n"));
}

TEST_F(Monitor, SaysWhenThereIsNoGromad) {
  const auto result = groma::test::run_child({GROMA_PATH, "monitor", "--once", address()});
  EXPECT_EQ(result.exit_code, io::kUnavailable);
  EXPECT_THAT(result.err, HasSubstr(address()));
  EXPECT_EQ(groma::test::run_child({GROMA_PATH, "monitor", "nonsense"}).exit_code, io::kUsage);
}

}  // namespace
}  // namespace groma::doctor
