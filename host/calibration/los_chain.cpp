#include "host/calibration/los_chain.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>

namespace groma::calibration {
namespace {

// Transitions are given per kRound_s. Mean durations: LOS some 12 s, short NLOS some 3 s, long NLOS some 10
// s. By hand, and fixed; obstacles of the NlosSite tests act for 1 to 10 s. They poll each kRound_s.
constexpr double kRound_s = 0.12;
// Polls missed in a row beyond this number are not counted: by hand, they carry no more information.
constexpr std::int64_t kMaxMissed = 32;
// Polls are regular if this share of all intervals are multiples of the shortest, within this fraction of it.
// By hand; LosChain.IrregularPollsAreNeverMissed holds with them: random intervals pass with a share of 0.4.
constexpr double kRegularShare = 0.9;
constexpr double kRegularDeviation = 0.2;
constexpr std::size_t kMinIntervals = 100;  // the share's sigma is then 0.03 (binomial)
// Quantile of the intervals that counts as the shortest: a few are repeats. By hand.
constexpr double kShortest = 0.1;
// Lower limit of a state's likelihood, relative to the largest: 12 nats. By hand.
constexpr double kMinLikelihood = 6e-6;

// Interval and regularity of the polls, from the pairs' intervals between replies.
PollTable empty_table(const Association& association) {
  std::vector<double> intervals_s;
  for (const AnchorObservations& anchor : association.anchors) {
    std::vector<const Observation*> last(association.tags.size(), nullptr);
    for (const Observation& row : anchor.rows) {
      const Observation* before = std::exchange(last[row.tag], &row);
      if (before != nullptr && row.t_s > before->t_s) intervals_s.push_back(row.t_s - before->t_s);
    }
  }
  PollTable table;
  if (intervals_s.size() < kMinIntervals) return table;
  const double n = static_cast<double>(intervals_s.size());
  const auto smallest = [&](double share) {
    const auto at = intervals_s.begin() + static_cast<std::ptrdiff_t>(share * n);
    std::nth_element(intervals_s.begin(), at, intervals_s.end());
    return *at;
  };
  const double shortest_s = smallest(kShortest);
  double sum_s = 0.0;
  double steps = 0.0;
  for (const double interval_s : intervals_s) {
    if (std::abs(interval_s / shortest_s - 1.0) > kRegularDeviation) continue;
    sum_s += interval_s;
    steps += 1.0;
  }
  table.interval_s = sum_s / steps;
  const auto fits = std::count_if(intervals_s.begin(), intervals_s.end(), [&](double interval_s) {
    const double count = std::round(interval_s / table.interval_s);
    return count >= 1.0 && std::abs(interval_s / table.interval_s - count) < kRegularDeviation;
  });
  table.regular = static_cast<double>(fits) > kRegularShare * n;
  if (!table.regular) table.interval_s = smallest(0.5);
  return table;
}

std::vector<std::vector<double>> reply_times_by_tag(const Association& association) {
  std::vector<std::vector<double>> out(association.tags.size());
  for (const AnchorObservations& anchor : association.anchors) {
    for (const Observation& row : anchor.rows) out[row.tag].push_back(row.t_s);
  }
  for (std::vector<double>& times_s : out) std::sort(times_s.begin(), times_s.end());
  return out;
}

// All by hand; NlosSite.PowersReveal... and MisleadingPowersCostLittle... hold with them (powers 6 dB weaker
// in NLOS, with a sigma of 2 dB). The filter's gate has the same 10, 0.2 s and 30.
constexpr double kMost = 10.0;  // bound of one range's likelihood ratio
// Ranges within this time pass the same obstacles: they count as one.
constexpr double kTogether_s = 0.2;
// Weight of the prior, in such ranges.
constexpr double kBelievedCount = 30.0;
// Share of the ranges that are at least as strong as a typical LOS range.
constexpr double kStrongest = 0.2;
// Scale of the strength of LOS ranges about the typical one (Laplace distribution).
constexpr double kStrengthScale_db = 3.0;
// A first path is too weak for a line of sight if it is this many classes (9 dB) weaker than a typical LOS
// one, at a site where such ranges are this much more frequent in NLOS than in LOS. By hand: an antenna's
// pattern is within some 6 dB, diffraction at an edge costs 6 dB where the line of sight touches it, and
// more behind it. PowerHints.AWeakFirstPathIsNoLosWhereItMeansNlos and the campaign `demo-anchors` hold.
constexpr std::size_t kWeakClasses = 3;
constexpr double kWeakRatio = 2.0;

double sum(const std::array<double, model::kPowerClasses>& counts) noexcept {
  return std::accumulate(counts.begin(), counts.end(), 0.0);
}

}  // namespace

Eigen::Matrix3d los_transition(double interval_s) noexcept {
  Eigen::Matrix3d a_round;
  a_round << 0.990, 0.005, 0.005, 0.033, 0.962, 0.005, 0.010, 0.0025, 0.9875;
  const Eigen::Matrix3d rates = (a_round - Eigen::Matrix3d::Identity()) / kRound_s;
  // Matrix exponential of the rates, by squaring.
  constexpr int kSquarings = 12;  // numerics: 2^12 steps to first order, of 3e-5 s for 0.12 s
  Eigen::Matrix3d out =
      Eigen::Matrix3d::Identity() + rates * std::clamp(interval_s, 1e-3, 100.0) / std::exp2(kSquarings);
  for (int i = 0; i < kSquarings; ++i) out = Eigen::Matrix3d(out * out);
  return out;
}

PollTable tabulate_polls(const Association& association) {
  PollTable table = empty_table(association);
  const std::size_t tags = association.tags.size();
  const std::vector<std::vector<double>> replies_s = reply_times_by_tag(association);
  for (const AnchorObservations& anchor : association.anchors) {
    std::vector<std::vector<Poll>>& pairs = table.polls.emplace_back(tags);
    std::vector<const Observation*> last(tags, nullptr);
    for (const Observation& row : anchor.rows) {
      std::vector<Poll>& polls = pairs[row.tag];
      const Observation* before = std::exchange(last[row.tag], &row);
      if (before != nullptr && table.interval_s > 0.0) {
        const double from_s = before->t_s;
        const auto gap = static_cast<std::int64_t>(
            std::min(1.0 + kMaxMissed, std::round((row.t_s - from_s) / table.interval_s)));
        for (std::int64_t k = 1; k < gap; ++k) {
          // A tag that no anchor answered may not have polled.
          const double begin_s = from_s + (static_cast<double>(k) - 0.5) * table.interval_s;
          const std::vector<double>& times_s = replies_s[row.tag];
          const auto next = std::lower_bound(times_s.begin(), times_s.end(), begin_s);
          const bool asked = table.regular && next != times_s.end() && *next < begin_s + table.interval_s;
          polls.push_back(asked ? kMissed : kUnknownPoll);
        }
      }
      polls.push_back(static_cast<Poll>(row.index));
    }
  }
  return table;
}

void keep_rows(PollTable& table, std::size_t anchor, std::span<const std::size_t> kept) {
  for (std::vector<Poll>& polls : table.polls[anchor]) {
    for (Poll& poll : polls) {
      if (poll < 0) continue;
      const auto row = static_cast<std::size_t>(poll);
      const auto at = std::lower_bound(kept.begin(), kept.end(), row);
      poll = at != kept.end() && *at == row ? static_cast<Poll>(at - kept.begin()) : kReplied;
    }
  }
}

void infer_states(const LosChain& chain, std::span<const Poll> polls, std::span<const LosVector> likelihoods,
                  std::span<const double> hints, LosPosterior& out) {
  const auto observed = std::count_if(polls.begin(), polls.end(), [](Poll poll) { return poll >= 0; });
  out.prior.resize(static_cast<std::size_t>(observed));
  out.posterior.resize(static_cast<std::size_t>(observed));
  out.log_evidence = 0.0;
  out.answered.setZero();
  out.missed.setZero();
  const Eigen::Matrix3d forth = chain.transition.transpose();
  // Likelihoods of a poll by reply and powers, and by its residual; `row` counts the polls with an
  // observation.
  const auto reply = [&](Poll poll, std::size_t row) -> LosVector {
    if (poll == kMissed) return LosVector::Ones() - chain.reply;
    if (poll < 0 || hints.empty()) return chain.reply;
    return chain.reply.cwiseProduct(LosVector(1.0, hints[row], hints[row]));
  };
  const auto residual = [&](Poll poll, std::size_t row) -> LosVector {
    if (poll < 0 || likelihoods.empty()) return LosVector::Ones();
    return likelihoods[row].cwiseMax(kMinLikelihood * likelihoods[row].maxCoeff());
  };
  std::size_t row = 0;
  std::vector<LosVector> forward;  // of each poll, from those before it
  forward.reserve(polls.size());
  LosVector state = chain.start;
  for (std::size_t n = 0; n < polls.size(); ++n) {
    if (n > 0) state = LosVector(forth * state);
    forward.push_back(state);
    if (polls[n] == kUnknownPoll) continue;
    state = state.cwiseProduct(reply(polls[n], row)).cwiseProduct(residual(polls[n], row));
    if (polls[n] >= 0) ++row;
    const double total = state.sum();
    out.log_evidence += std::log(total);
    state /= total;
  }
  LosVector backward = LosVector::Ones();  // from those after it
  for (std::size_t n = polls.size(); n-- > 0;) {
    if (polls[n] >= 0) --row;
    if (polls[n] != kUnknownPoll) {
      const LosVector by_reply = reply(polls[n], row);
      const LosVector by_residual = residual(polls[n], row);
      const LosVector prior = forward[n].cwiseProduct(backward).cwiseProduct(by_reply);
      const LosVector both = prior.cwiseProduct(by_residual);
      const LosVector posterior = both / both.sum();
      (polls[n] == kMissed ? out.missed : out.answered) += posterior;
      if (polls[n] >= 0) {
        out.prior[row] = prior / prior.sum();
        out.posterior[row] = posterior;
      }
      backward = backward.cwiseProduct(by_reply).cwiseProduct(by_residual).eval();
    }
    backward = (chain.transition * backward).eval();
    backward /= backward.sum();
  }
}

void PowerCounts::add(model::PowerClass of, double los_share) noexcept {
  if (of >= model::kNoPowerClass) return;
  los[of] += los_share;
  blocked[of] += 1.0 - los_share;
}

void PowerCounts::add(const PowerCounts& other, double times) noexcept {
  for (std::size_t i = 0; i < model::kPowerClasses; ++i) {
    los[i] += times * other.los[i];
    blocked[i] += times * other.blocked[i];
  }
}

PowerHints::PowerHints(std::span<const double, model::kPowerClasses> ranges, double interval_s) noexcept
    : share_(std::clamp(interval_s / kTogether_s, 1e-3, 1.0)) {
  constexpr std::size_t kKnown = model::kStrengthClasses - 1;
  std::array<double, kKnown> strengths{};
  for (std::size_t i = 0; i < model::kPowerClasses; ++i) {
    if (i % model::kStrengthClasses < kKnown) strengths[i % model::kStrengthClasses] += ranges[i];
  }
  const double all = std::accumulate(strengths.begin(), strengths.end(), 0.0);
  std::size_t usual = kKnown - 1;
  for (double stronger = strengths[usual]; usual > 0 && stronger < kStrongest * all;) {
    stronger += strengths[--usual];
  }
  std::array<double, kKnown> near_usual{};
  for (std::size_t i = 0; i < kKnown; ++i) {
    const double apart = std::abs(static_cast<double>(i) - static_cast<double>(usual));
    near_usual[i] = std::exp(-apart * model::kStrengthStep_db / kStrengthScale_db);
  }
  usual_ = usual;
  const double near_all = std::accumulate(near_usual.begin(), near_usual.end(), 0.0);
  // An unknown strength carries no information.
  constexpr double kAnywhere = 1.0 / static_cast<double>(model::kStrengthClasses);
  for (std::size_t i = 0; i < model::kPowerClasses; ++i) {
    const std::size_t hidden = i / model::kStrengthClasses;
    const std::size_t strength = i % model::kStrengthClasses;
    const double los = strength < kKnown ? (1.0 - kAnywhere) * near_usual[strength] / near_all : kAnywhere;
    believed_.los[i] = kBelievedCount * model::kPriorLos[hidden] * los;
    believed_.blocked[i] = kBelievedCount * model::kPriorNlos[hidden] * kAnywhere;
  }
  estimate({});
  weak_is_nlos_ = false;
}

bool PowerHints::is_below_usual(model::PowerClass of) const noexcept {
  const std::size_t strength = model::strength_class(of);
  return of < model::kNoPowerClass && strength + 1 < model::kStrengthClasses &&
         strength + kWeakClasses <= usual_;
}

bool PowerHints::is_weak(model::PowerClass of) const noexcept {
  return weak_is_nlos_ && is_below_usual(of);
}

void PowerHints::estimate(const PowerCounts& counts) noexcept {
  PowerCounts all = believed_;
  all.add(counts, share_);
  const double los = sum(all.los);
  const double blocked = sum(all.blocked);
  for (std::size_t i = 0; i < model::kPowerClasses; ++i) {
    const double ratio = all.blocked[i] / blocked * (los / all.los[i]);
    ratios_[i] = std::clamp(ratio, 1.0 / kMost, kMost);
  }
  ratios_.back() = 1.0;
  double weak_los = 0.0;
  double weak_blocked = 0.0;
  for (std::size_t i = 0; i < model::kPowerClasses; ++i) {
    if (!is_below_usual(static_cast<model::PowerClass>(i))) continue;
    weak_los += all.los[i];
    weak_blocked += all.blocked[i];
  }
  weak_is_nlos_ = weak_blocked / blocked >= kWeakRatio * (weak_los / los);
}

}  // namespace groma::calibration
