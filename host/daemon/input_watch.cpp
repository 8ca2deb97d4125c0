#include "host/daemon/input_watch.hpp"

#include <algorithm>
#include <cmath>

namespace groma::daemon {
namespace {

void smooth(double& value, double newest) noexcept {
  value = std::isnan(value) ? newest : value + InputWatch::kSmoothing * (newest - value);
}

}  // namespace

void InputWatch::on_odometry(const model::OdometrySample& sample) {
  if (last_) {
    const double held_s = std::clamp(sample.t_s - last_->t_s, 0.0, kLongestHold_s);
    driven_m_ += std::hypot(last_->vx_mps, last_->vy_mps) * held_s;
    turned_rad_ += std::abs(last_->omega_radps) * held_s;
  }
  last_ = sample;
}

void InputWatch::on_range(const model::RangeSample& range) {
  newest_s_ = std::max(newest_s_, range.t_s);
  PairStatus* const pair = find(range, true);
  if (pair == nullptr) return;
  const bool was_silent = pair->ranges == 0 || range.t_s - pair->last_s > kShown_s;
  ++pair->ranges;
  pair->last_s = range.t_s;
  if (was_silent) pair->range_m = range.range_m;
  smooth(pair->range_m, range.range_m);
}

void InputWatch::on_clock_set() {
  last_.reset();
  newest_s_ = -std::numeric_limits<double>::infinity();
  for (PairStatus& pair : pairs_) pair.last_s = newest_s_;
}

void InputWatch::note(const model::RangeSample& range, const filter::RangeResult& result) noexcept {
  PairStatus* const pair = find(range, false);
  const bool used = result.outcome == filter::RangeOutcome::kUsed;
  if (pair == nullptr || (!used && result.outcome != filter::RangeOutcome::kGated)) return;
  ++(used ? pair->used : pair->gated);
  smooth(pair->innovation_m2, result.innovation_m * result.innovation_m);
}

std::vector<PairStatus> InputWatch::pairs() const {
  std::vector<PairStatus> out;
  for (const PairStatus& pair : pairs_) {
    if (newest_s_ - pair.last_s <= kShown_s) out.push_back(pair);
  }
  return out;
}

PairStatus* InputWatch::find(const model::RangeSample& range, bool adds) noexcept {
  const std::pair key(range.tag_id, range.anchor_id);
  const auto place = std::lower_bound(
      pairs_.begin(), pairs_.end(), key,
      [](const PairStatus& pair, const auto& of) { return std::pair(pair.tag_id, pair.anchor_id) < of; });
  if (place != pairs_.end() && std::pair(place->tag_id, place->anchor_id) == key) return &*place;
  if (!adds || pairs_.size() == kMaxPairs) return nullptr;
  return &*pairs_.insert(place, {.tag_id = range.tag_id, .anchor_id = range.anchor_id});
}

}  // namespace groma::daemon
