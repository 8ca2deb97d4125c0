#include "host/calibration/moved.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <limits>
#include <numeric>
#include <utility>

#include <Eigen/Cholesky>

#include "host/calibration/mirror.hpp"
#include "host/calibration/robust_kernel.hpp"
#include "host/calibration/site.hpp"
#include "host/calibration/site_solver.hpp"

namespace groma::calibration {
namespace {

// All constants of this file are by hand unless their origin is given; the Moved, SwappedIds and DuplicateId
// tests hold with them.
// A bin is half of the least stretch (kLeastStretchShare), and a quarter of kLeastStretchRows.
constexpr std::size_t kBins = 40;
constexpr std::size_t kRowsPerBin = 15;
// Huber threshold, in scales of the kernel: 0.3 % of LOS residuals are beyond (normal distribution).
constexpr double kHuberScales = 3.0;
constexpr double kLeastStretch_s = 10.0;
constexpr double kLeastStretchShare = 0.05;
// Prior sigma of a move, per axis: the size of a hall.
constexpr double kOpenShift_m = 10.0;
// A stretch with less gain is not tested: 60 of chi square with three degrees of freedom, 6e-13 by chance, as
// residuals are correlated and hundreds of stretches compete.
constexpr double kLeastGain = 30.0;
constexpr int kPlaceRounds = 4;  // bounds on time
constexpr int kRefinements = 3;
constexpr double kPreference = 0.5;  // nats per observation, on average
// An observation clearly prefers a place if its cost there is less by this: odds of 20 to 1.
constexpr double kClearlyBetter = 3.0;
// Least share of observations that the fit rejects, and of these, least share that another place explains.
constexpr double kRejectedShare = 0.2;
constexpr double kExplainedShare = 0.5;
constexpr double kExplainedScales = 3.0;  // 99.7 % (normal distribution)
constexpr double kFarPlace_m = 1.5;

struct Stretch {
  std::size_t first = 0;
  std::size_t last = 0;
  friend bool operator==(const Stretch&, const Stretch&) = default;
};

// Least number of observations in a stretch in which an anchor was elsewhere.
constexpr std::size_t kLeastStretchRows = 60;
struct SecondPlace {
  Stretch stretch;
  Eigen::Vector3d place_m = Eigen::Vector3d::Zero();        // in the stretch
  Eigen::Vector3d usual_place_m = Eigen::Vector3d::Zero();  // outside it
  // Among observations that clearly prefer a place: share of those on the wrong side of the stretch's ends.
  double torn_share = 0.0;
};
// Above this share no time separates the places: the id is in both.
constexpr double kTornShare = 0.2;

// Enough observations and time for a place of its own; with less, the cause is something other than a move.
bool is_enough(std::span<const Observation> rows, const Stretch& stretch) noexcept {
  if (stretch.last < stretch.first + kLeastStretchRows) return false;
  const double all_s = rows.back().t_s - rows.front().t_s;
  return rows[stretch.last - 1].t_s - rows[stretch.first].t_s >=
         std::max(kLeastStretch_s, kLeastStretchShare * all_s);
}
// Whether stretch and rest are each enough; the rest at either end of the drive is enough or empty.
bool is_separable(std::span<const Observation> rows, const Stretch& stretch) noexcept {
  const Stretch before{.first = 0, .last = stretch.first};
  const Stretch after{.first = stretch.last, .last = rows.size()};
  const auto is_whole = [&](const Stretch& side) { return side.first == side.last || is_enough(rows, side); };
  return is_enough(rows, stretch) && is_whole(before) && is_whole(after) &&
         (before.first < before.last || after.first < after.last);
}
// Extends a stretch to the drive's ends where too little would remain.
Stretch widened(std::span<const Observation> rows, Stretch stretch) noexcept {
  if (!is_enough(rows, {.first = 0, .last = stretch.first})) stretch.first = 0;
  if (!is_enough(rows, {.first = stretch.last, .last = rows.size()})) stretch.last = rows.size();
  return stretch;
}

Stretch largest_stretch(std::span<const double> values) {
  Stretch best;
  double largest = 0.0;
  double sum = 0.0;
  std::size_t first = 0;
  for (std::size_t i = 0; i < values.size(); ++i) {
    sum += values[i];
    if (sum > largest) {
      largest = sum;
      best = {.first = first, .last = i + 1};
    }
    if (sum > 0.0) continue;
    sum = 0.0;
    first = i + 1;
  }
  return best;
}

// By how much each observation prefers the anchor at `there`, as a cost difference with the kernels of
// `here`.
std::vector<double> preferences(std::span<const Observation> rows, const AnchorFit& here,
                                const AnchorVector& there) {
  const std::size_t tags = here.problem.tag_count;
  std::vector<double> out;
  out.reserve(rows.size());
  for (const Observation& row : rows) {
    const RobustKernel& kernel = here.kernels[row.tag];
    out.push_back(std::log(kernel.at(residual_m(row, there, tags)).density /
                           kernel.at(residual_m(row, here.anchor, tags)).density));
  }
  return out;
}

// Solves some observations separately: with a search and without NLOS states.
AnchorFit solve_alone(const AnchorProblem& problem, std::span<const Observation> rows, int rounds) {
  AnchorFit out;
  out.problem = problem;
  out.problem.rows = rows;
  out.problem.los_states = nullptr;
  find_start(out);
  refine_site({&out, 1}, rounds);
  return out;
}

// The fit with the position of the stretch, given the biases of `here`.
AnchorFit place_of_stretch(const AnchorFit& here, std::span<const Observation> stretch) {
  const std::size_t tags = here.problem.tag_count;
  std::vector<Observation> rows(stretch.begin(), stretch.end());
  for (Observation& row : rows) {
    const model::TermVector terms = terms_of(here.anchor, row.tag, tags);
    const Eigen::Vector3d direction = predict(row, here.anchor, tags).direction;
    row.range_m = (row.range_m - model::offset_m(terms, direction)) / model::scale_of(terms);
  }
  AnchorProblem problem = here.problem;
  for (const model::PairTerm& term : model::kPairTerms)
    problem.priors.*term.prior = {.mean = term.neutral, .sigma = term.moved_sigma};
  AnchorFit out = here;
  out.anchor.head<3>() = solve_alone(problem, rows, kRefinements).anchor.head<3>();
  return out;
}

// As SecondPlace::torn_share.
double torn_share(std::span<const double> prefer_there, const Stretch& stretch) {
  double clear = 0.0;
  double torn = 0.0;
  for (std::size_t i = 0; i < prefer_there.size(); ++i) {
    if (std::abs(prefer_there[i]) < kClearlyBetter) continue;
    clear += 1.0;
    const bool inside = i >= stretch.first && i < stretch.last;
    torn += inside != (prefer_there[i] > 0.0) ? 1.0 : 0.0;
  }
  return clear > 0.0 ? torn / clear : 0.0;
}

// Whether the observations inside and outside prefer their own place, each on average.
bool prefers_each(std::span<const double> prefer_there, const Stretch& stretch) {
  const auto begin = prefer_there.begin();
  const auto first = begin + static_cast<std::ptrdiff_t>(stretch.first);
  const auto last = begin + static_cast<std::ptrdiff_t>(stretch.last);
  const double inside = std::accumulate(first, last, 0.0);
  const double outside = std::accumulate(begin, first, 0.0) + std::accumulate(last, prefer_there.end(), 0.0);
  const auto rows_inside = static_cast<double>(stretch.last - stretch.first);
  const double rows_outside = static_cast<double>(prefer_there.size()) - rows_inside;
  return inside > kPreference * rows_inside && -outside > kPreference * rows_outside;
}

double apart_in_range_m(std::span<const Observation> rows, const AnchorFit& here, const AnchorFit& there) {
  const std::size_t tags = here.problem.tag_count;
  double sum_m2 = 0.0;
  for (const Observation& row : rows) {
    const double apart_m =
        predict(row, there.anchor, tags).distance_m - predict(row, here.anchor, tags).distance_m;
    sum_m2 += apart_m * apart_m;
  }
  return std::sqrt(sum_m2 / static_cast<double>(rows.size()));
}

// Alternates between solving two places, that of the stretch and that of the rest, and finding the stretch
// that prefers its own place.
std::optional<SecondPlace> separate(const AnchorProblem& problem, Stretch stretch) {
  const std::span<const Observation> rows = problem.rows;
  SecondPlace out;
  std::vector<double> prefer_there;
  double apart_m = 0.0;
  for (int round = 0; round < kPlaceRounds; ++round) {
    if (!is_separable(rows, stretch)) return std::nullopt;
    const auto inside = rows.subspan(stretch.first, stretch.last - stretch.first);
    std::vector<Observation> outside(rows.begin(), inside.begin());
    outside.insert(outside.end(), inside.end(), rows.end());
    const AnchorFit here = solve_alone(problem, outside, kRefinements);
    const AnchorFit there = place_of_stretch(here, inside);
    apart_m = apart_in_range_m(inside, here, there);
    out.usual_place_m = here.anchor.head<3>();
    out.place_m = there.anchor.head<3>();
    prefer_there = preferences(rows, here, there.anchor);
    const Stretch before = std::exchange(stretch, widened(rows, largest_stretch(prefer_there)));
    if (stretch == before) break;
  }
  if (!is_separable(rows, stretch)) return std::nullopt;
  // The ranges have to differ too: a stationary robot measured a single direction.
  if (std::min((out.place_m - out.usual_place_m).head<2>().norm(), apart_m) < kMinMove_m) return std::nullopt;
  out.stretch = stretch;
  out.torn_share = torn_share(prefer_there, stretch);
  return prefers_each(prefer_there, stretch) ? std::optional(out) : std::nullopt;
}

// Solution of the observations that the fit rejects, if they share a place far from the fit's.
std::optional<AnchorVector> find_far_place(const AnchorFit& fit) {
  std::vector<Observation> rejected;
  const std::size_t tags = fit.problem.tag_count;
  for (const Observation& row : fit.problem.rows) {
    if (fit.kernels[row.tag].shares(residual_m(row, fit.anchor, tags)).los() < 0.5) rejected.push_back(row);
  }
  const auto least = std::max(static_cast<double>(kLeastStretchRows),
                              kRejectedShare * static_cast<double>(fit.problem.rows.size()));
  if (static_cast<double>(rejected.size()) < least) return std::nullopt;
  const AnchorFit far = solve_alone(fit.problem, rejected, 0);
  if ((far.anchor.head<3>() - fit.anchor.head<3>()).norm() < kFarPlace_m) return std::nullopt;
  const auto explained = std::count_if(rejected.begin(), rejected.end(), [&](const Observation& row) {
    return std::abs(residual_m(row, far.anchor, tags)) <
           kExplainedScales * fit.kernels[row.tag].shape().scale_m;
  });
  if (static_cast<double>(explained) < kExplainedShare * static_cast<double>(rejected.size()))
    return std::nullopt;
  return far.anchor;
}

// None if one place explains the observations as well. The fit gives start and scale.
std::optional<SecondPlace> find_second_place(const AnchorFit& fit) {
  const std::size_t rows = fit.problem.rows.size();
  if (rows < 2 * kLeastStretchRows) return std::nullopt;
  if (const std::optional<AnchorVector> far = find_far_place(fit)) {
    std::vector<double> prefer = preferences(fit.problem.rows, fit, *far);
    Stretch stretch = largest_stretch(prefer);
    double torn = torn_share(prefer, stretch);
    // The stretch may be that of the fit's own place, in the middle of the other's.
    for (double& value : prefer) value = -value;
    const Stretch own = largest_stretch(prefer);
    if (const double torn_own = torn_share(prefer, own); torn_own < torn) {
      torn = torn_own;
      stretch = own;
    }
    if (torn > kTornShare) {
      return SecondPlace{.stretch = stretch,
                         .place_m = far->head<3>(),
                         .usual_place_m = fit.anchor.head<3>(),
                         .torn_share = torn};
    }
    if (auto separated = separate(fit.problem, widened(fit.problem.rows, stretch))) return separated;
  }
  const StretchGains gains(fit, std::min(kBins, rows / kRowsPerBin));
  Stretch best;
  double largest = kLeastGain;
  for (std::size_t from = 0; from + 1 < gains.first_row.size(); ++from) {
    for (std::size_t to = from + 1; to < gains.first_row.size(); ++to) {
      const Stretch stretch{.first = gains.first_row[from], .last = gains.first_row[to]};
      if (!is_separable(fit.problem.rows, stretch)) continue;
      const double gain = gains.gain(from, to);
      if (gain <= largest) continue;
      largest = gain;
      best = stretch;
    }
  }
  return separate(fit.problem, best);
}

// Bounds on time.
constexpr int kMovedRounds = 4;
constexpr int kAttempts = 3;
constexpr int kPieceSteps = 6;
constexpr int kJoiningSteps = 20;
// A move has at least this squared Mahalanobis distance between the two solutions: 1e-8 by chance (chi
// square, three degrees of freedom), as covariances of pieces are too small where errors depend on the place.
constexpr double kMinSquareSigmas = 40.0;
// A piece needs at least twice as many independent ranges as it has unknowns (three tags: 9).
constexpr double kLeastRowsByThemselves = 20.0;
constexpr double kMinLos = 0.2;  // share of a piece's polls

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

// Observations at which an anchor may have moved, and the place of a duplicate id. Only few: each stretch is
// tested again.
struct Suspicion {
  std::vector<std::size_t> changes;         // indices of observations
  std::vector<Eigen::Vector3d> places_m{};  // where it may have been
  std::optional<Eigen::Vector3d> duplicate_m;
};

Suspicion suspect(const AnchorFit& fit, std::span<const Observation> rows) {
  Suspicion out;
  AnchorFit rest = fit;
  rest.problem.rows = rows;
  for (int attempt = 0; attempt < kAttempts; ++attempt) {
    const std::optional<SecondPlace> second = find_second_place(rest);
    if (!second) break;
    if (second->torn_share > kTornShare) {
      if (attempt == 0) out.duplicate_m = second->place_m;
      break;
    }
    out.places_m.insert(out.places_m.end(), {second->usual_place_m, second->place_m});
    for (const std::size_t change : {second->stretch.first, second->stretch.last}) {
      if (change == 0 || change == rows.size()) continue;
      out.changes.push_back(rows[change].index - fit.problem.rows.front().index);
    }
    rows = rows.subspan(second->stretch.last < rows.size() ? second->stretch.last : second->stretch.first);
    rest = solve_alone(fit.problem, rows, kMovedRounds);
  }
  return out;
}

// The parts of the drive before, between and after an anchor's changes, one anchor after the other.
struct Pieces {
  std::vector<std::size_t> anchors;  // of each piece
  std::vector<AnchorFit> fits;
  SiteLos los_states;

  // Whether the next piece is of the same anchor.
  [[nodiscard]] bool has_next(std::size_t piece) const noexcept {
    return piece + 1 < anchors.size() && anchors[piece + 1] == anchors[piece];
  }
};

// Starts from the place that explains the observations best: few observations have several basins.
void start_at_best(AnchorFit& fit, std::span<const Eigen::Vector3d> places_m) {
  double least = std::numeric_limits<double>::infinity();
  for (const Eigen::Vector3d& place_m : places_m) {
    AnchorSolution solution = solve_anchor(
        fit.problem, fit.kernels, anchor_at(place_m, fit.problem.tag_count, fit.problem.priors), kPieceSteps);
    if (solution.cost >= least) continue;
    least = solution.cost;
    fit.anchor = std::move(solution.anchor);
  }
}

Pieces solve_pieces(std::span<const Suspicion> suspicions, const PollTable& table, const SiteLos& los_states,
                    std::span<const AnchorFit> fits) {
  Pieces out;
  PollTable piece_table{.interval_s = table.interval_s, .regular = table.regular};
  for (std::size_t a = 0; a < fits.size(); ++a) {
    if (suspicions[a].changes.empty()) continue;
    const std::span<const Observation> rows = fits[a].problem.rows;
    const std::vector<std::size_t>& changes = suspicions[a].changes;
    for (std::size_t k = 0; k <= changes.size(); ++k) {
      const std::size_t begin = k == 0 ? 0 : changes[k - 1];
      const bool last = k == changes.size();
      const std::size_t end = last ? rows.size() : changes[k];
      AnchorFit& piece = out.fits.emplace_back(fits[a]);
      piece.problem.los_states = nullptr;
      piece.problem.rows = rows.subspan(begin, end - begin);
      start_at_best(piece, suspicions[a].places_m);
      out.anchors.push_back(a);
      piece_table.polls.push_back(
          cut(table.polls[a], k == 0 ? 0 : static_cast<Poll>(rows[begin].index),
              last ? std::numeric_limits<Poll>::max() : static_cast<Poll>(rows[end].index)));
    }
  }
  if (out.fits.empty()) return out;
  refine_site(out.fits, kMovedRounds);
  if (!los_states.anchors.empty()) out.los_states = solve_los(piece_table, los_states.model, out.fits);
  gather_evidence(out.fits);
  estimate_inflation(out.fits);
  return out;
}

// Shift to the next piece; none if it is too small for a move or not significant.
std::optional<Shift> clear_shift(const Pieces& pieces, std::size_t piece) {
  const Eigen::Index size = excess_index(pieces.fits[piece].problem.tag_count);
  // Residuals correlated in one piece are so in the other, even if it is too short to show it.
  const double inflation = std::max(pieces.fits[piece].inflation, pieces.fits[piece + 1].inflation);
  const auto covariance = [&](std::size_t i) -> Eigen::MatrixXd {
    return anchor_covariance(pieces.fits[i].evidence, inflation).topLeftCorner(size, size);
  };
  const Shift shift = shift_between(pieces.fits[piece].anchor.head(size), covariance(piece),
                                    pieces.fits[piece + 1].anchor.head(size), covariance(piece + 1));
  const bool moved = shift.square_sigmas > kMinSquareSigmas && shift.by_m.head<2>().norm() > kMinMove_m;
  return moved ? std::optional(shift) : std::nullopt;
}

// Twice the extra cost of one place for both pieces over a place for each (chi square): covariances describe
// the basin near a solution, but few observations, or a stationary robot, leave a curved one.
double excess_of_one_place(const Pieces& pieces, std::size_t piece) {
  const AnchorFit& first = pieces.fits[piece];
  const AnchorFit& next = pieces.fits[piece + 1];
  AnchorProblem own = first.problem;
  own.los_states = nullptr;
  AnchorProblem nexts = own;
  nexts.rows = next.problem.rows;
  AnchorProblem both = own;
  both.rows = {own.rows.data(), own.rows.size() + nexts.rows.size()};
  const std::vector<RobustKernel>& kernels =
      own.rows.size() > nexts.rows.size() ? first.kernels : next.kernels;
  const Eigen::Index size = excess_index(own.tag_count);
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

std::optional<Shift> move_to_next(Pieces& pieces, std::size_t piece) {
  for (const std::size_t i : {piece, piece + 1}) {
    // A bias and a move cannot be distinguished in long NLOS.
    if (!pieces.los_states.poll_shares.empty() && pieces.los_states.poll_shares[i](kLos) <= kMinLos)
      return std::nullopt;
    const auto rows = static_cast<double>(pieces.fits[i].problem.rows.size());
    if (rows < kLeastRowsByThemselves * pieces.fits[i].inflation) return std::nullopt;
  }
  if (!clear_shift(pieces, piece)) return std::nullopt;
  // Not a move if one of the two only settled on another side of the tags.
  for (const std::size_t i : {piece, piece + 1}) {
    test_both_mirrors(pieces.fits[i]);
    gather_evidence({&pieces.fits[i], 1});
  }
  std::optional<Shift> shift = clear_shift(pieces, piece);
  const double inflation = std::max(pieces.fits[piece].inflation, pieces.fits[piece + 1].inflation);
  if (shift && excess_of_one_place(pieces, piece) < kMinSquareSigmas * inflation) return std::nullopt;
  return shift;
}

}  // namespace

StretchGains::StretchGains(const AnchorFit& fit, std::size_t bins) {
  const std::size_t tags = fit.problem.tag_count;
  const Eigen::Index size = excess_index(tags);
  const std::span<const Observation> rows = fit.problem.rows;
  const AnchorVector anchor = fit.anchor.head(size);
  std::vector<Columns> cross;
  AnchorProblem alone = fit.problem;
  alone.los_states = nullptr;
  Eigen::MatrixXd all = information_of_priors(alone);
  const AnchorVector offset = anchor - anchor_at(alone.position.mean_m, tags, alone.priors);
  Eigen::VectorXd gradient = all.diagonal().cwiseProduct(offset);
  gradient.head<3>() = alone.position.information * offset.head<3>();
  information_.assign(bins + 1, Eigen::Matrix3d::Zero());
  gradient_.assign(bins + 1, Eigen::Vector3d::Zero());
  first_row.reserve(bins + 1);
  cross.reserve(bins);
  std::vector<PairBlock> blocks(tags);
  std::vector<PairRow> slopes(tags);
  for (std::size_t bin = 0; bin < bins; ++bin) {
    first_row.push_back(bin * rows.size() / bins);
    std::fill(blocks.begin(), blocks.end(), PairBlock::Zero());
    std::fill(slopes.begin(), slopes.end(), PairRow::Zero());
    for (const Observation& row :
         rows.subspan(first_row.back(), (bin + 1) * rows.size() / bins - first_row.back())) {
      const RowAt at = row_at(fit, row);
      const double scale_m = fit.kernels[row.tag].shape().scale_m;
      const double u = at.residual_m / scale_m;
      const double share = std::min(1.0, kHuberScales / std::max(std::abs(u), 1e-9));
      add_square(at.j, share / (scale_m * scale_m), blocks[row.tag]);
      slopes[row.tag] -= share * u / scale_m * at.j;
    }
    information_[bin + 1] = information_[bin];
    gradient_[bin + 1] = gradient_[bin];
    Columns& by_position = cross.emplace_back(size, 3);
    by_position.setZero();
    for (std::size_t tag = 0; tag < tags; ++tag) {
      const PairBlock block = blocks[tag].selfadjointView<Eigen::Lower>();
      const PairIndex index = pair_index(tag, tags);
      gradient(index) += slopes[tag];
      by_position(index, Eigen::all) += block.leftCols<3>();
      all(index, index) += block;
      information_[bin + 1] += block.topLeftCorner<3, 3>();
      gradient_[bin + 1] += slopes[tag].head<3>();
    }
  }
  first_row.push_back(rows.size());
  const Eigen::LLT<Eigen::MatrixXd> factors(all);
  half_gradient_ = factors.matrixL().solve(gradient);
  half_cross_.reserve(bins + 1);
  half_cross_.emplace_back(size, 3).setZero();
  for (const Columns& of_bin : cross) {
    Columns sum = factors.matrixL().solve(of_bin);
    sum += half_cross_.back();
    half_cross_.push_back(std::move(sum));
  }
}

double StretchGains::gain(std::size_t from, std::size_t to) const {
  const Columns cross = half_cross_[to] - half_cross_[from];
  Eigen::Matrix3d information = information_[to] - information_[from] - cross.transpose() * cross;
  information.diagonal().array() += 1.0 / (kOpenShift_m * kOpenShift_m);
  const Eigen::Vector3d gradient = gradient_[to] - gradient_[from] - cross.transpose() * half_gradient_;
  return 0.5 * gradient.dot(information.ldlt().solve(gradient));
}

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

void find_moved(Site& site) {
  const PollTable& table = site.polls;
  SiteLos& los_states = site.los_states;
  std::vector<AnchorFit>& fits = site.fits;
  std::vector<Suspicion> suspicions(fits.size());
  for (std::size_t a = 0; a < fits.size(); ++a) {
    if (fits[a].problem.rows.empty() || fits[a].problem.position.surveyed) continue;
    const std::span<const Observation> rows = fits[a].problem.rows;
    // Only observations that replies and powers alone classify as LOS: in long NLOS a bias and a move cannot
    // be distinguished, and a move looks like NLOS in the residuals. Without missed replies and powers there
    // are only residuals.
    std::vector<Observation> examined(rows.begin(), rows.end());
    if ((table.regular || los_states.model.powers) && !los_states.anchors.empty()) {
      const std::vector<bool> seen = los_rows(los_states.model, table.polls[a], rows);
      std::erase_if(examined, [&](const Observation& row) { return !seen[row.index - rows.front().index]; });
    }
    suspicions[a] = suspect(fits[a], examined);
    site.evidence[a].path.duplicate_m = suspicions[a].duplicate_m;
  }
  // Drops a change that is no move; what it separated is solved as one.
  Pieces pieces;
  for (bool all_are_moves = false; !all_are_moves;) {
    all_are_moves = true;
    pieces = solve_pieces(suspicions, table, los_states, fits);
    for (AnchorEvidence& evidence : site.evidence) {
      evidence.path.moved_at_s.clear();
      evidence.path.places_m.clear();
    }
    for (std::size_t i = 0; i < pieces.fits.size(); ++i) {
      const std::size_t a = pieces.anchors[i];
      AnchorPath& path = site.evidence[a].path;
      if (pieces.has_next(i)) {
        const Observation& change = pieces.fits[i + 1].problem.rows.front();
        if (const std::optional<Shift> shift = move_to_next(pieces, i)) {
          path.moved_at_s.push_back(change.t_s);
          path.last_move_m = shift->by_m;
        } else {
          std::erase(suspicions[a].changes, change.index - fits[a].problem.rows.front().index);
          all_are_moves = false;
        }
      }
      path.places_m.push_back(pieces.fits[i].anchor.head<3>());
    }
  }
  for (std::size_t i = 0; i < pieces.fits.size(); ++i) {
    if (pieces.has_next(i)) continue;
    const std::size_t a = pieces.anchors[i];
    fits[a] = std::move(pieces.fits[i]);
    if (los_states.anchors.empty()) continue;
    los_states.anchors[a] = std::move(pieces.los_states.anchors[i]);
    los_states.poll_shares[a] = pieces.los_states.poll_shares[i];
    fits[a].problem.los_states = &los_states.anchors[a];
  }
}

}  // namespace groma::calibration
