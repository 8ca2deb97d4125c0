#include "host/daemon/session.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <string_view>
#include <tuple>
#include <utility>

namespace groma::daemon {
namespace {

// The log reports that all odometry is dropped after this time.
constexpr double kDropReported_s = 1.0;
// The period over which the rate of odometry is measured, and the share of passed samples below which they
// count as merged: a pair of samples that jitters is none.
constexpr double kRateOver_s = 1.0;
constexpr double kMergedShare = 0.75;
// Minimum time between log messages about late odometry.
constexpr double kLateReported_s = 10.0;

template <typename Sample>
void shift_time(Sample& sample, double by_s) {
  sample.t_s += by_s;
}
void shift_time(InitialPose& initial, double by_s) {
  initial.pose.t_s += by_s;
}
template <typename... Samples>
void shift_time(std::variant<Samples...>& sample, double by_s) {
  std::visit([by_s](auto& of) { shift_time(of, by_s); }, sample);
}

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
  tag_id_ = range.tag_id;
  session_.take(range);
}

void Session::Node::on_hello(const groma_Hello& hello) {
  // A node says it when it starts, and again when gromad asks. Boot 0: it could not be counted.
  const auto shown = [](const groma_Hello& of) {
    return std::tuple(of.id, of.boot_count, std::string_view(of.radio_error),
                      std::string_view(of.radio_warning));
  };
  const bool is_said = hello_ && hello.boot_count != 0 && shown(*hello_) == shown(hello);
  hello_ = hello;
  if (is_said) return;
  const char* radio = hello.radio_error[0] != '\0' ? hello.radio_error : hello.radio_warning;
  session_.say(fmt::format("{}: node {} runs version {}, reset reason {}{}{}", name_, hello.id, hello.version,
                           link::number_in(hello.reset_reason), radio[0] != '\0' ? "; radio: " : "", radio));
}

void Session::Node::on_log(const groma_Log& log) {
  session_.say(fmt::format("{}: {}", name_, log.text));
}

void Session::Node::on_reply(const groma_Reply& reply) {
  if (!reply.has_config || !reply.config.has_schedule) return;
  const groma_Schedule& schedule = reply.config.schedule;
  slots_ = schedule.slots > 0 ? schedule.slots : std::uint32_t{schedule.tag_ids_count};
}

Session::Session(SessionConfig config)
    : config_(std::move(config)),
      robot_clock_({.max_error_s = config_.max_clock_error_s, .set_after_s = config_.clock_set_after_s}) {
  // One more than wait, and the two that the merger holds at a clock step.
  waiting_.reserve(config_.max_waiting + 3);
  suspended_.reserve(2 * kMaxSuspended);
}

std::size_t Session::add_node(std::string name, unsigned baud) {
  nodes_.emplace_back(*this, std::move(name), baud);
  return nodes_.size() - 1;
}

void Session::attach(MeasurementSink& sink) {
  sinks_.push_back(&sink);
  if (times_suspect_) sink.on_odometry_times(true);
}

void Session::detach(MeasurementSink& sink) {
  std::erase(sinks_, &sink);
}

void Session::node_bytes(std::size_t node, std::span<const std::uint8_t> bytes, double now_s) {
  now_s_ = now_s;
  Node& entry = nodes_.at(node);
  entry.decoder_.take(bytes, now_s, entry);
}

void Session::robot_bytes(std::span<const std::uint8_t> bytes, double now_s, std::size_t robot) {
  now_s_ = now_s;
  RobotInput& input = robot_input(robot);
  input.push(bytes);
  while (const auto message = input.next()) {
    if (std::holds_alternative<model::OdometrySample>(*message)) {
      gives_odom_ = input.odom_pose().has_value();
      if (gives_odom_) odoms_.at(next_odom_++ % odoms_.size()) = *input.odom_pose();
    }
    std::visit([&](const auto& sample) { take(sample, now_s); }, *message);
  }
  const std::uint64_t dropped = robot_counters().dropped();
  if (robot_lines_dropped_.is_due(dropped)) {
    say(fmt::format("robot: {} lines dropped so far; the last: {}", dropped, input.last_problem()));
  }
}

void Session::node_reopened(std::size_t node) {
  nodes_.at(node).decoder_.link_reopened();
}

void Session::robot_reopened(std::size_t robot) {
  robot_input(robot).reset();
}

RobotInputCounters Session::robot_counters() const noexcept {
  RobotInputCounters sum;
  for (const RobotInput& input : robots_) sum += input.counters();
  return sum;
}

RobotInput& Session::robot_input(std::size_t robot) {
  while (robots_.size() <= robot) robots_.emplace_back();
  return robots_[robot];
}

void Session::advance(double now_s) {
  now_s_ = now_s;
  const auto robot_now_s = robot_time_s(now_s);
  if (!robot_now_s) return;
  pass_merged(merger_.flush_until(*robot_now_s));
  const double until_s = *robot_now_s - config_.reorder_lag_s - wait_for_ranges_s(*robot_now_s);
  while (!waiting_.empty() && waiting_.front().t_s <= until_s) deliver_first();
  passed_until_s_ = std::max(until_s, passed_until_s_.value_or(until_s));
}

void Session::flush() {
  drop_suspended(/*only_odometry=*/false);
  pass_merged(merger_.flush());
  while (!waiting_.empty()) {
    const double t_s = waiting_.front().t_s;
    passed_until_s_ = std::max(t_s, passed_until_s_.value_or(t_s));
    deliver_first();
  }
}

std::optional<model::OdomPose> Session::odom_pose(double t_s) const noexcept {
  constexpr double kSame_s = 1e-6;
  for (std::size_t i = 0; i < std::min(next_odom_, odoms_.size()); ++i) {
    if (std::abs(odoms_[i].t_s - t_s) < kSame_s) return odoms_[i];
  }
  return std::nullopt;
}

std::optional<TimestampFault> Session::timestamp_fault(double now_s) const {
  const auto& fault = robot_clock_.fault();
  if (!fault || now_s - fault->last_s > kFaultShown_s) return std::nullopt;
  return fault;
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

void Session::take(const model::OdometrySample& odometry, double now_s) {
  const Timestamp timestamp = robot_clock_.judge(odometry.t_s, now_s);
  if (timestamp == Timestamp::kSet) clock_was_set(now_s);
  if (timestamp == Timestamp::kStepped) {
    clock_stepped();
    use_suspended(now_s);
  }
  report_suspect_times();
  const bool fits =
      timestamp == Timestamp::kGood || timestamp == Timestamp::kStepped || timestamp == Timestamp::kSet;
  // A sample that does not fit as the one before did was wrong alone.
  if (fits || robot_clock_.waiting() <= 1) drop_suspended(/*only_odometry=*/!fits);
  if (fits) return use(odometry, now_s);
  const Suspended sample{odometry, timestamp, now_s};
  if (robot_clock_.waiting() > 0 && robot_clock_.waiting() < RobotClock::kStepRun) return suspend(sample);
  drop(sample);
}

void Session::use(const model::OdometrySample& odometry, double now_s) {
  if (last_odometry_s_ && odometry.t_s <= *last_odometry_s_) {
    ++counters_.odometry_out_of_order;
    return;
  }
  dropped_since_s_.reset();
  last_odometry_s_ = odometry.t_s;
  const std::span<const model::OdometrySample> merged = merger_.take(odometry);
  pass_merged(merged);
  report_fast_odometry(now_s);
}

void Session::suspend(const Suspended& sample) {
  if (suspended_.size() == kMaxSuspended) return drop(sample);
  suspended_.push_back(sample);
}

void Session::drop(const Suspended& sample) {
  if (std::holds_alternative<model::OdometrySample>(sample.sample)) {
    if (sample.timestamp == Timestamp::kWrong)
      return drop_odometry(counters_.robot_time_wrong, sample.arrived_s);
    if (sample.timestamp == Timestamp::kEarly)
      return drop_odometry(counters_.robot_time_early, sample.arrived_s);
    return drop_odometry(counters_.odometry_out_of_order, sample.arrived_s);
  }
  if (sample.timestamp == Timestamp::kWrong) ++counters_.robot_time_wrong;
  if (sample.timestamp == Timestamp::kEarly) ++counters_.robot_time_early;
  if (sample.timestamp == Timestamp::kFallenBack) ++counters_.sensors_out_of_order;
}

void Session::use_suspended(double now_s) {
  // A sample that does not fit even now is suspended again.
  const std::size_t count = suspended_.size();
  for (std::size_t i = 0; i < count; ++i) {
    const Suspended one = suspended_[i];
    std::visit(Overloaded{[&](const model::OdometrySample& odometry) { use(odometry, now_s); },
                          [&](const auto& sample) { take(sample, one.arrived_s); }},
               one.sample);
  }
  suspended_.erase(suspended_.begin(), suspended_.begin() + static_cast<std::ptrdiff_t>(count));
}

void Session::drop_suspended(bool only_odometry) {
  const auto ends = [only_odometry](const Suspended& one) {
    return !only_odometry || std::holds_alternative<model::OdometrySample>(one.sample);
  };
  for (const Suspended& one : suspended_) {
    if (ends(one)) drop(one);
  }
  std::erase_if(suspended_, ends);
}

void Session::pass_merged(std::span<const model::OdometrySample> samples) {
  for (const model::OdometrySample& sample : samples) enqueue(sample.t_s, sample);
  counters_.odometry_merged = merger_.merged();
  rate_.passed += samples.size();
}

void Session::report_fast_odometry(double now_s) {
  ++rate_.taken;
  const double period_s = now_s - rate_.since_s;
  if (period_s < kRateOver_s) return;
  const bool fast = static_cast<double>(rate_.passed) < kMergedShare * static_cast<double>(rate_.taken);
  // The first period began before the first sample.
  if (fast && !fast_reported_ && rate_.since_s > 0.0) {
    say(fmt::format("robot: odometry comes at {:.0f} Hz and is merged to at most 200 Hz; send 20 to 200 Hz",
                    static_cast<double>(rate_.taken) / period_s));
    fast_reported_ = true;
  } else if (!fast) {
    fast_reported_ = false;
  }
  rate_ = {.since_s = now_s};
}

// Reports the 1st, 2nd, 4th, 8th ... dropped sample, and once that all are dropped.
void Session::drop_odometry(std::uint64_t& counter, double now_s) {
  ++counter;
  if (!dropped_since_s_) {
    dropped_since_s_ = now_s;
    drop_reported_ = false;
  }
  const auto fault = timestamp_fault(now_s);
  // A repeated sample is dropped without a fault of the clock.
  if (!fault || fault->last_s < now_s) return;
  const std::uint64_t before = timestamps_dropped_++;
  const bool all = odometry_dropped_for_s(now_s) >= kDropReported_s && !drop_reported_;
  if (!all && std::bit_width(before) == std::bit_width(timestamps_dropped_)) return;
  drop_reported_ = drop_reported_ || all;
  const std::string what =
      all ? fmt::format("all odometry was dropped for {:.1f} s", kDropReported_s)
          : fmt::format("odometry samples dropped for their t_s so far: {}", timestamps_dropped_);
  say(fmt::format("robot: {}: {}: {}; {}", what, cause_name(fault->cause), evidence(*fault), remedy(*fault)));
}

Timestamp Session::judge(SensorTimes& times, double t_s, double now_s) {
  const double robot_now_s = *robot_time_s(now_s);
  const double offset_s = t_s - robot_now_s;
  if (offset_s > config_.max_clock_error_s) return Timestamp::kWrong;
  if (offset_s > RobotClock::kSlack_s) return Timestamp::kEarly;
  // As for odometry: a message that falls back is wrong, and so are the following ones that are as late.
  const bool falls_back = times.last_s && t_s <= *times.last_s;
  if (falls_back) times.offset_s = offset_s;
  if (times.offset_s && std::abs(offset_s - *times.offset_s) <= RobotClock::kConsistent_s)
    return Timestamp::kFallenBack;
  times = {.last_s = std::min(t_s, robot_now_s), .offset_s = std::nullopt};
  return Timestamp::kGood;
}

template <typename Sample>
void Session::take_timed(SensorTimes& times, double t_s, const Sample& sample, double now_s) {
  if (!robot_time_s(now_s)) {
    ++counters_.without_odometry;
    return;
  }
  const Timestamp timestamp = judge(times, t_s, now_s);
  if (timestamp == Timestamp::kGood) return enqueue(t_s, sample);
  suspend({sample, timestamp, now_s});
}

void Session::take(const model::SteeringSample& sample, double now_s) {
  if (config_.vehicle) return take(model::to_odometry(sample, *config_.vehicle), now_s);
  if (counters_.steering_unknown++ == 0) {
    say("robot: STEERING is dropped, because the configuration has no 'steering'; give it the vehicle's "
        "wheelbase_m");
  }
}

void Session::take(const model::PoseSample& pose, double now_s) {
  take_timed(pose_times_, pose.t_s, pose, now_s);
}

void Session::take(const InitialPose& initial, double now_s) {
  InitialPose timed = initial;
  if (initial.is_now) timed.pose.t_s = robot_time_s(now_s).value_or(0.0);
  take_timed(initial_times_, timed.pose.t_s, timed, now_s);
}

void Session::take(const model::SensorSample& sample, double now_s) {
  const double t_s = model::time_of(sample);
  // A zero-velocity sample may be of any time.
  SensorTimes any;
  const bool stationary = std::holds_alternative<model::ZeroVelocitySample>(sample);
  take_timed(stationary ? any : sensor_times_.at(sample.index()), t_s, sample, now_s);
}

void Session::take(model::RangeSample range) {
  const auto t_s = robot_time_s(range.t_s);
  if (!t_s) {
    ++counters_.without_odometry;
    return;
  }
  range.t_s = *t_s;
  const double late_s = ranges_late_s(*t_s);
  if (late_s == 0.0 && !range_clock_refused_ && range_clock_.corrected_s(*t_s) != *t_s) {
    range_clock_refused_ = true;
    say(
        fmt::format("the calibration's range_clock is {:.1f} s off by now, and gromad corrects {} s at most; "
                    "calibrate again",
                    *t_s - range_clock_.corrected_s(*t_s), kMaxRangeClock_s));
  }
  enqueue(*t_s - late_s, range);
}

double Session::ranges_late_s(double t_s) const noexcept {
  const double late_s = t_s - range_clock_.corrected_s(t_s);
  return std::abs(late_s) <= kMaxRangeClock_s ? late_s : 0.0;
}

void Session::enqueue(double t_s, const Sample& sample) {
  const double robot_now_s = *robot_time_s(now_s_);
  if (robot_now_s - t_s > config_.max_delay_s + wait_for_ranges_s(robot_now_s)) {
    ++counters_.dropped_late;
    return;
  }
  if (passed_until_s_ && t_s < *passed_until_s_) {
    ++counters_.passed_late;
    deliver(t_s, sample);
    return;
  }
  push_waiting(t_s, sample);
  announce(sample);
  if (waiting_.size() > config_.max_waiting) {
    ++counters_.waiting_overflows;
    const double first_s = waiting_.front().t_s;
    passed_until_s_ = std::max(first_s, passed_until_s_.value_or(first_s));
    deliver_first();
  }
}

void Session::push_waiting(double t_s, const Sample& sample) {
  waiting_.push_back({t_s, serial_++, sample});
  std::push_heap(waiting_.begin(), waiting_.end(), Later());
}

void Session::deliver_first() {
  std::pop_heap(waiting_.begin(), waiting_.end(), Later());
  const Waiting first = waiting_.back();
  waiting_.pop_back();
  deliver(first.t_s, first.sample);
}

void Session::deliver(double t_s, const Sample& sample) {
  std::visit(Overloaded{
                 [&](const model::OdometrySample& odometry) {
                   ++counters_.odometry;
                   for (MeasurementSink* sink : sinks_) sink->on_odometry(odometry);
                 },
                 [&](const model::PoseSample& pose) {
                   ++counters_.pose_priors;
                   for (MeasurementSink* sink : sinks_) sink->on_pose_prior(pose);
                 },
                 [&](const model::RangeSample& range) {
                   ++counters_.ranges;
                   model::RangeSample corrected = range;
                   corrected.t_s = t_s;
                   for (MeasurementSink* sink : sinks_) {
                     sink->on_uncorrected_range(range);
                     sink->on_range(corrected);
                   }
                 },
                 [&](const model::SensorSample& of) {
                   ++counters_.sensors;
                   for (MeasurementSink* sink : sinks_) sink->on_sensor(of);
                 },
                 [&](const InitialPose& initial) {
                   ++counters_.pose_priors;
                   for (MeasurementSink* sink : sinks_) sink->on_initial_pose(initial.pose);
                 },
             },
             sample);
}

void Session::announce(const Sample& sample) {
  if (const auto* odometry = std::get_if<model::OdometrySample>(&sample)) {
    for (MeasurementSink* sink : sinks_) sink->on_odometry_ahead(*odometry);
  } else if (const auto* of = std::get_if<model::SensorSample>(&sample)) {
    for (MeasurementSink* sink : sinks_) sink->on_sensor_ahead(*of);
  }
}

void Session::clock_was_set(double now_s) {
  say(fmt::format("robot: its clock was set, or it restarted (clock-offset: {:.3f} s); starting again",
                  timestamp_fault(now_s).value_or(TimestampFault{}).value));
  forget_times();
  for (MeasurementSink* sink : sinks_) sink->on_clock_set();
}

void Session::clock_stepped() {
  const double step_s = robot_clock_.step_s();
  say(fmt::format("robot: its clock was set {} by {:.3f} s (clock-offset)", step_s > 0.0 ? "forward" : "back",
                  std::abs(step_s)));
  ++counters_.robot_clock_set;
  for (MeasurementSink* sink : sinks_) sink->on_clock_step(step_s, robot_clock_.step_found_late());
  // Waiting samples have times of the old clock. But if the step was found late, those with the robot's own
  // timestamps are of the new clock already.
  const bool found_late = robot_clock_.step_found_late();
  for (const model::OdometrySample& held : merger_.flush()) push_waiting(held.t_s, held);
  merger_.reset();
  for (Waiting& one : waiting_) {
    if (found_late && !std::holds_alternative<model::RangeSample>(one.sample)) continue;
    one.t_s += step_s;
    shift_time(one.sample, step_s);
  }
  std::make_heap(waiting_.begin(), waiting_.end(), Later());
  if (passed_until_s_) *passed_until_s_ += step_s;
  if (last_odometry_s_ && !found_late) *last_odometry_s_ += step_s;
  pose_times_ = {};
  initial_times_ = {};
  sensor_times_ = {};
}

void Session::forget_times() {
  ++counters_.robot_clock_set;
  last_odometry_s_.reset();
  suspended_.clear();
  passed_until_s_.reset();
  waiting_.clear();
  merger_.reset();
  pose_times_ = {};
  initial_times_ = {};
  sensor_times_ = {};
}

void Session::report_suspect_times() {
  const bool suspect = robot_clock_.suspected();
  if (suspect == times_suspect_) return;
  times_suspect_ = suspect;
  if (suspect && robot_clock_.is_late() && now_s_ >= next_late_report_s_) {
    next_late_report_s_ = now_s_ + kLateReported_s;
    say(fmt::format("robot: odometry arrives {:.2f} s late; poses are degraded", robot_clock_.delay_s()));
  }
  for (MeasurementSink* sink : sinks_) sink->on_odometry_times(suspect);
}

void Session::say(std::string_view text) const {
  if (config_.log) config_.log(text);
}

}  // namespace groma::daemon
