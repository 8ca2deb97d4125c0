#include "host/daemon/session.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <utility>

namespace groma::daemon {
namespace {

// The robot's clock as a counter.
constexpr double kRobotTicksPerSecond = 1e9;

std::int64_t robot_ticks(double t_s) {
  return std::llround(t_s * kRobotTicksPerSecond);
}

// Beyond this a t_s has no nanoseconds in 64 bits.
constexpr double kMaxRobotTime_s = 9e9;

template <typename... Handlers>
struct Overloaded : Handlers... {
  using Handlers::operator()...;
};
template <typename... Handlers>
Overloaded(Handlers...) -> Overloaded<Handlers...>;

}  // namespace

Session::Node::Node(Session& session, std::string name, unsigned baud)
    : session_(session), name_(std::move(name)), decoder_(baud) {}

void Session::Node::on_range(const model::RangeSample& range) {
  session_.take(range);
}

void Session::Node::on_hello(const groma_Hello& hello) {
  hello_ = hello;
  session_.say(fmt::format("{}: node {} runs version {}, reset reason {}{}{}", name_, hello.id, hello.version,
                           link::number_in(hello.reset_reason),
                           hello.radio_error[0] != '\0' ? "; radio: " : "", hello.radio_error));
}

void Session::Node::on_log(const groma_Log& log) {
  session_.say(fmt::format("{}: {}", name_, log.text));
}

Session::Session(SessionConfig config) : config_(std::move(config)), robot_clock_(kRobotTicksPerSecond) {}

std::size_t Session::add_node(std::string name, unsigned baud) {
  nodes_.emplace_back(*this, std::move(name), baud);
  return nodes_.size() - 1;
}

void Session::attach(MeasurementSink& sink) {
  sinks_.push_back(&sink);
}

void Session::detach(MeasurementSink& sink) {
  std::erase(sinks_, &sink);
}

void Session::node_bytes(std::size_t node, std::span<const std::uint8_t> bytes, double now_s) {
  now_s_ = now_s;
  Node& entry = nodes_.at(node);
  entry.decoder_.take(bytes, now_s, entry);
}

void Session::robot_bytes(std::span<const std::uint8_t> bytes, double now_s) {
  now_s_ = now_s;
  robot_.push(bytes);
  while (const auto message = robot_.next()) {
    std::visit([&](const auto& sample) { take(sample, now_s); }, *message);
  }
  // A babbling robot does not fill the log: the 1st, 2nd, 4th, 8th ... line dropped is told of.
  const std::uint64_t dropped = robot_.counters().dropped();
  if (std::bit_width(dropped) != std::bit_width(robot_lines_dropped_)) {
    say(fmt::format("robot: {} lines dropped so far; the last: {}", dropped, robot_.last_problem()));
  }
  robot_lines_dropped_ = dropped;
}

void Session::node_reopened(std::size_t node) {
  nodes_.at(node).decoder_.link_reopened();
}

void Session::robot_reopened() {
  robot_.reset();
}

void Session::advance(double now_s) {
  now_s_ = now_s;
  const auto robot_now_s = robot_time_s(now_s);
  if (!robot_now_s) return;
  const double until_s = *robot_now_s - config_.reorder_lag_s;
  while (!waiting_.empty() && waiting_.top().t_s <= until_s) {
    const Waiting next = waiting_.top();
    waiting_.pop();
    deliver(next.sample);
  }
  passed_until_s_ = std::max(until_s, passed_until_s_.value_or(until_s));
}

void Session::flush() {
  while (!waiting_.empty()) {
    const Waiting next = waiting_.top();
    waiting_.pop();
    passed_until_s_ = std::max(next.t_s, passed_until_s_.value_or(next.t_s));
    deliver(next.sample);
  }
}

std::optional<double> Session::robot_time_s(double host_s) const {
  const auto ticks = robot_clock_.to_ticks(host_s);
  if (!ticks) return std::nullopt;
  return static_cast<double>(*ticks) / kRobotTicksPerSecond;
}

std::uint64_t Session::frames_lost() const noexcept {
  std::uint64_t lost = 0;
  for (const Node& node : nodes_) lost += node.decoder_.counters().frames_lost;
  return lost;
}

bool Session::Later::operator()(const Waiting& a, const Waiting& b) const noexcept {
  if (a.t_s != b.t_s) return a.t_s > b.t_s;
  if (a.sample.index() != b.sample.index()) return a.sample.index() > b.sample.index();
  const auto* range = std::get_if<model::RangeSample>(&a.sample);
  const auto* other = std::get_if<model::RangeSample>(&b.sample);
  if (range != nullptr && other != nullptr) {
    const auto key = std::pair(range->tag_id, range->anchor_id);
    const auto other_key = std::pair(other->tag_id, other->anchor_id);
    if (key != other_key) return key > other_key;
  }
  return a.serial > b.serial;
}

bool Session::clock_is_wrong(double t_s, double now_s) {
  if (std::abs(t_s) > kMaxRobotTime_s) return true;
  const auto expected_s = robot_time_s(now_s);
  return expected_s && std::abs(t_s - *expected_s) > config_.max_clock_error_s;
}

void Session::take(const model::OdometrySample& row, double now_s) {
  if (clock_is_wrong(row.t_s, now_s)) {
    if (!wrong_since_s_) wrong_since_s_ = now_s;
    if (now_s - *wrong_since_s_ < config_.clock_set_after_s || std::abs(row.t_s) > kMaxRobotTime_s) {
      ++counters_.robot_time_wrong;
      return;
    }
    clock_was_set();
  }
  wrong_since_s_.reset();
  if (last_odometry_s_ && row.t_s <= *last_odometry_s_) {
    ++counters_.odometry_out_of_order;
    return;
  }
  last_odometry_s_ = row.t_s;
  robot_clock_.observe(robot_ticks(row.t_s), now_s, 0.0);
  enqueue(row.t_s, row);
}

bool Session::accepts(double t_s, double now_s) {
  const auto robot_now_s = robot_time_s(now_s);
  if (!robot_now_s) {
    ++counters_.without_odometry;
    return false;
  }
  if (t_s - *robot_now_s > config_.max_clock_error_s) {
    ++counters_.robot_time_wrong;
    return false;
  }
  return true;
}

void Session::take(const model::PoseSample& pose, double now_s) {
  if (accepts(pose.t_s, now_s)) enqueue(pose.t_s, pose);
}

void Session::take(const model::SensorSample& sample, double now_s) {
  const double t_s = model::time_of(sample);
  if (accepts(t_s, now_s)) enqueue(t_s, sample);
}

void Session::take(model::RangeSample range) {
  const auto t_s = robot_time_s(range.t_s);
  if (!t_s) {
    ++counters_.without_odometry;
    return;
  }
  range.t_s = *t_s;
  enqueue(range.t_s, range);
}

void Session::enqueue(double t_s, const Sample& sample) {
  if (*robot_time_s(now_s_) - t_s > config_.max_lateness_s) {
    ++counters_.dropped_late;
    return;
  }
  if (passed_until_s_ && t_s < *passed_until_s_) {
    ++counters_.passed_late;
    deliver(sample);
    return;
  }
  waiting_.push({t_s, serial_++, sample});
  tell_ahead(sample);
  if (waiting_.size() > config_.max_waiting) {
    ++counters_.waiting_overflows;
    const Waiting first = waiting_.top();
    waiting_.pop();
    passed_until_s_ = std::max(first.t_s, passed_until_s_.value_or(first.t_s));
    deliver(first.sample);
  }
}

void Session::deliver(const Sample& sample) {
  std::visit(Overloaded{
                 [&](const model::OdometrySample& row) {
                   ++counters_.odometry;
                   for (MeasurementSink* sink : sinks_) sink->on_odometry(row);
                 },
                 [&](const model::PoseSample& pose) {
                   ++counters_.pose_priors;
                   for (MeasurementSink* sink : sinks_) sink->on_pose_prior(pose);
                 },
                 [&](const model::RangeSample& range) {
                   ++counters_.ranges;
                   for (MeasurementSink* sink : sinks_) sink->on_range(range);
                 },
                 [&](const model::SensorSample& of) {
                   ++counters_.sensors;
                   for (MeasurementSink* sink : sinks_) sink->on_sensor(of);
                 },
             },
             sample);
}

void Session::tell_ahead(const Sample& sample) {
  if (const auto* row = std::get_if<model::OdometrySample>(&sample)) {
    for (MeasurementSink* sink : sinks_) sink->on_odometry_ahead(*row);
  } else if (const auto* of = std::get_if<model::SensorSample>(&sample)) {
    for (MeasurementSink* sink : sinks_) sink->on_sensor_ahead(*of);
  }
}

void Session::clock_was_set() {
  ++counters_.robot_clock_set;
  say("robot: its clock was set, or it restarted; starting anew");
  robot_clock_.reset();
  last_odometry_s_.reset();
  passed_until_s_.reset();
  waiting_ = {};
  for (MeasurementSink* sink : sinks_) sink->on_clock_set();
}

void Session::say(std::string_view text) const {
  if (config_.log) config_.log(text);
}

}  // namespace groma::daemon
