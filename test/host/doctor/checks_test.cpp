// Verdicts of groma doctor on what gromad and links report, without processes.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "host/doctor/advice.hpp"
#include "host/doctor/doctor.hpp"
#include "host/filter/tracker.hpp"
#include "host/io/exit_code.hpp"

namespace groma::doctor {
namespace {

using nlohmann::json;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Not;

class Checks : public ::testing::Test {
 protected:
  Checks() {
    config_.tags = {{1, {0.0, 0.0, 0.5}}};
    config_.nodes = {{"/dev/tag-1"}};
    config_.robot_socket = "robot.sock";
    live_.statuses = {json::object(), json::object()};
  }
  // Two statuses, 2 s apart.
  void observe(const json& before, const json& after, double received_s = 1000.0) {
    live_.statuses = {before, after};
    live_.received_s = {received_s - 2.0, received_s};
  }
  [[nodiscard]] Subject subject() const { return {.config = config_, .live = &live_, .anchors = {100, 101}}; }
  [[nodiscard]] Check node(const LinkFacts& facts) const {
    return judge_link(config_.nodes.front(), facts, subject()).at(1);
  }
  static LinkFacts good_node() {
    return {
        .frames = 40, .ranges = 200, .listened_s = 2.0, .node = {.id = 1, .role = "tag", .network_id = 5}};
  }

  daemon::Config config_;
  Observation live_;
};

TEST_F(Checks, ExitCodeIsThatOfTheFirstBadOne) {
  const auto bad = [](const std::string& fault) {
    Check check{.kind = "link", .name = "a"};
    check.fail(Verdict::kBad, fault, "do something");
    return check;
  };
  Check warning{.kind = "pair", .name = "1-100"};
  warning.fail(Verdict::kWarning, "gated", "look");
  EXPECT_EQ(exit_code(std::vector<Check>{}), io::kGood);
  EXPECT_EQ(exit_code(std::vector{warning}), io::kDoneWithWarnings);
  EXPECT_EQ(exit_code(std::vector{warning, bad("no-port"), bad("no-permission")}), io::kUnavailable);
  EXPECT_EQ(exit_code(std::vector{bad("no-permission"), bad("no-port")}), io::kNoPermission);
  EXPECT_EQ(exit_code(std::vector{bad("bad-configuration")}), io::kBadConfiguration);
  EXPECT_EQ(exit_code(std::vector{bad("map-mismatch")}), io::kBadData);
  warning.fail(Verdict::kWarning, "other", "");
  EXPECT_EQ(warning.fault, "gated") << "the first fault of that verdict stays";
}

TEST_F(Checks, ANodeIsJudgedByWhatItReports) {
  EXPECT_EQ(node(good_node()).verdict, Verdict::kGood);
  LinkFacts facts = good_node();
  facts.node.id = 7;
  EXPECT_EQ(node(facts).fault, "other-site");
  facts = good_node();
  facts.node.role = "unconfigured";
  EXPECT_EQ(node(facts).fault, "not-configured");
  facts = good_node();
  facts.node.radio_error = "no answer";
  EXPECT_EQ(node(facts).fault, "no-radio");
  facts = good_node();
  facts.node.sync = "searching";
  EXPECT_EQ(node(facts).fault, "no-network");
  facts = good_node();
  facts.ranges = 0;
  EXPECT_EQ(node(facts).fault, "no-ranges");
  facts = good_node();
  facts.frames = 0;
  EXPECT_EQ(node(facts).fault, "silent-node");
  observe(json::object(), {{"pairs", {{{"tag", 1}, {"anchor", 55}, {"range_m", 3.0}}}}});
  EXPECT_EQ(node(good_node()).fault, "other-site") << "none of its anchors is calibrated";
}

TEST_F(Checks, ALinkIsJudgedByItsBytes) {
  LinkFacts facts{.bad = 30, .listened_s = 2.0, .works_at = 115'200};
  const auto checks = judge_link(config_.nodes.front(), facts, subject());
  ASSERT_EQ(checks.size(), 1U) << "nothing can be said of the node";
  EXPECT_EQ(checks.front().fault, "wrong-speed");
  EXPECT_THAT(checks.front().remedy, HasSubstr("baud: 115200"));
  facts = good_node();
  facts.bad = 4;
  EXPECT_EQ(judge_link(config_.nodes.front(), facts, subject()).front().fault, "noisy-line");
  facts = {.error = {link::LinkFault::kPermission, "denied"}};
  EXPECT_EQ(judge_link(config_.nodes.front(), facts, subject()).front().fault, "no-permission");
  facts.error.fault = link::LinkFault::kNoDevice;
  EXPECT_EQ(judge_link(config_.nodes.front(), facts, subject()).front().fault, "no-port");
  EXPECT_EQ(judge_link({"can:can0/1"}, facts, subject()).front().fault, "can-down");
}

TEST_F(Checks, ARobotThatIsStationaryIsNotOneWithoutMotion) {
  const auto status = [](int odometry, double range_m) {
    json pairs;
    for (const int anchor : {100, 101, 102}) {
      pairs.push_back({{"tag", 1}, {"anchor", anchor}, {"range_m", range_m}});
    }
    return json{{"odometry", odometry},
                {"driven_m", 0.0},
                {"turned_rad", 0.0},
                {"robot", {{"open", true}}},
                {"pairs", pairs}};
  };
  observe(status(0, 3.0), status(100, 3.1));
  EXPECT_EQ(check_odometry(subject()).verdict, Verdict::kGood);
  observe(status(0, 3.0), status(100, 4.0));
  EXPECT_EQ(check_odometry(subject()).fault, "no-motion");
  observe(status(0, 3.0), status(0, 4.0));
  EXPECT_EQ(check_odometry(subject()).fault, "no-odometry");
  observe(status(0, 3.0), status(4, 3.0));
  EXPECT_EQ(check_odometry(subject()).fault, "slow-odometry");
}

TEST_F(Checks, ARobotsClockMayHaveAnotherOriginButNoOffset) {
  observe(json::object(), {{"t_s", 999.98}});
  EXPECT_EQ(check_robot_clock(subject()).verdict, Verdict::kGood);
  observe(json::object(), {{"t_s", 999.0}});
  EXPECT_EQ(check_robot_clock(subject()).fault, "clock-offset");
  EXPECT_THAT(check_robot_clock(subject()).facts.back(), HasSubstr("1.00 s behind"));
  observe(json::object(), {{"t_s", 12.0}}, 1.8e9);
  EXPECT_EQ(check_robot_clock(subject()).verdict, Verdict::kGood);
  observe(json::object(), {{"t_s", 1000.0},
                           {"diagnosis", {{{"cause", "clock-offset"}, {"evidence", "e"}, {"remedy", "r"}}}}});
  EXPECT_EQ(check_robot_clock(subject()).verdict, Verdict::kBad);
  EXPECT_EQ(check_robot_clock(subject()).remedy, "r");
}

TEST_F(Checks, APairIsJudgedByItsShareOfUsedRanges) {
  const auto pair = [](int anchor, int used, int gated) {
    return json{{"tag", 1},       {"anchor", anchor}, {"ranges", used + gated}, {"used", used},
                {"gated", gated}, {"range_m", 3.0},   {"innovation_m", 0.05}};
  };
  observe({{"pairs", {pair(100, 10, 0), pair(101, 10, 0)}}},
          {{"pairs", {pair(100, 30, 2), pair(101, 12, 18), pair(102, 0, 0)}}});
  const auto checks = check_pairs(subject());
  ASSERT_EQ(checks.size(), 4U);
  EXPECT_EQ(checks.at(0).verdict, Verdict::kGood);
  EXPECT_EQ(checks.at(1).fault, "gated");
  EXPECT_EQ(checks.at(2).fault, "unknown-anchor");
  EXPECT_THAT(checks.at(3).facts.front(), HasSubstr("2 of 2"));
}

TEST(Advice, IsThereForEachStateAndReasonButTracking) {
  EXPECT_THAT(advice_on("TRACKING", ""), IsEmpty());
  for (const char* state : {"UNINITIALIZED", "CONVERGING", "LOST", "CALIBRATION_DRIVE", "CALIBRATING",
                            "WAITING_FOR_ODOMETRY", "ODOMETRY_TIMES_WRONG"}) {
    EXPECT_THAT(advice_on(state, ""), Not(IsEmpty())) << state;
  }
  for (int reason = 1; reason <= static_cast<int>(filter::Reason::kOdometryTimes); ++reason) {
    const std::string_view name = filter::reason_name(static_cast<filter::Reason>(reason));
    EXPECT_THAT(advice_on("DEGRADED", name), Not(IsEmpty())) << name;
  }
}

}  // namespace
}  // namespace groma::doctor
