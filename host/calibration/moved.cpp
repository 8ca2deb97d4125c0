#include "host/calibration/moved.hpp"

#include <algorithm>
#include <limits>
#include <utility>

#include <Eigen/Cholesky>

#include "host/calibration/initial_guess.hpp"
#include "host/calibration/rival.hpp"
#include "host/calibration/uncertainty.hpp"

namespace groma::calibration {
namespace {

// Without a sight, an anchor is looked at where its score scatters so much more than independent residuals
// make it.
constexpr double kSuspiciousInflation = 1.5;
// Rows that each half wants.
constexpr std::ptrdiff_t kMinRows = 100;
constexpr int kRounds = 4;
// A move is one of this length in the plane, and so far outside of what the halves can differ by.
constexpr double kMinMove_m = 0.15;
constexpr double kMinSquareSigmas = 40.0;
// Share of polls in sight that each half wants.
constexpr double kMinInSight = 0.2;

// The polls of a table that belong to rows from `first` on, up to `last`.
std::vector<std::vector<Poll>> cut(std::span<const std::vector<Poll>> pairs, Poll first, Poll last) {
  std::vector<std::vector<Poll>> out;
  for (const std::vector<Poll>& polls : pairs) {
    const auto inside = [&](Poll poll) { return poll >= first && poll < last; };
    const auto begin = std::find_if(polls.begin(), polls.end(), inside);
    const auto end = std::find_if(polls.rbegin(), std::make_reverse_iterator(begin), inside).base();
    out.emplace_back(begin, end);
  }
  return out;
}

}  // namespace

Shift shift_between(const AnchorVector& earlier, const Eigen::MatrixXd& earlier_covariance,
                    const AnchorVector& later, const Eigen::MatrixXd& later_covariance) {
  const Eigen::VectorXd difference = later - earlier;
  const Eigen::MatrixXd covariance = earlier_covariance + later_covariance;
  const Eigen::Index biases = difference.size() - 3;
  const Eigen::LDLT<Eigen::MatrixXd> of_biases(covariance.bottomRightCorner(biases, biases));
  const Eigen::MatrixXd gain = of_biases.solve(covariance.bottomLeftCorner(biases, 3)).transpose();
  const Eigen::Matrix3d left =
      covariance.topLeftCorner<3, 3>() - gain * covariance.bottomLeftCorner(biases, 3);
  Shift shift;
  shift.by_m = difference.head<3>() - gain * difference.tail(biases);
  shift.square_sigmas = shift.by_m.dot(left.ldlt().solve(shift.by_m));
  return shift;
}

std::vector<std::optional<Shift>> find_moved(const PollTable& table, SiteSight& sight,
                                             std::vector<AnchorFit>& fits, const model::RangePriors& priors) {
  std::vector<std::optional<Shift>> out(fits.size());
  const RowSpan span = row_span(fits);
  const double split_s = 0.5 * (span.begin_s + span.end_s);
  PollTable half_table{.interval_s = table.interval_s, .regular = table.regular, .polls = {}};
  std::vector<AnchorFit> halves;  // of each suspect the earlier, then the later
  std::vector<std::size_t> suspects;
  for (std::size_t a = 0; a < fits.size(); ++a) {
    const AnchorFit& fit = fits[a];
    const std::span<const Observation> rows = fit.problem.rows;
    if (rows.empty() || fit.problem.position.surveyed) continue;
    const auto split = std::lower_bound(rows.begin(), rows.end(), split_s,
                                        [](const Observation& row, double t_s) { return row.t_s < t_s; });
    if (split - rows.begin() < kMinRows || rows.end() - split < kMinRows) continue;
    // With a sight, what a move makes of the ranges may have passed for blocked.
    if (sight.anchors.empty()) {
      const std::vector<Evidence> evidence{gather_evidence(fit)};
      if (score_inflation(evidence).front() < kSuspiciousInflation) continue;
    }
    suspects.push_back(a);
    const auto middle = static_cast<Poll>(split->index);
    for (const bool later : {false, true}) {
      AnchorFit& half = halves.emplace_back();
      half.problem = fit.problem;
      half.problem.sight = nullptr;
      half.problem.rows = later ? rows.subspan(static_cast<std::size_t>(split - rows.begin()))
                                : rows.first(static_cast<std::size_t>(split - rows.begin()));
      find_start(half);
      half_table.polls.push_back(
          cut(table.polls[a], later ? middle : 0, later ? std::numeric_limits<Poll>::max() : middle));
    }
  }
  if (halves.empty()) return out;
  refine_site(halves, priors, kRounds);
  SiteSight half_sight;
  if (!sight.anchors.empty()) half_sight = solve_sight(half_table, sight.model, halves, priors);

  std::vector<Evidence> evidence;
  evidence.reserve(halves.size());
  for (const AnchorFit& half : halves) evidence.push_back(gather_evidence(half));
  const std::vector<double> inflation = score_inflation(evidence);
  for (std::size_t k = 0; k < suspects.size(); ++k) {
    const std::size_t a = suspects[k];
    const std::size_t later = 2 * k + 1;
    const Eigen::Index size = wall_index(fits[a].problem.tag_count);
    const auto covariance = [&](std::size_t half) -> Eigen::MatrixXd {
      return anchor_covariance(evidence[half], inflation[half]).topLeftCorner(size, size);
    };
    const auto shift_of = [&] {
      return shift_between(halves[2 * k].anchor.head(size), covariance(2 * k),
                           halves[later].anchor.head(size), covariance(later));
    };
    const auto is_move = [](const Shift& shift) {
      return shift.square_sigmas > kMinSquareSigmas && shift.by_m.head<2>().norm() > kMinMove_m;
    };
    // Behind walls a bias and a move are one.
    const auto is_seen = [&](std::size_t half) {
      return half_sight.shares.empty() || half_sight.shares[half].polls(kInSight) > kMinInSight;
    };
    if (!is_seen(2 * k) || !is_seen(later)) continue;
    Shift shift = shift_of();
    if (is_move(shift)) {
      // Not so where one of the halves has but settled on another side of the tags.
      for (const std::size_t half : {2 * k, later}) {
        const TagSpread spread = tag_spread(halves[half].problem.rows);
        for (const int axis : {kAcrossLine, kAcrossPlane}) {
          static_cast<void>(challenge(halves[half], spread, axis));
        }
        evidence[half] = gather_evidence(halves[half]);
      }
      shift = shift_of();
    }
    if (!is_move(shift)) continue;
    out[a] = shift;
    fits[a] = std::move(halves[later]);
    if (sight.anchors.empty()) continue;
    sight.anchors[a] = std::move(half_sight.anchors[later]);
    sight.shares[a] = half_sight.shares[later];
    fits[a].problem.sight = &sight.anchors[a];
  }
  return out;
}

}  // namespace groma::calibration
