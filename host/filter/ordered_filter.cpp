#include "host/filter/ordered_filter.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <limits>
#include <type_traits>
#include <utility>

#include "host/model/plausible.hpp"

namespace groma::filter {

namespace {

using model::OdometrySample;
using model::RangeSample;

constexpr double kNothingYet_s = -std::numeric_limits<double>::infinity();
// Checkpoints within the window. By hand: half of kMaxCheckpoints. The result does not depend on it.
constexpr double kPerWindow = 4.0;
// Maximum number of inputs between checkpoints, which bounds how many a late input makes replay. By hand: so
// that kMaxCheckpoints cover all inputs.
constexpr std::uint64_t kMostAgain = OrderedFilter::kMaxInputs / 8;

// Sort key of inputs of one kind: sensor, time, values.
using Key = std::pair<std::size_t, SampleKey>;
Key key_of(const Start& s) noexcept {
  return {0, {s.t_s, s.pose.x_m, s.pose.y_m, s.pose.theta_rad}};
}
Key key_of(const OdometrySample& s) noexcept {
  return {0, {s.t_s, s.vx_mps, s.vy_mps, s.omega_radps}};
}
Key key_of(const RangeSample& s) noexcept {
  return {0, {s.t_s, static_cast<double>(s.tag_id), static_cast<double>(s.anchor_id), s.range_m}};
}
Key key_of(const model::SensorSample& s) noexcept {
  return {s.index(), model::visit(s, [](const auto& of) { return filter::key_of(of); })};
}

template <class Input>
double time_of(const Input& input) noexcept {
  return model::visit(input, [](const auto& held) { return key_of(held).second[0]; });
}

template <class Input>
bool is_finite(const Input& input) noexcept {
  const SampleKey key = model::visit(input, [](const auto& held) { return key_of(held).second; });
  return std::all_of(key.begin(), key.end(), [](double value) { return std::isfinite(value); });
}

// Order by time, kind, sensor and values.
template <class Input>
bool is_before(const Input& a, const Input& b) noexcept {
  const double a_s = time_of(a);
  const double b_s = time_of(b);
  if (a_s != b_s) return a_s < b_s;
  if (a.index() != b.index()) return a.index() < b.index();
  const auto key = [](const auto& held) { return key_of(held); };
  return model::visit(a, key) < model::visit(b, key);
}

}  // namespace

OrderedFilter::OrderedFilter(model::Surface surface, std::span<const model::Tag> tags,
                             const model::Calibration& calibration, const Config& config, double window_s)
    : filter_(std::move(surface), tags, calibration, config),
      window_s_(window_s),
      checkpoints_(kMaxCheckpoints, {.filter = filter_.snapshot()}),
      newest_s_(kNothingYet_s) {
  inputs_.reserve(kMaxInputs);
  check_in(0, kNothingYet_s);
}

bool OrderedFilter::start(const Start& start) noexcept {
  const bool plausible = model::is_plausible(model::PoseSample{
      .t_s = start.t_s, .x_m = start.pose.x_m, .y_m = start.pose.y_m, .yaw_rad = start.pose.theta_rad});
  return plausible && insert(start).taken;
}

void OrderedFilter::resume(const OrderedFilter& other) noexcept {
  filter_.resume(other.filter_);
  begin(other.newest_s_);
}

void OrderedFilter::stop() noexcept {
  filter_.stop();
  begin(kNothingYet_s);
}

void OrderedFilter::begin(double newest_s) noexcept {
  inputs_.clear();
  first_ = 0;
  checkpoint_count_ = 0;
  newest_s_ = newest_s;
  late_sample_.reset();
  check_in(0, newest_s);
}

OdometryOutcome OrderedFilter::process(const OdometrySample& sample) noexcept {
  const Outcome outcome = insert(sample);
  if (!outcome.taken) ++refused_.odometry[outcome.odometry];
  return outcome.odometry;
}

RangeResult OrderedFilter::process(const RangeSample& range) noexcept {
  const Outcome outcome = insert(range);
  if (!outcome.taken) ++refused_.ranges[outcome.range.outcome];
  return outcome.range;
}

SensorResult OrderedFilter::process(const model::SensorSample& sample) noexcept {
  const Outcome outcome = insert(sample);
  if (!outcome.taken) ++refused_.sensors[sample.index()][outcome.sensor.outcome];
  return outcome.sensor;
}

Counters OrderedFilter::counters() const noexcept {
  Counters sum = filter_.counters();
  sum.odometry += refused_.odometry;
  sum.ranges += refused_.ranges;
  for (std::size_t i = 0; i < model::kSensors; ++i) sum.sensors[i] += refused_.sensors[i];
  return sum;
}

OrderedFilter::Outcome OrderedFilter::insert(const Input& input) noexcept {
  // Values that are not finite cannot be ordered.
  if (!is_finite(input)) {
    return {.odometry = OdometryOutcome::kBadValue,
            .range = {.outcome = RangeOutcome::kBadValue},
            .sensor = {.outcome = SensorOutcome::kBadValue}};
  }
  const double t_s = time_of(input);
  if (t_s < newest_s_ - window_s_) return {};
  if (inputs_.size() == kMaxInputs) {
    // The buffer is full: drop half of it.
    check_in(first_ + inputs_.size(), newest_s_);
    while (checkpoint_count_ > 1 && checkpoint(0).next < first_ + kMaxInputs / 2) drop_checkpoint();
    forget();
  }
  const auto place = std::upper_bound(inputs_.begin(), inputs_.end(), input, is_before<Input>);
  const std::uint64_t number = first_ + static_cast<std::uint64_t>(std::distance(inputs_.begin(), place));
  // Drop checkpoints with too many exchanges of anchors since.
  while (checkpoint_count_ > 1 && !filter_.can_restore(checkpoint(0).filter)) drop_checkpoint();
  if (number < checkpoint(0).next) return {};
  const bool last = place == inputs_.end();
  if (!last && !filter_.can_restore(checkpoint(0).filter)) return {};
  inputs_.insert(place, input);
  newest_s_ = std::max(newest_s_, t_s);

  Outcome outcome;
  const bool is_row = std::holds_alternative<OdometrySample>(input);
  if (is_row) late_sample_.reset();
  if (last) {
    check_in_when_due(number, t_s);
    outcome = apply(input);
  } else {
    ++reordered_;
    while (checkpoint(checkpoint_count_ - 1).next > number) --checkpoint_count_;
    const Checkpoint& from = checkpoint(checkpoint_count_ - 1);
    filter_.restore(from.filter);
    for (std::uint64_t i = from.next; i < first_ + inputs_.size(); ++i) {
      const Input& again = inputs_[static_cast<std::size_t>(i - first_)];
      check_in_when_due(i, time_of(again));
      const Outcome now = apply(again);
      if (i != number) continue;
      outcome = now;
      if (is_row) late_sample_ = filter_.estimate();
    }
  }
  outcome.taken = true;
  while (checkpoint_count_ > 1 && checkpoint(1).t_s < newest_s_ - window_s_) drop_checkpoint();
  if (inputs_.size() > kMaxInputs / 2) forget();
  return outcome;
}

OrderedFilter::Outcome OrderedFilter::apply(const Input& input) noexcept {
  Outcome outcome;
  model::visit(input, [&](const auto& held) {
    using Held = std::decay_t<decltype(held)>;
    if constexpr (std::is_same_v<Held, Start>) {
      filter_.start(held);
    } else if constexpr (std::is_same_v<Held, OdometrySample>) {
      outcome.odometry = filter_.process(held);
    } else if constexpr (std::is_same_v<Held, RangeSample>) {
      outcome.range = filter_.process(held);
    } else {
      outcome.sensor = filter_.process(held);
    }
  });
  return outcome;
}

void OrderedFilter::check_in_when_due(std::uint64_t next, double t_s) noexcept {
  const Checkpoint& last = checkpoint(checkpoint_count_ - 1);
  if (t_s - last.t_s > window_s_ / kPerWindow || next - last.next >= kMostAgain) check_in(next, t_s);
}

// Adds a checkpoint of the current filter, before input number `next` at t_s. If the ring is full, drops the
// oldest one.
void OrderedFilter::check_in(std::uint64_t next, double t_s) noexcept {
  if (checkpoint_count_ == kMaxCheckpoints) drop_checkpoint();
  Checkpoint& at = checkpoint(checkpoint_count_++);
  at.filter = filter_.snapshot();
  at.next = next;
  at.t_s = t_s;
}

void OrderedFilter::drop_checkpoint() noexcept {
  first_checkpoint_ = (first_checkpoint_ + 1) % kMaxCheckpoints;
  --checkpoint_count_;
}

// Drops the inputs before the first checkpoint.
void OrderedFilter::forget() noexcept {
  const std::uint64_t first = checkpoint(0).next;
  inputs_.erase(inputs_.begin(), inputs_.begin() + static_cast<std::ptrdiff_t>(first - first_));
  first_ = first;
}

}  // namespace groma::filter
