#include "host/filter/gate.hpp"

#include <algorithm>
#include <cmath>

#include "host/model/ablation.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

namespace {

using model::Mechanism;

// Fewer ranges than this within the window say nothing about the state.
constexpr double kMinRangesToDoubt = 4.0;
// A weight below this turns the range away.
constexpr double kNoWeight = 1e-3;
// The median gap between a pair's ranges is followed by this share of itself a range.
constexpr double kGapStep = 0.02;
constexpr double kLongGaps = 0.9;
// Fewer polls than this within the window, and a silence tells nothing.
constexpr double kReceptionPolls = 10.0;

double weight_of(double in_sight) noexcept {
  return in_sight >= kNoWeight ? in_sight : 0.0;
}

}  // namespace

Gate::Gate(const GateConfig& config) : config_(config), hint_(config) {
  reset(0.0);
}

Gate::Pair& Gate::pair(int anchor, int tag) noexcept {
  return pairs_[static_cast<std::size_t>(anchor) * kMaxTags + static_cast<std::size_t>(tag)];
}

double Gate::blocked(int anchor, int tag) const noexcept {
  return pairs_[static_cast<std::size_t>(anchor) * kMaxTags + static_cast<std::size_t>(tag)].blocked;
}

double Gate::regained_variance_m2(int anchor, int tag) const noexcept {
  return pairs_[static_cast<std::size_t>(anchor) * kMaxTags + static_cast<std::size_t>(tag)].regained_m2;
}

Gate::Reception Gate::listen(int anchor, Pair& pair, double t_s) noexcept {
  const double gap_s = std::max(t_s - pair.t_s, 0.0);
  if (pair.heard && gap_s > 0.0) {
    const double step = gap_s > poll_interval_s_ ? kLongGaps * kGapStep : (kLongGaps - 1.0) * kGapStep;
    poll_interval_s_ = poll_interval_s_ > 0.0 ? poll_interval_s_ * (1.0 + step) : gap_s;
  }
  pair.heard = true;
  pair.t_s = t_s;
  pair.reception *= std::exp(-gap_s / config_.reception_s);
  pair.reception = std::min(pair.reception + poll_interval_s_ / config_.reception_s, 1.0);
  if (model::is_ablated(Mechanism::kGateReception)) return {};
  const double polls = poll_interval_s_ > 0.0 ? config_.reception_s / poll_interval_s_ : 0.0;
  if (polls < kReceptionPolls) return {};
  const double expected = 1.0 - config_.reception_slack;
  // All of the anchor's in the window together count as one range.
  double tags = 0.0;
  for (std::size_t tag = 0; tag < kMaxTags; ++tag) {
    const Pair& other = pairs_[static_cast<std::size_t>(anchor) * kMaxTags + tag];
    if (other.heard && t_s - other.t_s < config_.reception_s) tags += 1.0;
  }
  return {.missed = std::max(expected - pair.reception, 0.0) / expected, .alike = polls * tags};
}

double Gate::expect_blocked(int anchor, const Pair& pair, double t_s) const noexcept {
  if (model::is_ablated(Mechanism::kGateMemory)) return config_.blocked_share;
  const auto fade = [&](const Pair& of) { return std::exp(-std::max(t_s - of.t_s, 0.0) / config_.sticky_s); };
  double out = config_.blocked_share + (pair.unhinted - config_.blocked_share) * fade(pair);
  if (model::is_ablated(Mechanism::kGateTags)) return out;
  // What hides an anchor from one tag hides it from the next.
  for (std::size_t tag = 0; tag < kMaxTags; ++tag) {
    const Pair& other = pairs_[static_cast<std::size_t>(anchor) * kMaxTags + tag];
    if (other.unhinted > std::max(out, config_.blocked_share))
      out = std::max(out, other.unhinted * fade(other));
  }
  return out;
}

Gate::Posterior Gate::judge(const RangeDensities& density, double prior) const noexcept {
  const double in_sight = (1.0 - prior) * (1.0 - density.garbage_share) * density.in_sight;
  const double blocked = prior * (1.0 - density.garbage_share) * density.blocked;
  const double total = in_sight + blocked + density.garbage;
  // Nothing explains it: nothing is learnt from it.
  if (!(total > 0.0)) return {.pair_blocked = prior};
  return {.in_sight = in_sight / total,
          .blocked = blocked / total,
          .far = prior * (1.0 - density.garbage_share) * density.far / total,
          .pair_blocked = std::min((blocked + density.garbage * prior) / total, config_.blocked_most)};
}

double Gate::weigh(int anchor, int tag, double t_s, double innovation_m, double variance_m2,
                   model::PowerClass hint) noexcept {
  if (!std::isfinite(innovation_m) || !std::isfinite(variance_m2) || !(variance_m2 > 0.0)) return 0.0;
  const double sigma = std::sqrt(variance_m2);
  Pair& chain = pair(anchor, tag);

  const double gap_s = std::max(t_s - chain.t_s, 0.0);
  double prior = expect_blocked(anchor, chain, t_s);
  const Reception reception = listen(anchor, chain, t_s);
  prior += std::max(config_.regained_share - prior, 0.0) * reception.missed;
  const RangeDensities density = range_densities(innovation_m, sigma, config_, reception.missed);

  // What powers tell makes neither itself nor a doubt of the state.
  const Posterior unhinted = judge(density, prior);
  const double weight = weight_of(unhinted.in_sight);
  chain.regained_m2 = 0.0;
  if (reception.missed > 0.0) {
    const double garbage = 1.0 - unhinted.in_sight - unhinted.blocked;
    chain.regained_m2 =
        reception.alike * (unhinted.far * excess_square(innovation_m, sigma, config_.regained_m) +
                           garbage * model::square(innovation_m));
  }
  chain.unhinted = unhinted.pair_blocked;
  chain.blocked = unhinted.pair_blocked;
  observe(anchor, t_s, innovation_m, weight);
  if (hint == model::kNoPowerClass || !(config_.hint_most > 1.0)) return weight;
  if (model::is_ablated(Mechanism::kGatePowers)) return weight;

  const double ratio = hint_.likelihood_ratio(hint);
  if (!doubts_) {
    const double share = std::min(gap_s / config_.hint_s, 1.0);
    hint_.learn(hint, t_s, share * unhinted.blocked, share * unhinted.in_sight);
  }
  const auto with_hint = [ratio](double share) { return share * ratio / (share * ratio + 1.0 - share); };
  // The innovations that made the chain so sure hang together, too.
  const double known = std::min(std::max(prior, hint_.blocked_share()), config_.blocked_most);
  const Posterior hinted = judge(density, with_hint(known));
  chain.blocked = hinted.pair_blocked;
  // And so do those of one class that fit: where most are blocked the state follows them.
  const double trust = 1.0 - with_hint(hint_.blocked_share());
  return weight_of(hinted.in_sight * trust * trust);
}

void Gate::Tally::fade(double until_s, double window_s) noexcept {
  const double fade = std::exp(-std::max(until_s - t_s, 0.0) / window_s);
  t_s = until_s;
  seen *= fade;
  refused *= fade;
  refused_m *= fade;
}

void Gate::Tally::add(double innovation_m, double weight) noexcept {
  seen += 1.0;
  refused += 1.0 - weight;
  refused_m += (1.0 - weight) * std::abs(innovation_m);
}

bool Gate::Tally::refuses(double share) const noexcept {
  return seen >= kMinRangesToDoubt && refused > share * seen;
}

void Gate::observe(int anchor, double t_s, double innovation_m, double weight) noexcept {
  // Garbage is off by anything; what lasts is not.
  const double off_m = std::clamp(innovation_m, -config_.garbage_width_m, config_.garbage_width_m);
  Tally& own = anchors_[static_cast<std::size_t>(anchor)];
  own.fade(t_s, config_.window_s);
  own.add(off_m, weight);
  all_.fade(t_s, config_.patience_s);
  all_.add(off_m, weight);
  t_s_ = t_s;
  const bool before = doubts_;
  const bool lasts = all_.refuses(config_.doubt_share) && !model::is_ablated(Mechanism::kDivergenceLasting);
  doubts_ = (lasts || anchors_refuse(t_s)) && !model::is_ablated(Mechanism::kDivergence);
  if (doubts_ && !before) ++doubts_begun_;
}

bool Gate::anchors_refuse(double t_s) const noexcept {
  int agreeing = 0;
  int refusing = 0;
  for (const Tally& anchor : anchors_) {
    if (anchor.seen < kMinRangesToDoubt || t_s - anchor.t_s > config_.window_s) continue;
    if (!anchor.refuses(config_.doubt_share)) {
      ++agreeing;
    } else if (anchor.refused_m > config_.far_m * anchor.refused) {
      ++refusing;
    }
  }
  // One alone may have any reason.
  return refusing >= 2 && refusing >= agreeing && agreeing < config_.fixing_anchors;
}

bool Gate::doubts(double t_s) const noexcept {
  return doubts_ && t_s - t_s_ < config_.window_s;
}

void Gate::renew(int anchor, double t_s) noexcept {
  for (int tag = 0; tag < kMaxTags; ++tag) {
    pair(anchor, tag) = {
        .t_s = t_s, .blocked = config_.blocked_share, .unhinted = config_.blocked_share, .reception = 0.0};
  }
  anchors_[static_cast<std::size_t>(anchor)] = {.t_s = t_s};
}

void Gate::reset(double t_s) noexcept {
  pairs_.fill({.t_s = t_s, .blocked = config_.blocked_share, .unhinted = config_.blocked_share});
  t_s_ = t_s;
  all_ = {.t_s = t_s};
  anchors_.fill({.t_s = t_s});
  doubts_ = false;
}

}  // namespace groma::filter
