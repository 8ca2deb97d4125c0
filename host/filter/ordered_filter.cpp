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
// Checkpoints within the window.
constexpr double kPerWindow = 4.0;
// Inputs from one checkpoint to the next at most: so many are taken again for one that comes late.
constexpr std::uint64_t kMostAgain = OrderedFilter::kMaxInputs / 8;

// std::visit for functions that must not throw.
template <std::size_t kAt = 0, class Input, class Use>
auto visit(const Input& input, const Use& use) noexcept {
  if constexpr (kAt + 1 < std::variant_size_v<Input>) {
    if (input.index() != kAt) return visit<kAt + 1>(input, use);
  }
  return use(*std::get_if<kAt>(&input));
}

// What inputs of one kind are sorted by: time, and what else they say.
using Values = std::array<double, 4>;
struct ValuesOf {
  Values operator()(const Start& s) const { return {s.t_s, s.pose.x_m, s.pose.y_m, s.pose.theta_rad}; }
  Values operator()(const OdometrySample& s) const { return {s.t_s, s.vx_mps, s.vy_mps, s.omega_radps}; }
  Values operator()(const RangeSample& s) const {
    return {s.t_s, static_cast<double>(s.tag_id), static_cast<double>(s.anchor_id), s.range_m};
  }
  Values operator()(const model::YawRateSample& s) const { return {s.t_s, s.omega_radps}; }
  Values operator()(const model::PositionSample& s) const {
    return {s.t_s, s.x_m, s.y_m, s.covariance_m2[0]};
  }
  Values operator()(const model::PoseSample& s) const { return {s.t_s, s.x_m, s.y_m, s.yaw_rad}; }
  Values operator()(const model::ZeroVelocitySample& s) const { return {s.t_s}; }
};

// By time, kind, and what else they say.
template <class Input>
bool is_before(const Input& a, const Input& b) noexcept {
  const Values of_a = visit(a, ValuesOf());
  const Values of_b = visit(b, ValuesOf());
  if (of_a[0] != of_b[0]) return of_a[0] < of_b[0];
  return a.index() != b.index() ? a.index() < b.index() : of_a < of_b;
}

template <class Input>
double time_of(const Input& input) noexcept {
  return visit(input, [](const auto& held) { return held.t_s; });
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
  late_row_.reset();
  check_in(0, newest_s);
}

OdometryOutcome OrderedFilter::process(const OdometrySample& row) noexcept {
  // What is not a number has no place in any order.
  if (!model::is_finite(row)) {
    ++refused_.odometry[OdometryOutcome::kBadValue];
    return OdometryOutcome::kBadValue;
  }
  const Outcome outcome = insert(row);
  if (!outcome.taken) ++refused_.odometry[OdometryOutcome::kOutOfOrder];
  return outcome.odometry;
}

RangeResult OrderedFilter::process(const RangeSample& range) noexcept {
  if (!std::isfinite(range.t_s + range.range_m)) {
    ++refused_.ranges[RangeOutcome::kBadValue];
    return {.outcome = RangeOutcome::kBadValue};
  }
  const Outcome outcome = insert(range);
  if (!outcome.taken) ++refused_.ranges[RangeOutcome::kOutOfOrder];
  return outcome.range;
}

SensorResult OrderedFilter::process(Sensor sensor, const Input& sample) noexcept {
  auto& refused = refused_.sensors[static_cast<std::size_t>(sensor)];
  const Values values = visit(sample, ValuesOf());
  if (!std::all_of(values.begin(), values.end(), [](double value) { return std::isfinite(value); })) {
    ++refused[SensorOutcome::kBadValue];
    return {.outcome = SensorOutcome::kBadValue};
  }
  const Outcome outcome = insert(sample);
  if (!outcome.taken) ++refused[SensorOutcome::kOutOfOrder];
  return outcome.sensor;
}

Counters OrderedFilter::counters() const noexcept {
  Counters sum = filter_.counters();
  sum.odometry += refused_.odometry;
  sum.ranges += refused_.ranges;
  for (std::size_t i = 0; i < kSensors; ++i) sum.sensors[i] += refused_.sensors[i];
  return sum;
}

OrderedFilter::Outcome OrderedFilter::insert(const Input& input) noexcept {
  const double t_s = time_of(input);
  if (t_s < newest_s_ - window_s_) return {};
  if (inputs_.size() == kMaxInputs) {
    // Too many for the window: half of it goes.
    check_in(first_ + inputs_.size(), newest_s_);
    while (checkpoint_count_ > 1 && checkpoint(0).next < first_ + kMaxInputs / 2) drop_checkpoint();
    forget();
  }
  const auto place = std::upper_bound(inputs_.begin(), inputs_.end(), input, is_before<Input>);
  const std::uint64_t number = first_ + static_cast<std::uint64_t>(std::distance(inputs_.begin(), place));
  // Anchors came and went too often to go back that far.
  while (checkpoint_count_ > 1 && !filter_.can_restore(checkpoint(0).filter)) drop_checkpoint();
  if (number < checkpoint(0).next) return {};
  const bool last = place == inputs_.end();
  if (!last && !filter_.can_restore(checkpoint(0).filter)) return {};
  inputs_.insert(place, input);
  newest_s_ = std::max(newest_s_, t_s);

  Outcome outcome;
  const bool is_row = std::holds_alternative<OdometrySample>(input);
  if (is_row) late_row_.reset();
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
      if (is_row) late_row_ = filter_.estimate();
    }
  }
  outcome.taken = true;
  while (checkpoint_count_ > 1 && checkpoint(1).t_s < newest_s_ - window_s_) drop_checkpoint();
  if (inputs_.size() > kMaxInputs / 2) forget();
  return outcome;
}

OrderedFilter::Outcome OrderedFilter::apply(const Input& input) noexcept {
  Outcome outcome;
  visit(input, [&](const auto& held) {
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

// The filter as it is now, before the input of number `next`, which is of t_s. Where the ring is full the
// oldest goes.
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

// Inputs before the first checkpoint.
void OrderedFilter::forget() noexcept {
  const std::uint64_t first = checkpoint(0).next;
  inputs_.erase(inputs_.begin(), inputs_.begin() + static_cast<std::ptrdiff_t>(first - first_));
  first_ = first;
}

}  // namespace groma::filter
