// Checks of the robot's odometry and clock, of the pairs, and of the localization.
#include <fmt/format.h>
#include <poll.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <filesystem>
#include <map>
#include <optional>
#include <set>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/daemon/robot_input.hpp"
#include "host/daemon/ros2.hpp"
#include "host/doctor/advice.hpp"
#include "host/doctor/doctor.hpp"

namespace groma::doctor {
namespace {

using Json = nlohmann::json;

constexpr double kListenToRobot_s = 1.5;
constexpr double kSlowOdometry_hz = 5.0;
constexpr double kStationary_m = 0.01;
constexpr double kStationary_rad = 0.01;
// The robot moves, by its ranges, if those of half of the pairs, and of this many, have changed by this.
constexpr double kMoved_m = 0.3;
constexpr std::size_t kMovedPairs = 3;
// Less than this is the way to doctor; with more, the robot's clock has another origin.
constexpr double kClockOffset_s = 0.1;
constexpr double kOtherOrigin_s = 86'400.0;
constexpr double kGatedShare = 0.5;
constexpr double kFewRanges = 5.0;  // too few to judge a pair

std::string robot_name(const daemon::Config& config) {
  std::vector<std::string> names;
  if (!config.robot_socket.empty()) names.push_back(config.robot_socket.string());
  for (const std::filesystem::path& listen : config.robot_listen) names.push_back(listen.string());
  if (config.robot_can) names.push_back("can:" + config.robot_can->interface);
  if (config.ros2) names.push_back(daemon::Ros2::link_name(*config.ros2));
  return fmt::format("{}", fmt::join(names, ", "));
}

// The first of the robot's links that is not open.
std::optional<Json> closed_link(const Json& status) {
  const Json only = Json::array({status.value("robot", Json::object())});
  for (const Json& link : status.value("robots", only)) {
    if (!link.value("open", false)) return link;
  }
  return std::nullopt;
}

// The valid odometry lines that the robot's program sends within kListenToRobot_s.
void listen_to_robot(const std::string& path, Check& check) {
  const link::OpenedLink opened = link::open_link(path, 0);
  if (!opened.link) {
    check.facts.push_back(opened.error.message);
    check.fail(Verdict::kBad,
               opened.error.fault == link::LinkFault::kPermission ? "no-permission" : "no-odometry",
               "start the program that serves the robot's odometry, or correct 'robot_socket'");
    return;
  }
  using Clock = std::chrono::steady_clock;
  daemon::RobotInput input;
  const Clock::time_point end = Clock::now() + std::chrono::duration_cast<Clock::duration>(
                                                   std::chrono::duration<double>(kListenToRobot_s));
  for (bool gone = false; !gone && Clock::now() < end;) {
    pollfd entry{opened.link->poll_fd(), POLLIN, 0};
    static_cast<void>(::poll(&entry, 1, 50));
    std::array<std::uint8_t, daemon::RobotInput::kReadSize> chunk{};
    const link::ReadResult read = opened.link->read(chunk);
    gone = read.gone;
    input.push(std::span(chunk).first(read.bytes));
    while (input.next()) {
    }
  }
  check.facts.push_back(fmt::format("{:.1f} odometry samples/s, {} lines dropped",
                                    static_cast<double>(input.counters().odometry) / kListenToRobot_s,
                                    input.counters().dropped()));
  if (input.counters().dropped() > 0) check.facts.push_back(input.last_problem());
  if (input.counters().odometry == 0) {
    check.fail(Verdict::kBad, "no-odometry", "let the robot's program send odometry to this socket");
  }
}

Check check_odometry_offline(const daemon::Config& config, Check check) {
  const std::string path = config.robot_socket.string();
  if (path.empty()) {
    check.facts.emplace_back("only a running gromad reads it");
  } else {
    listen_to_robot(path, check);
  }
  return check;
}

using PairKey = std::pair<int, int>;  // tag, anchor

PairKey key_of(const Json& pair) {
  return {pair.at("tag").get<int>(), pair.at("anchor").get<int>()};
}

// Whether the ranges of several pairs have changed as those of a robot that moves.
bool moves_by_ranges(const Observation& live) {
  std::map<PairKey, double> before;
  for (const Json& pair : live.statuses.front().value("pairs", Json::array())) {
    before[key_of(pair)] = pair.at("range_m").get<double>();
  }
  std::size_t compared = 0;
  std::size_t moved = 0;
  for (const Json& pair : live.statuses.back().value("pairs", Json::array())) {
    const auto found = before.find(key_of(pair));
    if (found == before.end()) continue;
    ++compared;
    if (std::abs(pair.at("range_m").get<double>() - found->second) > kMoved_m) ++moved;
  }
  return moved >= kMovedPairs && 2 * moved >= compared;
}

bool is_of_times(const std::string& cause) {
  return cause == "clock-offset" || cause == "time-unit";
}

double counter_at(const Json& object, const char* key) {
  return object.value(key, 0.0);
}

}  // namespace

Check check_odometry(const Subject& subject) {
  Check check{.kind = "odometry", .name = robot_name(subject.config)};
  if (subject.live == nullptr) return check_odometry_offline(subject.config, std::move(check));
  const Observation& live = *subject.live;
  if (const std::optional<Json> closed = closed_link(live.statuses.back())) {
    const Json error = closed->value("error", Json());
    check.facts.push_back(error.is_string() ? error.get<std::string>() : "the link is not open");
    check.fail(
        Verdict::kBad, "no-odometry",
        "start the program that serves the robot's odometry, or correct the path in the configuration");
    return check;
  }
  const double seconds = std::max(live.duration_s(), 0.1);
  const double rate_hz = live.growth("/odometry") / seconds;
  const double driven_m = live.growth("/driven_m");
  const double turned_rad = live.growth("/turned_rad");
  check.facts.push_back(fmt::format("{:.1f} samples/s, drives {:.2f} m/s, turns {:.2f} rad/s", rate_hz,
                                    driven_m / seconds, turned_rad / seconds));
  if (rate_hz <= 0.0) {
    check.fail(Verdict::kBad, "no-odometry",
               "the link is open, but no odometry is accepted: check what the robot's program sends; "
               "gromad's log says which lines are dropped");
  } else if (driven_m < kStationary_m && turned_rad < kStationary_rad && moves_by_ranges(live)) {
    check.facts.emplace_back("the ranges change as those of a robot that moves");
    check.fail(Verdict::kBad, "no-motion",
               "the odometry says that the robot is stationary while it moves: check the encoders, and the "
               "program that computes odometry");
  } else if (rate_hz < kSlowOdometry_hz) {
    check.fail(Verdict::kWarning, "slow-odometry", "send odometry at 10 Hz or more");
  }
  return check;
}

Check check_robot_clock(const Subject& subject) {
  const Observation& live = *subject.live;
  Check check{.kind = "clock", .name = "robot"};
  for (const Json& finding : live.statuses.back().value("diagnosis", Json::array())) {
    const std::string cause = finding.value("cause", "");
    if (!is_of_times(cause)) continue;
    check.facts.push_back(finding.value("evidence", ""));
    check.fail(Verdict::kBad, cause, finding.value("remedy", ""));
  }
  const Json t_s = live.statuses.back().value("t_s", Json());
  if (!t_s.is_number()) {
    check.facts.emplace_back("not known before the first odometry sample");
    return check;
  }
  const double offset_s = t_s.get<double>() - live.received_s.back();
  if (subject.config.speed != 1.0 || std::abs(offset_s) > kOtherOrigin_s) {
    check.facts.emplace_back("has its own origin, which is no fault");
    return check;
  }
  check.facts.push_back(
      fmt::format("{:.2f} s {} this computer's", std::abs(offset_s), offset_s < 0.0 ? "behind" : "ahead of"));
  if (std::abs(offset_s) > kClockOffset_s) {
    check.fail(Verdict::kWarning, "clock-offset",
               "poses have the robot's time: synchronize both computers, such as by chrony, or let consumers "
               "use the robot's clock");
  }
  return check;
}

std::vector<Check> check_pairs(const Subject& subject) {
  const Observation& live = *subject.live;
  std::map<PairKey, Json> before;
  for (const Json& pair : live.statuses.front().value("pairs", Json::array())) {
    before[key_of(pair)] = pair;
  }
  std::set<model::NodeId> heard;
  std::vector<Check> checks;
  for (const Json& pair : live.statuses.back().value("pairs", Json::array())) {
    const Json& old = before[key_of(pair)];
    const auto growth = [&](const char* key) {
      return counter_at(pair, key) - (old.is_null() ? 0.0 : counter_at(old, key));
    };
    const auto anchor = pair.at("anchor").get<model::NodeId>();
    heard.insert(anchor);
    Check check{.kind = "pair", .name = fmt::format("{}-{}", pair.at("tag").get<int>(), anchor)};
    const double judged = growth("used") + growth("gated");
    std::string fact = fmt::format("{:.1f} ranges/s", growth("ranges") / std::max(live.duration_s(), 0.1));
    if (judged > 0.0) fact += fmt::format(", {:.0f} % used", 100.0 * growth("used") / judged);
    if (pair.value("innovation_m", Json()).is_number()) {
      fact += fmt::format(", residual {:.2f} m", pair.at("innovation_m").get<double>());
    }
    check.facts.push_back(fact);
    if (!subject.anchors.empty() && !subject.anchors.contains(anchor) && !subject.config.calibration.learn) {
      check.fail(Verdict::kWarning, "unknown-anchor", "calibrate this anchor: it is not in the calibration");
    } else if (judged >= kFewRanges && growth("gated") > kGatedShare * judged) {
      check.fail(Verdict::kWarning, "gated",
                 "something is in between, or the anchor was moved: 'groma diff' compares two calibrations");
    }
    checks.push_back(check);
  }
  if (subject.anchors.empty()) return checks;
  Check anchors{.kind = "anchors", .name = "heard"};
  std::string missing;
  for (const model::NodeId id : subject.anchors) {
    if (!heard.contains(id)) missing += fmt::format("{}{}", missing.empty() ? "; not: " : ", ", id);
  }
  anchors.facts.push_back(fmt::format("{} of {} calibrated ones{}",
                                      std::count_if(subject.anchors.begin(), subject.anchors.end(),
                                                    [&](model::NodeId id) { return heard.contains(id); }),
                                      subject.anchors.size(), missing));
  if (heard.size() < 3) {
    anchors.fail(Verdict::kWarning, "few-anchors", "check the power of the anchors nearby");
  }
  checks.push_back(anchors);
  return checks;
}

std::vector<Check> check_localization(const Subject& subject) {
  const Observation& live = *subject.live;
  std::vector<Check> checks;
  for (const Json& finding : live.statuses.back().value("diagnosis", Json::array())) {
    const std::string cause = finding.value("cause", "");
    if (is_of_times(cause)) continue;
    Check check{.kind = "diagnosis", .name = cause, .facts = {finding.value("evidence", "")}};
    check.fail(Verdict::kBad, cause, finding.value("remedy", ""));
    checks.push_back(check);
  }
  const std::string state = live.statuses.back().value("state", "");
  const Json reason = live.pose.is_object() && live.pose.value("state", "") == state
                          ? live.pose.value("reason", Json())
                          : Json();
  const std::string why = reason.is_string() ? reason.get<std::string>() : std::string();
  Check check{.kind = "localization", .name = state + (why.empty() ? "" : ": " + why)};
  const Json latency = live.statuses.back().value("pose_latency_s", Json::object()).value("p99", Json());
  check.facts.push_back(fmt::format(
      "{:.1f} poses/s{}", static_cast<double>(live.poses) / std::max(live.duration_s(), 0.1),
      latency.is_number() ? fmt::format(", latency p99 up to {:.2f} ms", 1e3 * latency.get<double>()) : ""));
  if (state != "TRACKING") {
    const bool is_lost = state == "LOST" || state == "DEGRADED" || state == "ODOMETRY_TIMES_WRONG";
    check.fail(is_lost ? Verdict::kBad : Verdict::kWarning, "not-tracking", advice_on(state, why));
  }
  checks.push_back(check);
  return checks;
}

}  // namespace groma::doctor
