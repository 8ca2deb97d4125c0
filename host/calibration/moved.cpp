#include "host/calibration/moved.hpp"

#include <algorithm>
#include <iterator>
#include <limits>
#include <utility>

#include <Eigen/Cholesky>

#include "host/calibration/initial_guess.hpp"
#include "host/calibration/rival.hpp"
#include "host/calibration/second_place.hpp"
#include "host/calibration/uncertainty.hpp"

namespace groma::calibration {
namespace {

constexpr int kMovedRounds = 4;
constexpr int kLooks = 3;
constexpr int kStartingSteps = 6;
constexpr int kJoiningSteps = 20;
// A move is so far outside of what the two solutions can differ by.
constexpr double kMinSquareSigmas = 40.0;
// As many rows, each by itself, does a piece want as it tells unknowns of three tags, twice over.
constexpr double kLeastRowsByThemselves = 20.0;
// Share of polls in sight that each piece wants.
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

// Rows at which an anchor is somewhere else than before, and its twin's place. Few: each stretch is looked at
// once more.
struct Suspicion {
  std::vector<std::size_t> changes;         // by row
  std::vector<Eigen::Vector3d> places_m{};  // where it may have been
  std::optional<Eigen::Vector3d> twin_m;
};

// The rows at which the anchor was in sight, as replies and powers alone have it: behind walls a bias and a
// move are one, and what a move makes of residuals passes for a wall.
std::vector<Observation> rows_in_sight(std::span<const Observation> rows,
                                       std::span<const std::vector<Poll>> pairs, const SightModel& model) {
  if (rows.empty()) return {};
  const std::size_t first = rows.front().index;
  std::vector<bool> seen(rows.size(), false);
  SightPosterior posterior;
  std::vector<SightVector> likelihoods;
  for (const std::vector<Poll>& polls : pairs) {
    const auto with_row = std::count_if(polls.begin(), polls.end(), [](Poll poll) { return poll >= 0; });
    likelihoods.assign(static_cast<std::size_t>(with_row), SightVector::Ones());
    infer_sight(model.chain, polls, likelihoods, hints_of(classes_of(polls, rows), model.powers), posterior);
    std::size_t i = 0;
    for (const Poll poll : polls) {
      if (poll < 0) continue;
      seen[static_cast<std::size_t>(poll) - first] = posterior.posterior[i++](kInSight) > 0.5;
    }
  }
  std::vector<Observation> out;
  out.reserve(rows.size());
  std::copy_if(rows.begin(), rows.end(), std::back_inserter(out),
               [&](const Observation& row) { return seen[row.index - first]; });
  return out;
}

// `rows`: those of the fit that are to be looked at.
Suspicion suspect(const AnchorFit& fit, std::span<const Observation> rows, const model::RangePriors& priors) {
  Suspicion out;
  std::vector<AnchorFit> rest(1, fit);
  rest.front().problem.rows = rows;
  for (int look = 0; look < kLooks; ++look) {
    const std::optional<SecondPlace> second = find_second_place(rest.front());
    if (!second) break;
    if (second->torn_share > kTornShare) {
      if (look == 0) out.twin_m = second->place_m;
      break;
    }
    out.places_m.insert(out.places_m.end(), {second->usual_place_m, second->place_m});
    for (const std::size_t change : {second->first, second->last}) {
      if (change == 0 || change == rows.size()) continue;
      out.changes.push_back(rows[change].index - fit.problem.rows.front().index);
    }
    rows = rows.subspan(second->last < rows.size() ? second->last : second->first);
    rest.front().problem.rows = rows;
    rest.front().problem.sight = nullptr;
    find_start(rest.front());
    refine_site(rest, priors, kMovedRounds);
  }
  return out;
}

// One anchor's rows between two changes, and what they tell by themselves.
struct Piece {
  std::size_t anchor = 0;
  std::size_t begin = 0;  // row
};

// The pieces of all suspects, solved.
struct Pieces {
  std::vector<Piece> places;
  std::vector<AnchorFit> fits;
  std::vector<Evidence> evidence;
  std::vector<double> inflation;
  SiteSight sight;
};

// Starts from the place that explains the rows best: few rows have more valleys than one.
void start_at_best(AnchorFit& fit, std::span<const Eigen::Vector3d> places_m) {
  double least = std::numeric_limits<double>::infinity();
  for (const Eigen::Vector3d& place_m : places_m) {
    AnchorSolution solution =
        solve_anchor(fit.problem, fit.kernels, anchor_at(place_m, fit.problem.tag_count, fit.problem.priors),
                     kStartingSteps);
    if (solution.cost >= least) continue;
    least = solution.cost;
    fit.anchor = std::move(solution.anchor);
  }
}

Pieces solve_pieces(std::span<const Suspicion> suspicions, const PollTable& table, const SiteSight& sight,
                    std::span<const AnchorFit> fits, const model::RangePriors& priors) {
  Pieces out;
  PollTable piece_table{.interval_s = table.interval_s, .regular = table.regular, .polls = {}};
  for (std::size_t a = 0; a < fits.size(); ++a) {
    if (suspicions[a].changes.empty()) continue;
    const std::span<const Observation> rows = fits[a].problem.rows;
    for (std::size_t k = 0; k <= suspicions[a].changes.size(); ++k) {
      const std::size_t begin = k == 0 ? 0 : suspicions[a].changes[k - 1];
      const bool last = k == suspicions[a].changes.size();
      const std::size_t end = last ? rows.size() : suspicions[a].changes[k];
      AnchorFit& piece = out.fits.emplace_back();
      piece.problem = fits[a].problem;
      piece.problem.sight = nullptr;
      piece.problem.rows = rows.subspan(begin, end - begin);
      piece.kernels = fits[a].kernels;
      start_at_best(piece, suspicions[a].places_m);
      out.places.push_back({.anchor = a, .begin = begin});
      piece_table.polls.push_back(
          cut(table.polls[a], k == 0 ? 0 : static_cast<Poll>(rows[begin].index),
              last ? std::numeric_limits<Poll>::max() : static_cast<Poll>(rows[end].index)));
    }
  }
  if (out.fits.empty()) return out;
  refine_site(out.fits, priors, kMovedRounds);
  if (!sight.anchors.empty()) out.sight = solve_sight(piece_table, sight.model, out.fits, priors);
  for (const AnchorFit& piece : out.fits) out.evidence.push_back(gather_evidence(piece));
  out.inflation = score_inflation(out.evidence);
  return out;
}

Shift shift_to_next(const Pieces& pieces, std::size_t piece) {
  const Eigen::Index size = wall_index(pieces.fits[piece].problem.tag_count);
  // What hangs together in one piece does so in the other, though it may be too short to show it.
  const double inflation = std::max(pieces.inflation[piece], pieces.inflation[piece + 1]);
  const auto covariance = [&](std::size_t i) -> Eigen::MatrixXd {
    return anchor_covariance(pieces.evidence[i], inflation).topLeftCorner(size, size);
  };
  return shift_between(pieces.fits[piece].anchor.head(size), covariance(piece),
                       pieces.fits[piece + 1].anchor.head(size), covariance(piece + 1));
}

bool is_move(const Shift& shift) {
  return shift.square_sigmas > kMinSquareSigmas && shift.by_m.head<2>().norm() > kMinMove_m;
}

// By how much more one place for both pieces costs than each its own, twice, as chi square has it:
// covariances know the valley's floor near a solution, but few rows or a robot that stands leave a bent one.
double excess_of_one_place(const Pieces& pieces, std::size_t piece) {
  const AnchorFit& first = pieces.fits[piece];
  const AnchorFit& next = pieces.fits[piece + 1];
  AnchorProblem own = first.problem;
  own.sight = nullptr;
  AnchorProblem nexts = own;
  nexts.rows = next.problem.rows;
  AnchorProblem both = own;
  both.rows = {own.rows.data(), own.rows.size() + nexts.rows.size()};
  const std::vector<RobustKernel>& kernels =
      own.rows.size() > nexts.rows.size() ? first.kernels : next.kernels;
  const Eigen::Index size = wall_index(own.tag_count);
  const auto solve = [&](const AnchorProblem& problem, const AnchorVector& start, const AnchorVector& other) {
    AnchorSolution one = solve_anchor(problem, kernels, start, kJoiningSteps);
    AnchorSolution another = solve_anchor(problem, kernels, other, kJoiningSteps);
    return one.cost < another.cost ? one : another;
  };
  const AnchorVector here = first.anchor.head(size);
  const AnchorVector there = next.anchor.head(size);
  const AnchorSolution joined = solve(both, here, there);
  return 2.0 * (joined.cost - solve(own, here, joined.anchor).cost - solve(nexts, there, joined.anchor).cost);
}

// Between a piece and the next of the same anchor, if there was one.
std::optional<Shift> move_to_next(Pieces& pieces, std::size_t piece) {
  // Behind walls a bias and a move are one.
  for (const std::size_t i : {piece, piece + 1}) {
    if (!pieces.sight.shares.empty() && pieces.sight.shares[i].polls(kInSight) <= kMinInSight)
      return std::nullopt;
  }
  // Nor do a few rows tell of a place, or many that hang together as walls make them: of so many a piece has
  // to tell as if each were by itself.
  for (const std::size_t i : {piece, piece + 1}) {
    const auto rows = static_cast<double>(pieces.fits[i].problem.rows.size());
    if (rows < kLeastRowsByThemselves * pieces.inflation[i]) return std::nullopt;
  }
  Shift shift = shift_to_next(pieces, piece);
  if (!is_move(shift)) return std::nullopt;
  // Not so where one of the two has but settled on another side of the tags.
  for (const std::size_t i : {piece, piece + 1}) {
    const TagSpread spread = tag_spread(pieces.fits[i].problem.rows);
    for (const int axis : {kAcrossLine, kAcrossPlane}) {
      static_cast<void>(challenge(pieces.fits[i], spread, axis));
    }
    pieces.evidence[i] = gather_evidence(pieces.fits[i]);
  }
  shift = shift_to_next(pieces, piece);
  if (!is_move(shift)) return std::nullopt;
  const double inflation = std::max(pieces.inflation[piece], pieces.inflation[piece + 1]);
  if (excess_of_one_place(pieces, piece) < kMinSquareSigmas * inflation) return std::nullopt;
  return shift;
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

std::vector<AnchorPath> find_moved(const PollTable& table, SiteSight& sight, std::vector<AnchorFit>& fits,
                                   const model::RangePriors& priors) {
  std::vector<AnchorPath> out(fits.size());
  std::vector<Suspicion> suspicions(fits.size());
  for (std::size_t a = 0; a < fits.size(); ++a) {
    if (fits[a].problem.rows.empty() || fits[a].problem.position.surveyed) continue;
    // Without replies that were missed nothing tells of walls but residuals.
    const std::span<const Observation> rows = fits[a].problem.rows;
    suspicions[a] = (table.regular || sight.model.powers) && !sight.anchors.empty()
                        ? suspect(fits[a], rows_in_sight(rows, table.polls[a], sight.model), priors)
                        : suspect(fits[a], rows, priors);
    out[a].twin_m = suspicions[a].twin_m;
  }
  // A change that is none goes, and what it parted is solved as one.
  Pieces pieces;
  for (bool all_are_moves = false; !all_are_moves;) {
    all_are_moves = true;
    pieces = solve_pieces(suspicions, table, sight, fits, priors);
    for (std::size_t a = 0; a < fits.size(); ++a) {
      out[a].moves.clear();
      out[a].places_m.clear();
    }
    for (std::size_t i = 0; i < pieces.places.size(); ++i) {
      const std::size_t a = pieces.places[i].anchor;
      if (i + 1 < pieces.places.size() && pieces.places[i + 1].anchor == a) {
        const std::size_t row = pieces.places[i + 1].begin;
        if (const std::optional<Shift> shift = move_to_next(pieces, i)) {
          out[a].moves.push_back({.t_s = fits[a].problem.rows[row].t_s, .shift = *shift});
        } else {
          std::erase(suspicions[a].changes, row);
          all_are_moves = false;
        }
      }
      out[a].places_m.push_back(pieces.fits[i].anchor.head<3>());
    }
  }
  for (std::size_t i = 0; i < pieces.places.size(); ++i) {
    const std::size_t a = pieces.places[i].anchor;
    if (i + 1 < pieces.places.size() && pieces.places[i + 1].anchor == a) continue;
    fits[a] = std::move(pieces.fits[i]);
    if (sight.anchors.empty()) continue;
    sight.anchors[a] = std::move(pieces.sight.anchors[i]);
    sight.shares[a] = pieces.sight.shares[i];
    fits[a].problem.sight = &sight.anchors[a];
  }
  return out;
}

}  // namespace groma::calibration
