#include "host/filter/gate.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "host/model/ablation.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

namespace {

using model::Mechanism;
using model::square;

// "By hand" is explained in config.hpp.
//
// With fewer ranges than this within the window, the divergence test is undecided. By hand: with a window of
// 1 s an anchor counts from 3.5 ranges/s on.
constexpr double kMinRangesOfDivergence = 4.0;
// A weight below this rejects the range. Numerics: its correction would be 1/1000 of a full one.
constexpr double kNoWeight = 1e-3;
// poll_interval_s_ tracks the kLongGaps quantile of the gaps between a pair's ranges in steps of this share.
// Both by hand. The quantile is one poll if at most 1 - kLongGaps of the polls are missed.
constexpr double kGapStep = 0.02;
constexpr double kLongGaps = 0.9;
// With fewer polls than this within kReception_s, missed polls carry no information. By hand; statistics: a
// share of 0.8 of 10 polls, with exponential forgetting, has a sigma of 0.09.
constexpr double kReceptionPolls = 10.0;
// A pair that misses more than this share of its polls, over kReception_s, is likely NLOS: see GateConfig.
// Six recorded campus runs (docs/explanation/filter.md) and the simulated Reception.* hold with these four.
constexpr double kReception_s = 2.0;  // as sticky_s: at 1 m/s an obstacle of 2 m hides an anchor for so long
// Without an obstacle: a range needs four frames (docs/explanation/ranging.md), and 0.95^4 = 0.81.
constexpr double kReceptionSlack = 0.2;
// Mean excess of a pair that misses polls. Geometry: what is left is a reflection; one at a wall 4 m beside a
// path of 10 m is sqrt(10^2 + 8^2) - 10 = 2.8 m too long. Recorded: 2.4 to 3.2 m.
constexpr double kRegained_m = 3.0;
// From this share of missed polls on, all NLOS has it. By hand: a receiver that misses half of the polls has
// lost the direct path.
constexpr double kFarMissed = 0.5;
// Divergence is suspected in two cases. Either at least two anchors, and no fewer than agree, each refuse
// more than kDivergenceShare of their ranges within window_s, by more than kFar_m on average (twice the mean
// NLOS excess excess_m), and fewer than kFixingAnchors agree, too few to fix a position with redundancy. Or
// all anchors together refuse more than kDivergenceShare of the ranges since a start: then the start is
// wrong. Once they have agreed for kPatience_s, refused ranges are a matter of sight, not of the start.
constexpr double kDivergenceShare = 0.7;  // by hand; Gate.SuspectsDivergence*
// By hand. The recorded mcd day_05 starts 0.6 m off, at a sigma of 0.1 m; the second case finds that in 3 s,
// and saves 0.05 m of mean error over that run. Without the bound on it, racks cost 0.03 m.
constexpr double kPatience_s = 5.0;
constexpr double kFar_m = 1.0;            // 2 excess_m: statistics, 14 % of exponential excesses are larger
constexpr int kFixingAnchors = 3;         // geometry: two ranges fix x and y, a third checks them
constexpr double kExponentialTail = 8.0;  // numerics: Phi(-8) = 6e-16, near the rounding error of a double
constexpr double kMaxUnit = 1e6;          // numerics: far from overflow; the counts are rescaled then

// Density of a Gaussian, 1/m.
double gaussian_density(double error_m, double sigma_m) noexcept {
  const double e = error_m / sigma_m;
  return std::exp(-0.5 * e * e) / (sigma_m * std::sqrt(2.0 * std::numbers::pi));
}

// Density of a Gaussian plus an exponential excess of that mean, 1/m.
double excess_density(double error_m, double sigma_m, double mean_m) noexcept {
  const double ratio = sigma_m / mean_m;
  // For a wide sigma this is the product of a huge (e^32 from here on) and a tiny factor; the limit is the
  // Gaussian.
  if (ratio > 8.0) return gaussian_density(error_m, sigma_m);
  const double below = 0.5 * std::erfc((ratio - error_m / sigma_m) * std::numbers::sqrt2 / 2.0);
  if (!(below > 0.0)) return 0.0;
  return std::exp(0.5 * ratio * ratio - error_m / mean_m) * below / mean_m;
}

// Probability densities of a range error, 1/m. los and nlos: LOS and NLOS, given that the range is no
// garbage.
struct RangeDensities {
  double los = 0.0;
  double nlos = 0.0;
  double far = 0.0;      // part of nlos: larger excess of a pair that misses polls
  double garbage = 0.0;  // already times garbage_share
  double garbage_share = 0.0;
};

// missed: share of the pair's recent polls without an answer.
RangeDensities range_densities(double error_m, double sigma_m, const GateConfig& config,
                               double missed) noexcept {
  const double far_share = std::min(missed / kFarMissed, 1.0);
  const double garbage_share = config.garbage_share + config.regained_garbage * missed;
  const double near = excess_density(error_m, sigma_m, config.excess_m);
  const double far = far_share > 0.0 ? far_share * excess_density(error_m, sigma_m, kRegained_m) : 0.0;
  return {.los = gaussian_density(error_m, sigma_m),
          .nlos = (1.0 - far_share) * near + far,
          .far = far,
          .garbage = garbage_share / config.garbage_width_m,
          .garbage_share = garbage_share};
}

// Posterior of one range.
struct Posterior {
  double los = 0.0;
  double nlos = 0.0;       // the rest to 1 is garbage
  double far = 0.0;        // part of nlos with the larger excess
  double pair_nlos = 0.0;  // NLOS probability of the pair after this range
};

// prior: NLOS probability of the pair before the range; nlos_max: upper bound of that after it.
Posterior judge(const RangeDensities& density, double prior, double nlos_max) noexcept {
  const double los = (1.0 - prior) * (1.0 - density.garbage_share) * density.los;
  const double nlos = prior * (1.0 - density.garbage_share) * density.nlos;
  const double total = los + nlos + density.garbage;
  // No hypothesis explains the range: the pair's probability stays.
  if (!(total > 0.0)) return {.pair_nlos = prior};
  return {.los = los / total,
          .nlos = nlos / total,
          .far = prior * (1.0 - density.garbage_share) * density.far / total,
          .pair_nlos = std::min((nlos + density.garbage * prior) / total, nlos_max)};
}

double weight_of(double los) noexcept {
  return los >= kNoWeight ? los : 0.0;
}

}  // namespace

double excess_square(double error_m, double sigma_m, double mean_m) noexcept {
  // Given the error, the excess is a Gaussian truncated to positive values.
  const double sigmas = error_m / sigma_m - sigma_m / mean_m;
  // Far in the tail the truncated Gaussian is nearly exponential.
  if (sigmas < -kExponentialTail) return 2.0 * square(sigma_m / sigmas);
  const double below = 0.5 * std::erfc(-sigmas * std::numbers::sqrt2 / 2.0);
  const double at_zero = gaussian_density(sigmas, 1.0) / below;
  return std::max(square(sigma_m) * (1.0 + sigmas * (sigmas + at_zero)), 0.0);
}

double PowerHint::share(const Counts& counts, const std::array<double, model::kHiddenClasses>& believed,
                        model::PowerClass of) const noexcept {
  const double before = believed[model::hidden_class(of)] / static_cast<double>(model::kStrengthClasses);
  const double prior = config_.hint_prior_count * unit_;
  return (counts.of[of] + prior * before) / (counts.all + prior);
}

double PowerHint::likelihood_ratio(model::PowerClass of) const noexcept {
  if (of >= model::kNoPowerClass) return 1.0;
  const double ratio = share(nlos_, model::kPriorNlos, of) / share(los_, model::kPriorLos, of);
  const double most = std::max(config_.hint_most, 1.0);
  return std::clamp(ratio, 1.0 / most, most);
}

double PowerHint::nlos_share() const noexcept {
  const double prior = config_.hint_prior_count * unit_;
  return (nlos_.all + prior * config_.nlos_prior) / (nlos_.all + los_.all + prior);
}

void PowerHint::observe(model::PowerClass of, double t_s, double nlos, double los) noexcept {
  if (of >= model::kNoPowerClass) return;
  const double passed_s = std::clamp(t_s - t_s_, 0.0, config_.hint_memory_s);
  unit_ *= std::exp(passed_s / config_.hint_memory_s);
  t_s_ = t_s;
  nlos_.of[of] += nlos * unit_;
  nlos_.all += nlos * unit_;
  los_.of[of] += los * unit_;
  los_.all += los * unit_;
  if (unit_ < kMaxUnit) return;
  for (Counts* counts : {&nlos_, &los_}) {
    for (double& count : counts->of) count /= unit_;
    counts->all /= unit_;
  }
  unit_ = 1.0;
}

Gate::Gate(const GateConfig& config) : config_(config), hint_(config) {
  reset(0.0);
}

Gate::Reception Gate::update_reception(int anchor, Pair& pair, double t_s) noexcept {
  const double gap_s = std::max(t_s - pair.t_s, 0.0);
  if (pair.heard && gap_s > 0.0) {
    const double step = gap_s > poll_interval_s_ ? kLongGaps * kGapStep : (kLongGaps - 1.0) * kGapStep;
    poll_interval_s_ = poll_interval_s_ > 0.0 ? poll_interval_s_ * (1.0 + step) : gap_s;
  }
  pair.heard = true;
  pair.t_s = t_s;
  pair.reception *= std::exp(-gap_s / kReception_s);
  pair.reception = std::min(pair.reception + poll_interval_s_ / kReception_s, 1.0);
  if (model::is_ablated(Mechanism::kGateReception)) return {};
  const double polls = poll_interval_s_ > 0.0 ? kReception_s / poll_interval_s_ : 0.0;
  if (polls < kReceptionPolls) return {};
  const double expected = 1.0 - kReceptionSlack;
  // All ranges of the anchor within the window together count as one.
  double tags = 0.0;
  for (int tag = 0; tag < kMaxTags; ++tag) {
    const Pair& other = pairs_[pair_at(anchor, tag)];
    if (other.heard && t_s - other.t_s < kReception_s) tags += 1.0;
  }
  return {.missed = std::max(expected - pair.reception, 0.0) / expected, .alike = polls * tags};
}

double Gate::prior_nlos(int anchor, const Pair& pair, double t_s) const noexcept {
  if (model::is_ablated(Mechanism::kGateMemory)) return config_.nlos_prior;
  const auto fade = [&](const Pair& of) { return fading(of.t_s, t_s, config_.sticky_s); };
  double out = config_.nlos_prior + (pair.unhinted - config_.nlos_prior) * fade(pair);
  if (model::is_ablated(Mechanism::kGateTags)) return out;
  // An obstacle that makes an anchor NLOS for one tag often does so for the other tags.
  for (int tag = 0; tag < kMaxTags; ++tag) {
    const Pair& other = pairs_[pair_at(anchor, tag)];
    if (other.unhinted > std::max(out, config_.nlos_prior)) out = std::max(out, other.unhinted * fade(other));
  }
  return out;
}

double Gate::weigh(int anchor, int tag, double t_s, double innovation_m, double variance_m2,
                   model::PowerClass hint) noexcept {
  if (!std::isfinite(innovation_m) || !std::isfinite(variance_m2) || !(variance_m2 > 0.0)) return 0.0;
  const double sigma = std::sqrt(variance_m2);
  Pair& chain = pairs_[pair_at(anchor, tag)];

  const double gap_s = std::max(t_s - chain.t_s, 0.0);
  double prior = prior_nlos(anchor, chain, t_s);
  const Reception reception = update_reception(anchor, chain, t_s);
  prior += std::max(config_.regained_share - prior, 0.0) * reception.missed;
  const RangeDensities density = range_densities(innovation_m, sigma, config_, reception.missed);

  // The power hint must not feed back into itself or into the divergence test: these use innovations only.
  const Posterior unhinted = judge(density, prior, config_.nlos_max);
  const double weight = weight_of(unhinted.los);
  chain.regained_m2 = 0.0;
  if (reception.missed > 0.0) {
    const double garbage = 1.0 - unhinted.los - unhinted.nlos;
    chain.regained_m2 = reception.alike * (unhinted.far * excess_square(innovation_m, sigma, kRegained_m) +
                                           garbage * square(innovation_m));
  }
  chain.unhinted = unhinted.pair_nlos;
  chain.nlos = unhinted.pair_nlos;
  observe(anchor, t_s, innovation_m, weight);
  if (hint == model::kNoPowerClass || !(config_.hint_most > 1.0)) return weight;
  if (model::is_ablated(Mechanism::kGatePowers)) return weight;

  const double ratio = hint_.likelihood_ratio(hint);
  if (!suspects_divergence_) {
    const double share = std::min(gap_s / config_.hint_s, 1.0);
    hint_.observe(hint, t_s, share * unhinted.nlos, share * unhinted.los);
  }
  const auto with_hint = [ratio](double share) { return share * ratio / (share * ratio + 1.0 - share); };
  // Innovations of a pair are correlated, so `prior` is overconfident: bound it by the share on site.
  const double known = std::min(std::max(prior, hint_.nlos_share()), config_.nlos_max);
  const Posterior hinted = judge(density, with_hint(known), config_.nlos_max);
  chain.nlos = hinted.pair_nlos;
  // Small innovations of a mostly NLOS class are correlated, too: the state may have followed them.
  const double trust = 1.0 - with_hint(hint_.nlos_share());
  return weight_of(hinted.los * trust * trust);
}

void Gate::Tally::add(double at_s, double window_s, double innovation_m, double weight) noexcept {
  const double fade = fading(t_s, at_s, window_s);
  t_s = at_s;
  seen = seen * fade + 1.0;
  refused = refused * fade + (1.0 - weight);
  refused_m = refused_m * fade + (1.0 - weight) * std::abs(innovation_m);
}

bool Gate::Tally::refuses() const noexcept {
  return seen >= kMinRangesOfDivergence && refused > kDivergenceShare * seen;
}

void Gate::observe(int anchor, double t_s, double innovation_m, double weight) noexcept {
  // Bounds the influence of a single garbage range.
  const double off_m = std::clamp(innovation_m, -config_.garbage_width_m, config_.garbage_width_m);
  anchors_[static_cast<std::size_t>(anchor)].add(t_s, config_.window_s, off_m, weight);
  all_.add(t_s, kPatience_s, off_m, weight);
  t_s_ = t_s;
  const bool before = suspects_divergence_;
  start_fits_ = start_fits_ || (t_s - began_s_ > kPatience_s && !all_.refuses());
  const bool start_is_wrong =
      !start_fits_ && all_.refuses() && !model::is_ablated(Mechanism::kDivergenceStart);
  suspects_divergence_ =
      (start_is_wrong || anchors_refuse(t_s)) && !model::is_ablated(Mechanism::kDivergence);
  if (suspects_divergence_ && !before) ++divergences_;
}

bool Gate::anchors_refuse(double t_s) const noexcept {
  int agreeing = 0;
  int refusing = 0;
  for (const Tally& anchor : anchors_) {
    if (anchor.seen < kMinRangesOfDivergence || t_s - anchor.t_s > config_.window_s) continue;
    if (!anchor.refuses()) {
      ++agreeing;
    } else if (anchor.refused_m > kFar_m * anchor.refused) {
      ++refusing;
    }
  }
  // One refusing anchor alone is no evidence of divergence.
  return refusing >= 2 && refusing >= agreeing && agreeing < kFixingAnchors;
}

bool Gate::suspects_divergence(double t_s) const noexcept {
  return suspects_divergence_ && t_s - t_s_ < config_.window_s;
}

void Gate::renew(int anchor, double t_s) noexcept {
  for (int tag = 0; tag < kMaxTags; ++tag) {
    pairs_[pair_at(anchor, tag)] = {
        .t_s = t_s, .nlos = config_.nlos_prior, .unhinted = config_.nlos_prior, .reception = 0.0};
  }
  anchors_[static_cast<std::size_t>(anchor)] = {.t_s = t_s};
}

void Gate::reset(double t_s) noexcept {
  pairs_.fill({.t_s = t_s, .nlos = config_.nlos_prior, .unhinted = config_.nlos_prior});
  t_s_ = t_s;
  began_s_ = t_s;
  start_fits_ = false;
  all_ = {.t_s = t_s};
  anchors_.fill({.t_s = t_s});
  suspects_divergence_ = false;
}

}  // namespace groma::filter
