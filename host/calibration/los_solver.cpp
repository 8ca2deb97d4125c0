#include "host/calibration/los_solver.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "host/calibration/mirror.hpp"
#include "host/calibration/robust_kernel.hpp"
#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// NLOS states are needed (limits by hand) if replies alone put a pair in NLOS for this share of its polls,
constexpr double kNlosByReplies = 0.02;
// and that has this much more log evidence than independent losses of replies, at most kMostLosses of them;
constexpr double kNlosEvidence = 5.0;
constexpr double kMostLosses = 0.2;
constexpr std::array kLossesInLos{0.02, 0.01, 0.005};
// or if residuals longer than kLong scales are correlated in time. 5 nats are odds of 150 to 1,
// 5 / sqrt(n) are 5 sigmas of the correlation of n white pairs, 50 polls give that a sigma of 0.14. NlosSite
// tests IsolatedLostReplies... (3 % lost, 10 % too long) and OutliersAndCollisions... (2 %, 25 %) hold.
constexpr double kLong = 3.0;
constexpr double kLongShare = 0.02;
constexpr double kLongOverShort = 2.0;
constexpr double kLongCorrelation = 0.2;
constexpr double kLongSignificance = 5.0;
constexpr std::size_t kMinPolls = 50;
// The NLOS model is for halls and yards: this share of the ranges, by hand, has to be shorter than kReach_m,
// the reach of a DWM1001 with a line of sight (its datasheet). A recorded run of longer ranges, by other
// modules, is off by 0.29 m with the model and 0.21 m without (mcd_ntu_day_09).
constexpr double kReach_m = 60.0;
constexpr double kNearShare = 0.9;

// Bounds on time, by hand; the NlosSite tests hold with them.
constexpr int kLosRounds = 7;
constexpr int kLabelRounds = 2;
constexpr int kRoundsWithout = 10;  // without the states of an earlier call
// Share of LOS ranges that is enough to solve an anchor from these alone. By hand.
constexpr double kEnoughLos = 0.25;
// An episode of long NLOS is longer than a short one (some 3 s), as each has an unknown excess: by hand.
constexpr double kEpisode_s = 4.0;
constexpr std::size_t kEpisodeRows = 8;
constexpr std::size_t kEpisodeBreak = 3;
// Number of polls that moves a state's reply probability half-way from its prior. By hand: the sigma of a
// probability of 0.5 from as many polls is 0.035.
constexpr double kReplyWeight = 200.0;
// Standard deviation of the anchors' common excesses about the site's, and of an anchor's estimate. By hand;
// in the NlosSite tests all walls have one mean excess.
constexpr double kExcessSpread_m = 0.1;
constexpr double kKnownExcess_m = 0.1;
constexpr double kLongNlosShapeWeight = 50.0;  // by hand, as kAnchorScaleWeight
// Scale of short NLOS residuals, or that of the noise if it is larger. By hand: the noise of the simulated
// sites; NlosSite.ResultDoesNotDependOnTheConfiguredNoise holds with it.
constexpr double kShortNlosScale_m = 0.08;

// Shares by hand, falling with the excess: short NLOS adds 0.3 m on average in the NlosSite tests,
// long NLOS scatters by 0.15 m about its mean. Only the second is estimated from there on.
KernelShape short_nlos_shape(double scale_m) {
  return {.scale_m = scale_m, .wide = 0.15, .bumps = {0.38, 0.2, 0.08, 0.02, 0.01, 0.005}, .gross = 0.005};
}
KernelShape long_nlos_shape() {
  return {.scale_m = 0.15, .wide = 0.1, .bumps = {0.1, 0.03, 0.01, 0.01, 0.005, 0.005}, .gross = 0.005};
}

struct AnchorPass {
  AnchorLos los_states;
  LosVector answered = LosVector::Zero();
  LosVector missed = LosVector::Zero();
  PowerCounts powers;  // by residuals and replies alone
  std::vector<WeighedResidual> nlos;
  std::vector<double> start_excess_m;  // of each episode, beyond the common excess
};

// Typical LOS noise of the pairs: the median of their kernels' scales, m.
double typical_scale_m(std::span<const AnchorFit> fits) {
  std::vector<double> scales_m;
  for (const AnchorFit& fit : fits) {
    if (fit.problem.rows.empty()) continue;
    for (const RobustKernel& kernel : fit.kernels) scales_m.push_back(kernel.shape().scale_m);
  }
  return median(std::move(scales_m));
}

std::size_t rows_until(const AnchorFit& fit) {
  return fit.problem.rows.empty() ? 0 : fit.problem.rows.back().index + std::size_t{1};
}

LosVector poll_shares(const LosVector& answered, const LosVector& missed) {
  return (answered + missed) / std::max(1e-9, (answered + missed).sum());
}

// The observations of a pair's polls, in order.
std::vector<const Observation*> rows_of(std::span<const Poll> polls, std::span<const Observation> rows) {
  std::vector<const Observation*> out;
  for (const Poll poll : polls) {
    if (poll >= 0) out.push_back(&rows[static_cast<std::size_t>(poll) - rows.front().index]);
  }
  return out;
}

// Empty if ranges carry no powers.
std::vector<double> hints_of(std::span<const Observation* const> rows,
                             const std::optional<PowerHints>& powers) {
  std::vector<double> out;
  if (!powers) return out;
  for (const Observation* row : rows) out.push_back(powers->ratio(row->power_class));
  return out;
}

// Whether too long ranges are correlated in time and clearly more frequent than too short ones.
bool long_residuals_are_correlated(const AnchorFit& fit) {
  double rows = 0.0;
  double neighbours = 0.0;
  double too_long = 0.0;
  double too_short = 0.0;
  double both = 0.0;
  constexpr int kNone = -1;
  std::vector<int> last(fit.problem.tag_count, kNone);
  for (const Observation& row : fit.problem.rows) {
    const RowAt at = row_at(fit, row);
    const double limit_m = kLong * fit.kernels[row.tag].shape().scale_m / at.noise_share;
    const int is_long = at.residual_m > limit_m ? 1 : 0;
    rows += 1.0;
    too_long += is_long;
    too_short += at.residual_m < -limit_m ? 1.0 : 0.0;
    if (last[row.tag] != kNone) {
      neighbours += 1.0;
      both += is_long * last[row.tag];
    }
    last[row.tag] = is_long;
  }
  if (neighbours < static_cast<double>(kMinPolls)) return false;
  const double share = too_long / rows;
  if (share < kLongShare || too_long < kLongOverShort * too_short) return false;
  const double correlation = (both / neighbours - share * share) / (share * (1.0 - share));
  return correlation > std::max(kLongCorrelation, kLongSignificance / std::sqrt(neighbours));
}

// Largest log likelihood of the polls if replies are lost independently.
double log_evidence_of_losses(std::span<const Poll> polls) {
  const auto missed = static_cast<double>(std::count(polls.begin(), polls.end(), kMissed));
  const auto known = static_cast<double>(polls.size()) -
                     static_cast<double>(std::count(polls.begin(), polls.end(), kUnknownPoll));
  const double share = std::min(missed / known, kMostLosses);
  return missed * std::log(share) + (known - missed) * std::log1p(-share);
}

// Isolated missed replies are lost by chance: NLOS has to explain them better.
bool replies_show_nlos(LosChain chain, std::span<const std::vector<Poll>> pairs) {
  LosPosterior posterior;
  const LosVector believed = chain.reply;
  for (const std::vector<Poll>& polls : pairs) {
    if (polls.size() < kMinPolls) continue;
    const auto is_answered = [](Poll poll) { return poll >= 0 || poll == kReplied; };
    if (std::all_of(polls.begin(), polls.end(), is_answered)) continue;
    chain.reply = believed;
    infer_states(chain, polls, {}, {}, posterior);
    if (poll_shares(posterior.answered, posterior.missed)(kLos) >= 1.0 - kNlosByReplies) continue;
    double log_evidence = posterior.log_evidence;
    for (const double lost : kLossesInLos) {
      chain.reply(kLos) = 1.0 - lost;
      infer_states(chain, polls, {}, {}, posterior);
      log_evidence = std::max(log_evidence, posterior.log_evidence);
    }
    if (log_evidence > log_evidence_of_losses(polls) + kNlosEvidence) return true;
  }
  return false;
}

// One pair's polls with an observation, in order.
struct PairPass {
  std::vector<const Observation*> rows;
  std::vector<double> residuals_m;
  std::vector<LosVector> likelihoods;
  LosPosterior posterior;
};

class LosSolver {
 public:
  LosSolver(const PollTable& table, const LosModel& start, std::vector<AnchorFit>& fits)
      : table_(table), fits_(fits) {
    out_.model = start;
  }

  [[nodiscard]] SiteLos solve() {
    out_.anchors.resize(fits_.size());
    out_.poll_shares.resize(fits_.size(), LosVector::Zero());
    if (table_.regular || out_.model.powers) {
      label_first();
      refine_site(fits_, kLabelRounds);
    }
    for (int round = 0; round < kLosRounds; ++round) {
      out_.model.short_nlos =
          RobustKernel(short_nlos_shape(std::max(kShortNlosScale_m, typical_scale_m(fits_))));
      std::vector<AnchorPass> passes;
      for (std::size_t a = 0; a < fits_.size(); ++a) passes.push_back(infer(a));
      estimate_model(passes);
      for (std::size_t a = 0; a < fits_.size(); ++a) apply(a, std::move(passes[a]));
      refine_site(fits_, 1);
    }
    return std::move(out_);
  }

 private:
  [[nodiscard]] static bool had_long_nlos(const AnchorFit& fit) {
    return fit.problem.los_states != nullptr && fit.problem.los_states->has_long_nlos;
  }
  // Common excess of the anchor's long NLOS, m.
  [[nodiscard]] double common_excess_m(const AnchorFit& fit) const {
    return had_long_nlos(fit) ? fit.anchor(excess_index(fit.problem.tag_count))
                              : out_.model.excess_prior.mean_m;
  }
  // Shape of long NLOS residuals outside episodes.
  [[nodiscard]] KernelShape anywhere_shape() const {
    KernelShape out = out_.model.long_nlos;
    out.scale_m = std::hypot(out_.model.long_nlos.scale_m, out_.model.excess_prior.episode_sigma_m);
    return out;
  }

  // First classification, by replies and powers alone. Ranges that are not LOS are ignored or, if few are
  // LOS, taken as long NLOS.
  void label_first() {
    for (std::size_t a = 0; a < fits_.size(); ++a) {
      const std::span<const Observation> rows = fits_[a].problem.rows;
      const std::vector<bool> seen = los_rows(out_.model, table_.polls[a], rows);
      AnchorPass pass;
      pass.los_states.rows.resize(rows_until(fits_[a]));
      pass.los_states.has_long_nlos = static_cast<double>(std::count(seen.begin(), seen.end(), true)) <
                                      kEnoughLos * static_cast<double>(pass.los_states.rows.size());
      for (std::size_t i = 0; i < rows.size(); ++i) {
        if (seen[i]) continue;
        pass.los_states.rows[rows[i].index] =
            pass.los_states.has_long_nlos ? RangeLos{.los = 0.0F, .long_nlos = 1.0F} : kIgnored;
      }
      apply(a, std::move(pass));
    }
  }

  void weigh(std::size_t a, const std::vector<Poll>& polls, PairPass& pair) const {
    const AnchorFit& fit = fits_[a];
    const std::size_t tags = fit.problem.tag_count;
    const double common_m = common_excess_m(fit);
    const RobustKernel anywhere(anywhere_shape());
    const AnchorLos* before = had_long_nlos(fit) ? fit.problem.los_states : nullptr;
    pair.rows = rows_of(polls, fit.problem.rows);
    for (const Observation* observation : pair.rows) {
      const Observation& row = *observation;
      const double r = residual_m(row, fit.anchor, tags);
      const double variance_m2 = pose_variance_m2(row, fit.anchor, tags);
      const auto density = [&](const RobustKernel& kernel, double excess_m) {
        return widened_value(kernel, variance_m2, r - excess_m).density;
      };
      const bool in_episode = before != nullptr && before->rows[row.index].episode != kNoEpisode;
      const double nlos = in_episode ? density(before->long_nlos,
                                               long_nlos_excess_m(before->rows[row.index], fit.anchor, tags))
                                     : density(anywhere, common_m);
      pair.residuals_m.push_back(r);
      pair.likelihoods.emplace_back(density(fit.kernels[row.tag], 0.0), density(out_.model.short_nlos, 0.0),
                                    nlos);
    }
  }

  [[nodiscard]] AnchorPass infer(std::size_t a) const {
    const std::span<const Observation> rows = fits_[a].problem.rows;
    AnchorPass out;
    if (rows.empty()) return out;
    out.los_states.rows.resize(rows_until(fits_[a]));
    for (const std::vector<Poll>& polls : table_.polls[a]) {
      PairPass pair;
      weigh(a, polls, pair);
      LosPosterior& posterior = pair.posterior;
      if (out_.model.powers) {
        // Powers are estimated without what they say themselves.
        infer_states(out_.model.chain, polls, pair.likelihoods, {}, posterior);
        for (std::size_t i = 0; i < pair.rows.size(); ++i) {
          out.powers.add(pair.rows[i]->power_class, posterior.posterior[i](kLos));
        }
      }
      infer_states(out_.model.chain, polls, pair.likelihoods, hints_of(pair.rows, out_.model.powers),
                   posterior);
      out.answered += posterior.answered;
      out.missed += posterior.missed;
      for (std::size_t i = 0; i < pair.rows.size(); ++i) {
        RangeLos& row = out.los_states.rows[pair.rows[i]->index];
        row.los = static_cast<float>(posterior.prior[i](kLos));
        row.long_nlos = static_cast<float>(posterior.prior[i](kLongNlos));
        row.other_density =
            static_cast<float>(posterior.prior[i](kShortNlos) * pair.likelihoods[i](kShortNlos));
      }
      add_episodes(pair, common_excess_m(fits_[a]), out);
      // Outside episodes the excess is too uncertain for the range to be of use.
      for (std::size_t i = 0; i < pair.rows.size(); ++i) {
        RangeLos& row = out.los_states.rows[pair.rows[i]->index];
        if (row.episode != kNoEpisode) continue;
        row.other_density += row.long_nlos * static_cast<float>(pair.likelihoods[i](kLongNlos));
        row.long_nlos = 0.0F;
      }
    }
    out.los_states.has_long_nlos = out.los_states.episodes > 0;
    ignore_weak(a, out);
    return out;
  }

  // Ignores the ranges whose first path is too weak for a line of sight, if enough are left. Their errors are
  // small and change smoothly along the drive: by residuals they look like LOS at another position.
  void ignore_weak(std::size_t a, AnchorPass& pass) const {
    if (!out_.model.powers) return;
    const std::span<const Observation> rows = fits_[a].problem.rows;
    const auto is_weak = [&](const Observation& row) { return out_.model.powers->is_weak(row.power_class); };
    const auto left =
        rows.size() - static_cast<std::size_t>(std::count_if(rows.begin(), rows.end(), is_weak));
    if (static_cast<double>(left) < kEnoughLos * static_cast<double>(rows.size())) return;
    for (const Observation& row : rows) {
      if (is_weak(row)) pass.los_states.rows[row.index] = kIgnored;
    }
  }

  // Adds the stretches of long NLOS ranges that no more than a few others interrupt.
  void add_episodes(const PairPass& pair, double common_m, AnchorPass& out) const {
    std::size_t first = 0;
    std::size_t last = 0;
    std::size_t inside = 0;
    const auto close = [&] {
      if (inside >= kEpisodeRows && pair.rows[last]->t_s - pair.rows[first]->t_s >= kEpisode_s &&
          !model::is_ablated(model::Mechanism::kCalibrationEpisodes)) {
        add_episode(pair, first, last, common_m, out);
      }
      inside = 0;
    };
    for (std::size_t k = 0; k < pair.rows.size(); ++k) {
      if (pair.posterior.posterior[k](kLongNlos) > 0.5) {
        if (inside == 0) first = k;
        ++inside;
        last = k;
      } else if (inside > 0 && k - last >= kEpisodeBreak) {
        close();
      }
    }
    if (inside > 0) close();
  }

  void add_episode(const PairPass& pair, std::size_t first, std::size_t last, double common_m,
                   AnchorPass& out) const {
    const auto episode = static_cast<std::int32_t>(out.los_states.episodes++);
    const double limit_m = 4.0 * anywhere_shape().scale_m;
    double sum_m = 0.0;
    double weight = 0.0;
    for (std::size_t k = first; k <= last; ++k) {
      out.los_states.rows[pair.rows[k]->index].episode = episode;
      const double share = pair.posterior.posterior[k](kLongNlos);
      const double r = pair.residuals_m[k] - common_m;
      if (std::abs(r) > limit_m) continue;
      sum_m += share * r;
      weight += share;
    }
    const double prior_weight =
        std::pow(out_.model.long_nlos.scale_m / out_.model.excess_prior.episode_sigma_m, 2);
    const double start_m = sum_m / (weight + prior_weight);
    out.start_excess_m.push_back(start_m);
    for (std::size_t k = first; k <= last; ++k) {
      out.nlos.push_back({.residual_m = pair.residuals_m[k] - common_m - start_m,
                          .weight = pair.posterior.posterior[k](kLongNlos)});
    }
  }

  void estimate_model(const std::vector<AnchorPass>& passes) {
    LosVector answered = LosVector::Zero();
    LosVector missed = LosVector::Zero();
    PowerCounts powers;
    std::vector<WeighedResidual> nlos;
    double information = 1.0 / std::pow(LongNlosPrior{}.sigma_m, 2);
    double weighted_m = LongNlosPrior{}.mean_m * information;
    for (std::size_t a = 0; a < passes.size(); ++a) {
      const AnchorPass& pass = passes[a];
      answered += pass.answered;
      missed += pass.missed;
      powers.add(pass.powers, 1.0);
      nlos.insert(nlos.end(), pass.nlos.begin(), pass.nlos.end());
      if (!had_long_nlos(fits_[a]) || !pass.los_states.has_long_nlos) continue;
      // An excess differs from a bias only if the anchor is in LOS as well.
      if (poll_shares(pass.answered, pass.missed)(kLos) < 0.3) continue;
      const double weight = 1.0 / (kKnownExcess_m * kKnownExcess_m + kExcessSpread_m * kExcessSpread_m);
      information += weight;
      weighted_m += weight * common_excess_m(fits_[a]);
    }
    if (out_.model.powers) out_.model.powers->estimate(powers);
    const LosVector believed = LosChain{}.reply;
    if (table_.regular) {
      out_.model.chain.reply =
          (answered + kReplyWeight * believed)
              .cwiseQuotient((answered + missed).array().matrix() + LosVector::Constant(kReplyWeight));
    } else {
      out_.model.chain.reply.setConstant(0.5);
    }
    out_.model.excess_prior.mean_m = weighted_m / information;
    out_.model.excess_prior.sigma_m = std::sqrt(1.0 / information + kExcessSpread_m * kExcessSpread_m);
    out_.model.long_nlos = fit_kernel(nlos,
                                      {.shape = long_nlos_shape(),
                                       .scale_weight = kLongNlosShapeWeight,
                                       .share_weight = kLongNlosShapeWeight},
                                      3);
  }

  void apply(std::size_t a, AnchorPass pass) {
    AnchorFit& fit = fits_[a];
    pass.los_states.prior = out_.model.excess_prior;
    pass.los_states.long_nlos = RobustKernel(out_.model.long_nlos);
    const Eigen::Index common = excess_index(fit.problem.tag_count);
    AnchorVector anchor = AnchorVector::Zero(common + pass.los_states.extra_unknowns());
    anchor.head(common) = fit.anchor.head(common);
    if (pass.los_states.has_long_nlos) anchor(common) = common_excess_m(fit);
    for (std::size_t k = 0; k < pass.los_states.episodes; ++k) {
      anchor(episode_index(static_cast<std::int32_t>(k), fit.problem.tag_count)) = pass.start_excess_m[k];
    }
    fit.anchor = std::move(anchor);
    out_.anchors[a] = std::move(pass.los_states);
    out_.poll_shares[a] = poll_shares(pass.answered, pass.missed);
    fit.problem.los_states = &out_.anchors[a];
  }

  const PollTable& table_;
  std::vector<AnchorFit>& fits_;
  SiteLos out_;
};

}  // namespace

std::vector<bool> los_rows(const LosModel& model, std::span<const std::vector<Poll>> pairs,
                           std::span<const Observation> rows) {
  std::vector<bool> out(rows.size(), false);
  LosPosterior posterior;
  for (const std::vector<Poll>& polls : pairs) {
    const std::vector<const Observation*> answered = rows_of(polls, rows);
    infer_states(model.chain, polls, {}, hints_of(answered, model.powers), posterior);
    for (std::size_t i = 0; i < answered.size(); ++i) {
      out[static_cast<std::size_t>(answered[i] - rows.data())] = posterior.posterior[i](kLos) > 0.5;
    }
  }
  return out;
}

LosModel first_los_model(const PollTable& table, std::span<const AnchorFit> fits) {
  LosModel out;
  std::array<double, model::kPowerClasses + 1> ranges{};
  double with_powers = 0.0;
  for (const AnchorFit& fit : fits) {
    for (const Observation& row : fit.problem.rows) {
      ranges[row.power_class] += 1.0;
      with_powers += row.power_class != model::kNoPowerClass ? 1.0 : 0.0;
    }
  }
  if (with_powers > 0.0 && !model::is_ablated(model::Mechanism::kCalibrationPowers)) {
    out.powers.emplace(std::span(ranges).first<model::kPowerClasses>(), table.interval_s);
  }
  out.chain.transition = los_transition(table.interval_s > 0.0 ? table.interval_s : 0.12);
  out.long_nlos = long_nlos_shape();
  return out;
}

bool is_within_reach(const std::vector<AnchorFit>& fits) noexcept {
  std::size_t near = 0;
  std::size_t all = 0;
  for (const AnchorFit& fit : fits) {
    for (const Observation& row : fit.problem.rows) near += row.range_m < kReach_m ? 1 : 0;
    all += fit.problem.rows.size();
  }
  return static_cast<double>(near) >= kNearShare * static_cast<double>(all);
}

bool needs_nlos_states(const PollTable& table, std::vector<AnchorFit>& fits) {
  if (model::is_ablated(model::Mechanism::kCalibrationNlos)) return false;
  const LosChain chain = first_los_model(table, {}).chain;
  const auto shows_nlos = [&](const std::vector<std::vector<Poll>>& pairs) {
    return replies_show_nlos(chain, pairs);
  };
  if (table.regular && std::any_of(table.polls.begin(), table.polls.end(), shows_nlos)) return true;
  for (AnchorFit& fit : fits) {
    if (!long_residuals_are_correlated(fit)) continue;
    if (fit.problem.position.surveyed) return true;
    test_both_mirrors(fit);
    if (long_residuals_are_correlated(fit)) return true;
  }
  return false;
}

void find_nlos(const PollTable& table, std::vector<AnchorFit>& fits, SiteLos& los_states) {
  if (!los_states.anchors.empty()) {
    for (AnchorFit& fit : fits) {
      fit.problem.los_states = nullptr;
      fit.anchor.conservativeResize(excess_index(fit.problem.tag_count));
    }
    los_states = {};
    refine_site(fits, kRoundsWithout);
  }
  if (needs_nlos_states(table, fits)) los_states = solve_los(table, first_los_model(table, fits), fits);
}

SiteLos solve_los(const PollTable& table, const LosModel& start, std::vector<AnchorFit>& fits) {
  return LosSolver(table, start, fits).solve();
}

}  // namespace groma::calibration
