#include "host/calibration/sight_solver.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "host/calibration/initial_guess.hpp"
#include "host/calibration/robust_kernel.hpp"
#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// Data ask for the chain where replies alone hold a pair for blocked for so large a share of its polls,
constexpr double kBlockedByReplies = 0.02;
// and these are by so much likelier than replies lost one by one, a fifth of them at most,
constexpr double kBlockedEvidence = 5.0;
constexpr double kMostLosses = 0.2;
constexpr std::array kLossesInSight{0.02, 0.01, 0.005};
// or where residuals longer than so many scales follow each other.
constexpr double kLong = 3.0;
constexpr double kLongShare = 0.02;
constexpr double kLongOverShort = 2.0;
constexpr double kLongCorrelation = 0.2;
constexpr double kLongSignificance = 5.0;
constexpr std::size_t kMinPolls = 50;
// Beyond this replies are lost for weakness, and hills and trees are no walls: the model is one of halls and
// yards, for drives with nearly all of their ranges within it.
constexpr double kReach_m = 60.0;
constexpr double kNearShare = 0.9;

constexpr int kSightRounds = 7;
constexpr int kLabelRounds = 2;
// Rows in sight that solve an anchor alone in the first round.
constexpr double kEnoughInSight = 0.25;
// An episode behind a wall.
constexpr double kEpisode_s = 4.0;
constexpr std::size_t kEpisodeRows = 8;
constexpr std::size_t kEpisodeBreak = 3;
// Replies that it takes to move a state's reply probability half-way from where it starts.
constexpr double kReplyWeight = 200.0;
// Walls of a site have an excess in common, but for this.
constexpr double kWallSpread_m = 0.1;
constexpr double kKnownWall_m = 0.1;
constexpr double kWallShapeWeight = 50.0;
// What shadows add to ranges, and what the noise blurs where that is more.
constexpr double kShadowScale_m = 0.08;

KernelShape shadow_shape(double scale_m) {
  KernelShape shape{
      .scale_m = scale_m, .wide = 0.15, .bumps = {0.38, 0.2, 0.08, 0.02, 0.01, 0.005}, .gross = 0.005};
  return shape;
}
KernelShape wall_shape() {
  return {.scale_m = 0.15, .wide = 0.1, .bumps = {0.1, 0.03, 0.01, 0.01, 0.005, 0.005}, .gross = 0.005};
}

// What one pass over an anchor's rows finds.
struct AnchorPass {
  AnchorSight sight;
  SightShares shares;
  double log_evidence = 0.0;
  SightVector answered = SightVector::Zero();
  SightVector missed = SightVector::Zero();
  PowerCounts powers;  // by residuals and replies alone
  std::vector<WeighedResidual> walled;
  std::vector<double> start_excess_m;  // of each episode over the common part
};

// Of the pairs' noise in sight: the median of their kernels' scales.
double typical_scale_m(std::span<const AnchorFit> fits) {
  std::vector<double> scales_m;
  for (const AnchorFit& fit : fits) {
    if (fit.problem.rows.empty()) continue;
    for (const RobustKernel& kernel : fit.kernels) scales_m.push_back(kernel.shape().scale_m);
  }
  return median(std::move(scales_m));
}

// Indices of a fit's rows end here.
std::size_t rows_until(const AnchorFit& fit) {
  return fit.problem.rows.empty() ? 0 : fit.problem.rows.back().index + std::size_t{1};
}

SightShares shares_of(const SightVector& answered, const SightVector& missed) {
  SightShares out;
  out.polls = (answered + missed) / std::max(1e-9, (answered + missed).sum());
  out.rows = answered / std::max(1e-9, answered.sum());
  return out;
}

std::size_t count_rows(std::span<const Poll> polls) {
  return static_cast<std::size_t>(std::count_if(polls.begin(), polls.end(), [](Poll p) { return p >= 0; }));
}

// Ranges too long that come one after the other, and are not as often too short.
bool long_residuals_hang_together(const AnchorFit& fit) {
  const std::size_t tags = fit.problem.tag_count;
  double rows = 0.0;
  double neighbours = 0.0;
  double too_long = 0.0;
  double too_short = 0.0;
  double both = 0.0;
  constexpr int kNone = -1;
  std::vector<int> last(tags, kNone);
  for (const Observation& row : fit.problem.rows) {
    const double r = residual_m(row, fit.anchor, tags);
    const RobustKernel& kernel = fit.kernels[row.tag];
    const double limit_m = kLong * kernel.shape().scale_m / noise_share(kernel, row, fit.anchor, tags);
    const int is_long = r > limit_m ? 1 : 0;
    rows += 1.0;
    too_long += is_long;
    too_short += r < -limit_m ? 1.0 : 0.0;
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

// The likeliest logarithm of the evidence of the polls, were each reply lost by itself.
double log_evidence_of_losses(std::span<const Poll> polls) {
  const auto missed = static_cast<double>(std::count(polls.begin(), polls.end(), kMissed));
  const auto told = static_cast<double>(polls.size()) -
                    static_cast<double>(std::count(polls.begin(), polls.end(), kNotTold));
  const double share = std::min(missed / told, kMostLosses);
  return missed * std::log(share) + (told - missed) * std::log1p(-share);
}

// Replies that are missing here and there are lost by chance: blocking has to tell better why they are.
bool replies_tell_of_blocking(SightChain chain, std::span<const std::vector<Poll>> pairs) {
  SightPosterior posterior;
  std::vector<SightVector> likelihoods;
  const SightVector believed = chain.reply;
  for (const std::vector<Poll>& polls : pairs) {
    if (polls.size() < kMinPolls) continue;
    const auto is_answered = [](Poll poll) { return poll >= 0 || poll == kReplied; };
    if (std::all_of(polls.begin(), polls.end(), is_answered)) continue;
    likelihoods.assign(count_rows(polls), SightVector::Ones());
    chain.reply = believed;
    infer_sight(chain, polls, likelihoods, {}, posterior);
    if (shares_of(posterior.answered, posterior.missed).polls(kInSight) >= 1.0 - kBlockedByReplies) continue;
    double log_evidence = posterior.log_evidence;
    for (const double lost : kLossesInSight) {
      chain.reply(kInSight) = 1.0 - lost;
      infer_sight(chain, polls, likelihoods, {}, posterior);
      log_evidence = std::max(log_evidence, posterior.log_evidence);
    }
    if (log_evidence > log_evidence_of_losses(polls) + kBlockedEvidence) return true;
  }
  return false;
}

class SightSolver {
 public:
  SightSolver(const PollTable& table, const SightModel& start, std::vector<AnchorFit>& fits,
              const model::RangePriors& priors)
      : table_(table), fits_(fits), priors_(priors) {
    out_.model = start;
  }

  SiteSight solve();

 private:
  void label_first();
  [[nodiscard]] AnchorPass look(std::size_t anchor) const;
  void learn(const std::vector<AnchorPass>& passes);
  void learn_shadow();
  void apply(std::size_t anchor, AnchorPass pass);

  const PollTable& table_;
  std::vector<AnchorFit>& fits_;
  const model::RangePriors& priors_;
  SiteSight out_;
};

// From replies and powers alone: rows in sight are taken as such, the others not at all or, where
// there are few in sight, as through a wall.
void SightSolver::label_first() {
  SightPosterior posterior;
  std::vector<SightVector> likelihoods;
  for (std::size_t a = 0; a < fits_.size(); ++a) {
    AnchorSight sight;
    sight.rows.resize(rows_until(fits_[a]));
    sight.prior = out_.model.wall_prior;
    sight.wall = RobustKernel(out_.model.wall);
    double seen = 0.0;
    for (const std::vector<Poll>& polls : table_.polls[a]) {
      likelihoods.assign(count_rows(polls), SightVector::Ones());
      infer_sight(out_.model.chain, polls, likelihoods,
                  hints_of(classes_of(polls, fits_[a].problem.rows), out_.model.powers), posterior);
      std::size_t i = 0;
      for (const Poll poll : polls) {
        if (poll < 0) continue;
        const bool in_sight = posterior.posterior[i++](kInSight) > 0.5;
        RowSight& row = sight.rows[static_cast<std::size_t>(poll)];
        row = {.in_sight = in_sight ? 1.0F : 0.0F, .wall = 0.0F, .other_density = in_sight ? 0.0F : 1.0F};
        seen += in_sight ? 1.0 : 0.0;
      }
    }
    if (seen < kEnoughInSight * static_cast<double>(sight.rows.size())) {
      sight.behind_wall = true;
      for (RowSight& row : sight.rows) {
        if (row.in_sight == 0.0F) row = {.in_sight = 0.0F, .wall = 1.0F, .other_density = 0.0F};
      }
    }
    AnchorPass pass;
    pass.sight = std::move(sight);
    apply(a, std::move(pass));
  }
}

AnchorPass SightSolver::look(std::size_t a) const {
  const AnchorFit& fit = fits_[a];
  const std::size_t tags = fit.problem.tag_count;
  const std::span<const Observation> rows = fit.problem.rows;
  AnchorPass out;
  if (rows.empty()) return out;
  const std::size_t first_row = rows.front().index;
  out.sight.rows.resize(rows_until(fit));
  out.sight.prior = out_.model.wall_prior;
  out.sight.wall = RobustKernel(out_.model.wall);
  const AnchorSight* before = fit.problem.sight;
  const bool had_wall = before != nullptr && before->behind_wall;
  const double common_m = had_wall ? fit.anchor(wall_index(tags)) : out_.model.wall_prior.mean_m;
  KernelShape anywhere_shape = out_.model.wall;
  anywhere_shape.scale_m = std::hypot(out_.model.wall.scale_m, out_.model.wall_prior.episode_sigma_m);
  const RobustKernel anywhere(anywhere_shape);

  SightPosterior posterior;
  std::vector<SightVector> likelihoods;
  std::vector<double> residuals_m;
  for (std::size_t tag = 0; tag < tags; ++tag) {
    const std::vector<Poll>& polls = table_.polls[a][tag];
    likelihoods.clear();
    residuals_m.clear();
    for (const Poll poll : polls) {
      if (poll < 0) continue;
      const Observation& row = rows[static_cast<std::size_t>(poll) - first_row];
      const double r = residual_m(row, fit.anchor, tags);
      residuals_m.push_back(r);
      double walled = 0.0;
      const auto density = [&](const RobustKernel& kernel, double excess_m) {
        return stretched(kernel, noise_share(kernel, row, fit.anchor, tags), r - excess_m).density;
      };
      if (had_wall && before->rows[row.index].episode != kNoEpisode) {
        walled = density(before->wall, wall_excess_m(before->rows[row.index], fit.anchor, tags));
      } else {
        walled = density(anywhere, common_m);
      }
      likelihoods.emplace_back(density(fit.kernels[tag], 0.0), density(out_.model.shadow, 0.0), walled);
    }
    const std::vector<model::PowerClass> classes = classes_of(polls, rows);
    if (out_.model.powers) {
      // What powers tell makes not itself.
      infer_sight(out_.model.chain, polls, likelihoods, {}, posterior);
      for (std::size_t i = 0; i < classes.size(); ++i) {
        out.powers.add(classes[i], posterior.posterior[i](kInSight));
      }
    }
    infer_sight(out_.model.chain, polls, likelihoods, hints_of(classes, out_.model.powers), posterior);
    out.log_evidence += posterior.log_evidence;
    out.answered += posterior.answered;
    out.missed += posterior.missed;

    // Rows and, of those behind a wall, episodes.
    std::size_t i = 0;
    std::size_t first = 0;
    std::size_t last = 0;
    std::size_t inside = 0;
    std::vector<std::size_t> of_row;
    for (const Poll poll : polls) {
      if (poll < 0) continue;
      of_row.push_back(static_cast<std::size_t>(poll));
      RowSight& row = out.sight.rows[of_row.back()];
      const SightVector& prior = posterior.prior[i];
      row.in_sight = static_cast<float>(prior(kInSight));
      row.wall = static_cast<float>(prior(kWall));
      row.other_density = static_cast<float>(prior(kShadow) * likelihoods[i](kShadow));
      ++i;
    }
    const auto close = [&] {
      if (inside < kEpisodeRows || model::is_ablated(model::Mechanism::kCalibrationEpisodes) ||
          rows[of_row[last] - first_row].t_s - rows[of_row[first] - first_row].t_s < kEpisode_s) {
        inside = 0;
        return;
      }
      const auto episode = static_cast<std::int32_t>(out.sight.episodes++);
      double sum_m = 0.0;
      double weight = 0.0;
      for (std::size_t k = first; k <= last; ++k) {
        RowSight& row = out.sight.rows[of_row[k]];
        row.episode = episode;
        const double share = posterior.posterior[k](kWall);
        const double r = residuals_m[k] - common_m;
        if (std::abs(r) > 4.0 * anywhere_shape.scale_m) continue;
        sum_m += share * r;
        weight += share;
      }
      const double believed = std::pow(out_.model.wall.scale_m / out_.model.wall_prior.episode_sigma_m, 2);
      const double start_m = sum_m / (weight + believed);
      out.start_excess_m.push_back(start_m);
      for (std::size_t k = first; k <= last; ++k) {
        out.walled.push_back(
            {.residual_m = residuals_m[k] - common_m - start_m, .weight = posterior.posterior[k](kWall)});
      }
      inside = 0;
    };
    for (std::size_t k = 0; k < i; ++k) {
      if (posterior.posterior[k](kWall) > 0.5) {
        if (inside == 0) first = k;
        ++inside;
        last = k;
      } else if (inside > 0 && k - last >= kEpisodeBreak) {
        close();
      }
    }
    if (inside > 0) close();
    // Outside of episodes what a wall adds is too uncertain to be of use.
    for (std::size_t k = 0; k < i; ++k) {
      RowSight& row = out.sight.rows[of_row[k]];
      if (row.episode != kNoEpisode) continue;
      row.other_density += row.wall * static_cast<float>(likelihoods[k](kWall));
      row.wall = 0.0F;
    }
  }
  out.sight.behind_wall = out.sight.episodes > 0;
  out.shares = shares_of(out.answered, out.missed);
  return out;
}

void SightSolver::learn(const std::vector<AnchorPass>& passes) {
  SightVector answered = SightVector::Zero();
  SightVector missed = SightVector::Zero();
  PowerCounts powers;
  std::vector<WeighedResidual> walled;
  double information = 1.0 / std::pow(WallPrior{}.sigma_m, 2);
  double weighted_m = WallPrior{}.mean_m * information;
  for (std::size_t a = 0; a < passes.size(); ++a) {
    const AnchorPass& pass = passes[a];
    answered += pass.answered;
    missed += pass.missed;
    powers.add(pass.powers, 1.0);
    walled.insert(walled.end(), pass.walled.begin(), pass.walled.end());
    const AnchorFit& fit = fits_[a];
    if (fit.problem.sight == nullptr || !fit.problem.sight->behind_wall || !pass.sight.behind_wall) continue;
    // Only where it is seen as well can a wall be told from a bias.
    if (pass.shares.polls(kInSight) < 0.3) continue;
    const double weight = 1.0 / (kKnownWall_m * kKnownWall_m + kWallSpread_m * kWallSpread_m);
    information += weight;
    weighted_m += weight * fit.anchor(wall_index(fit.problem.tag_count));
  }
  if (out_.model.powers) out_.model.powers->learn(powers);
  const SightVector believed = SightChain{}.reply;
  if (table_.regular) {
    out_.model.chain.reply =
        (answered + kReplyWeight * believed)
            .cwiseQuotient((answered + missed).array().matrix() + SightVector::Constant(kReplyWeight));
  } else {
    out_.model.chain.reply.setConstant(0.5);
  }
  out_.model.wall_prior.mean_m = weighted_m / information;
  out_.model.wall_prior.sigma_m = std::sqrt(1.0 / information + kWallSpread_m * kWallSpread_m);
  out_.model.wall = fit_kernel(
      walled, {.shape = wall_shape(), .scale_weight = kWallShapeWeight, .share_weight = kWallShapeWeight}, 3);
}

void SightSolver::learn_shadow() {
  out_.model.shadow = RobustKernel(shadow_shape(std::max(kShadowScale_m, typical_scale_m(fits_))));
}

void SightSolver::apply(std::size_t a, AnchorPass pass) {
  AnchorFit& fit = fits_[a];
  const std::size_t tags = fit.problem.tag_count;
  const bool had_wall = fit.problem.sight != nullptr && fit.problem.sight->behind_wall;
  const double common_m = had_wall ? fit.anchor(wall_index(tags)) : out_.model.wall_prior.mean_m;
  AnchorVector anchor(wall_index(tags) + static_cast<Eigen::Index>(pass.sight.extra_unknowns()));
  anchor.head(wall_index(tags)) = fit.anchor.head(wall_index(tags));
  if (pass.sight.behind_wall) {
    anchor(wall_index(tags)) = common_m;
    for (std::size_t k = 0; k < pass.sight.episodes; ++k) {
      anchor(episode_index(static_cast<std::int32_t>(k), tags)) = pass.start_excess_m[k];
    }
  }
  fit.anchor = std::move(anchor);
  out_.anchors[a] = std::move(pass.sight);
  out_.shares[a] = pass.shares;
  fit.problem.sight = &out_.anchors[a];
}

SiteSight SightSolver::solve() {
  out_.anchors.resize(fits_.size());
  out_.shares.resize(fits_.size());
  if (table_.regular || out_.model.powers) {
    label_first();
    refine_site(fits_, priors_, kLabelRounds);
  }
  for (int round = 0; round < kSightRounds; ++round) {
    learn_shadow();
    std::vector<AnchorPass> passes;
    for (std::size_t a = 0; a < fits_.size(); ++a) passes.push_back(look(a));
    learn(passes);
    for (std::size_t a = 0; a < fits_.size(); ++a) {
      passes[a].sight.prior = out_.model.wall_prior;
      passes[a].sight.wall = RobustKernel(out_.model.wall);
      apply(a, std::move(passes[a]));
    }
    refine_site(fits_, priors_, 1);
  }
  return std::move(out_);
}

}  // namespace

std::vector<model::PowerClass> classes_of(std::span<const Poll> polls, std::span<const Observation> rows) {
  std::vector<model::PowerClass> out;
  out.reserve(polls.size());
  for (const Poll poll : polls) {
    if (poll >= 0) out.push_back(rows[static_cast<std::size_t>(poll) - rows.front().index].power_class);
  }
  return out;
}

std::vector<double> hints_of(std::span<const model::PowerClass> classes,
                             const std::optional<PowerHints>& powers) {
  std::vector<double> out;
  if (!powers) return out;
  out.reserve(classes.size());
  for (const model::PowerClass of : classes) out.push_back(powers->ratio(of));
  return out;
}

SightModel first_sight_model(const PollTable& table, std::span<const AnchorFit> fits) {
  SightModel out;
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
  out.chain.transition = sight_transition(table.interval_s > 0.0 ? table.interval_s : 0.12);
  out.wall = wall_shape();
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

bool is_sight_wanted(const PollTable& table, std::vector<AnchorFit>& fits) {
  if (model::is_ablated(model::Mechanism::kCalibrationNlos)) return false;
  const SightChain chain = first_sight_model(table, {}).chain;
  const auto tell = [&](const std::vector<std::vector<Poll>>& pairs) {
    return replies_tell_of_blocking(chain, pairs);
  };
  if (table.regular && std::any_of(table.polls.begin(), table.polls.end(), tell)) return true;
  for (AnchorFit& fit : fits) {
    if (!long_residuals_hang_together(fit)) continue;
    if (fit.problem.position.surveyed) return true;
    const TagSpread spread = tag_spread(fit.problem.rows);
    for (const int axis : {kAcrossLine, kAcrossPlane}) static_cast<void>(challenge(fit, spread, axis));
    if (long_residuals_hang_together(fit)) return true;
  }
  return false;
}

SiteSight solve_sight(const PollTable& table, const SightModel& start, std::vector<AnchorFit>& fits,
                      const model::RangePriors& priors) {
  return SightSolver(table, start, fits, priors).solve();
}

}  // namespace groma::calibration
