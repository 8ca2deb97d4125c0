#include "host/calibration/second_place.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <utility>

#include <Eigen/Cholesky>

namespace groma::calibration {
namespace {

constexpr std::size_t kBins = 40;
constexpr std::size_t kRowsPerBin = 15;
// Beyond so many scales a residual pulls no harder.
constexpr double kHuberScales = 3.0;
constexpr double kLeastStretch_s = 10.0;
constexpr double kLeastStretchShare = 0.05;
// What is left of the biases' priors where those of the other place are known.
constexpr double kBetaAgain_m = 0.02;
constexpr double kGammaAgain = 5e-4;
// How far an anchor is thought to go.
constexpr double kOpenShift_m = 10.0;
// A stretch that gains less is not looked at.
constexpr double kLeastGain = 30.0;
// Two places are apart by this in the plane, and by as much in the ranges of the stretch: a robot that stood
// there tells of the one direction alone, and any place in the others would do.
constexpr double kApart_m = 0.15;
constexpr int kPlaceRounds = 4;
constexpr int kRefinements = 3;
// A row prefers its own place by this, on average.
constexpr double kPreference = 0.5;
// A row is clearly of one place where its cost there is less by this.
constexpr double kClearlyBetter = 3.0;
// Rows that the one place does not explain, of which the larger part has another in common.
constexpr double kRejectedShare = 0.2;
constexpr double kExplainedShare = 0.5;
constexpr double kExplainedScales = 3.0;
constexpr double kFarPlace_m = 1.5;

struct Stretch {
  std::size_t first = 0;
  std::size_t last = 0;
  friend bool operator==(const Stretch&, const Stretch&) = default;
};

// Enough rows and time for a place of their own; where there is less, other things than a move make it.
bool is_enough(std::span<const Observation> rows, const Stretch& stretch) noexcept {
  if (stretch.last < stretch.first + kLeastStretchRows) return false;
  const double all_s = rows.back().t_s - rows.front().t_s;
  return rows[stretch.last - 1].t_s - rows[stretch.first].t_s >=
         std::max(kLeastStretch_s, kLeastStretchShare * all_s);
}
// The same of what is inside and of what is outside; what is left at the drive's ends has to be either enough
// or nothing.
bool is_parted(std::span<const Observation> rows, const Stretch& stretch) noexcept {
  const Stretch before{.first = 0, .last = stretch.first};
  const Stretch after{.first = stretch.last, .last = rows.size()};
  const auto is_whole = [&](const Stretch& side) { return side.first == side.last || is_enough(rows, side); };
  return is_enough(rows, stretch) && is_whole(before) && is_whole(after) &&
         (before.first < before.last || after.first < after.last);
}
// Up to the drive's ends where too little would be left.
Stretch widened(std::span<const Observation> rows, Stretch stretch) noexcept {
  if (!is_enough(rows, {.first = 0, .last = stretch.first})) stretch.first = 0;
  if (!is_enough(rows, {.first = stretch.last, .last = rows.size()})) stretch.last = rows.size();
  return stretch;
}

AnchorVector without_walls(const AnchorFit& fit) {
  return fit.anchor.head(wall_index(fit.problem.tag_count));
}

// With the largest sum.
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

// Of each row, how much cheaper it is where the anchor is there than where it is here.
std::vector<double> preferences(std::span<const Observation> rows, const AnchorFit& here,
                                const AnchorFit& there) {
  const std::size_t tags = here.problem.tag_count;
  std::vector<double> out;
  out.reserve(rows.size());
  for (const Observation& row : rows) {
    const RobustKernel& kernel = here.kernels[row.tag];
    out.push_back(std::log(kernel.at(residual_m(row, there.anchor, tags)).density /
                           kernel.at(residual_m(row, here.anchor, tags)).density));
  }
  return out;
}

// The place that the rows have with the biases of `here`.
AnchorFit place_of_stretch(const AnchorFit& here, std::span<const Observation> stretch) {
  const std::size_t tags = here.problem.tag_count;
  std::vector<Observation> rows(stretch.begin(), stretch.end());
  for (Observation& row : rows) {
    row.range_m = (row.range_m - here.anchor(beta_index(row.tag))) / here.anchor(gamma_index(row.tag, tags));
  }
  std::vector<AnchorFit> there(1, here);
  there.front().problem.rows = rows;
  there.front().problem.priors.beta_m = {.mean = 0.0, .sigma = kBetaAgain_m};
  there.front().problem.priors.gamma = {.mean = 1.0, .sigma = kGammaAgain};
  find_start(there.front());
  refine_site(there, there.front().problem.priors, kRefinements);
  AnchorFit out = here;
  for (Eigen::Index i = 0; i < 3; ++i) out.anchor(i) = there.front().anchor(i);
  return out;
}

// Of the rows that clearly prefer a place: those on the wrong side of the stretch's ends.
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

// Whether the rows of both sides speak for their own place, each on average.
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

// Root mean square of what the ranges differ by between the places.
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

// The rows solved as of two places, the stretch's and that of the others; then the stretch that prefers the
// one, and so on.
std::optional<SecondPlace> part(const AnchorProblem& problem, Stretch stretch) {
  const std::span<const Observation> rows = problem.rows;
  SecondPlace out;
  std::vector<double> prefer_there;
  double apart_m = 0.0;
  for (int round = 0; round < kPlaceRounds; ++round) {
    if (!is_parted(rows, stretch)) return std::nullopt;
    std::vector<Observation> outside(rows.begin(), rows.begin() + static_cast<std::ptrdiff_t>(stretch.first));
    outside.insert(outside.end(), rows.begin() + static_cast<std::ptrdiff_t>(stretch.last), rows.end());
    std::vector<AnchorFit> here(1);
    here.front().problem = problem;
    here.front().problem.sight = nullptr;
    here.front().problem.rows = outside;
    find_start(here.front());
    refine_site(here, problem.priors, kRefinements);
    const AnchorFit there =
        place_of_stretch(here.front(), rows.subspan(stretch.first, stretch.last - stretch.first));
    apart_m =
        apart_in_range_m(rows.subspan(stretch.first, stretch.last - stretch.first), here.front(), there);
    out.usual_place_m = here.front().anchor.head<3>();
    out.place_m = there.anchor.head<3>();
    prefer_there = preferences(rows, here.front(), there);
    const Stretch before = std::exchange(stretch, widened(rows, largest_stretch(prefer_there)));
    if (stretch == before) break;
  }
  if (!is_parted(rows, stretch)) return std::nullopt;
  if ((out.place_m - out.usual_place_m).head<2>().norm() < kApart_m || apart_m < kApart_m)
    return std::nullopt;
  out.first = stretch.first;
  out.last = stretch.last;
  out.torn_share = torn_share(prefer_there, stretch);
  return prefers_each(prefer_there, stretch) ? std::optional(out) : std::nullopt;
}

// Where the rows that the fit rejects have a place in common, far from the fit's.
std::optional<AnchorFit> find_far_place(const AnchorFit& fit) {
  AnchorFit far;
  far.problem = fit.problem;
  far.problem.sight = nullptr;
  std::vector<Observation> rejected;
  const std::size_t tags = fit.problem.tag_count;
  for (const Observation& row : fit.problem.rows) {
    if (fit.kernels[row.tag].shares(residual_m(row, fit.anchor, tags)).in_sight() < 0.5)
      rejected.push_back(row);
  }
  const auto least = std::max(static_cast<double>(kLeastStretchRows),
                              kRejectedShare * static_cast<double>(fit.problem.rows.size()));
  if (static_cast<double>(rejected.size()) < least) return std::nullopt;
  far.problem.rows = rejected;
  find_start(far);
  if ((far.anchor.head<3>() - fit.anchor.head<3>()).norm() < kFarPlace_m) return std::nullopt;
  const auto explained = std::count_if(rejected.begin(), rejected.end(), [&](const Observation& row) {
    return std::abs(residual_m(row, far.anchor, tags)) <
           kExplainedScales * fit.kernels[row.tag].shape().scale_m;
  });
  if (static_cast<double>(explained) < kExplainedShare * static_cast<double>(rejected.size()))
    return std::nullopt;
  return far;
}

}  // namespace

StretchGains::StretchGains(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                           const AnchorVector& anchor, std::size_t bins) {
  const std::size_t tags = problem.tag_count;
  const Eigen::Index size = wall_index(tags);
  const std::span<const Observation> rows = problem.rows;
  std::vector<Columns> cross;
  AnchorProblem alone = problem;
  alone.sight = nullptr;
  Eigen::MatrixXd all = information_of_priors(alone);
  Eigen::VectorXd gradient = Eigen::VectorXd::Zero(size);
  const Eigen::Vector3d by_prior =
      problem.position.information * (anchor.head<3>() - problem.position.mean_m);
  for (Eigen::Index i = 0; i < 3; ++i) gradient(i) = by_prior(i);
  for (std::size_t tag = 0; tag < tags; ++tag) {
    const Eigen::Index beta = beta_index(tag);
    const Eigen::Index gamma = gamma_index(tag, tags);
    gradient(beta) = all(beta, beta) * (anchor(beta) - problem.priors.beta_m.mean);
    gradient(gamma) = all(gamma, gamma) * (anchor(gamma) - problem.priors.gamma.mean);
  }
  information_.assign(bins + 1, Eigen::Matrix3d::Zero());
  gradient_.assign(bins + 1, Eigen::Vector3d::Zero());
  first_row_.reserve(bins + 1);
  cross.reserve(bins);
  std::vector<PairBlock> blocks(tags);
  std::vector<PairRow> slopes(tags);
  for (std::size_t bin = 0; bin < bins; ++bin) {
    first_row_.push_back(bin * rows.size() / bins);
    std::fill(blocks.begin(), blocks.end(), PairBlock::Zero());
    std::fill(slopes.begin(), slopes.end(), PairRow::Zero());
    for (const Observation& row :
         rows.subspan(first_row_.back(), (bin + 1) * rows.size() / bins - first_row_.back())) {
      const model::AntennaPrediction predicted = predict(row, anchor, tags);
      const double scale_m = kernels[row.tag].shape().scale_m;
      const double u = (row.range_m - predicted.range_m) / scale_m;
      const double share = std::min(1.0, kHuberScales / std::max(std::abs(u), 1e-9));
      const PairRow j = pair_jacobian(predicted, anchor(gamma_index(row.tag, tags)));
      add_square(j, share / (scale_m * scale_m), blocks[row.tag]);
      slopes[row.tag] -= share * u / scale_m * j;
    }
    information_[bin + 1] = information_[bin];
    gradient_[bin + 1] = gradient_[bin];
    Columns& by_position = cross.emplace_back(size, 3);
    by_position.setZero();
    for (std::size_t tag = 0; tag < tags; ++tag) {
      const PairBlock block = blocks[tag].selfadjointView<Eigen::Lower>();
      const std::array<Eigen::Index, 5> index{0, 1, 2, beta_index(tag), gamma_index(tag, tags)};
      for (Eigen::Index i = 0; i < 5; ++i) {
        const Eigen::Index at = index[static_cast<std::size_t>(i)];
        gradient(at) += slopes[tag](i);
        for (Eigen::Index k = 0; k < 3; ++k) by_position(at, k) += block(i, k);
        for (Eigen::Index k = 0; k < 5; ++k) all(at, index[static_cast<std::size_t>(k)]) += block(i, k);
      }
      information_[bin + 1] += block.topLeftCorner<3, 3>();
      gradient_[bin + 1] += slopes[tag].head<3>();
    }
  }
  first_row_.push_back(rows.size());
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

std::optional<SecondPlace> find_second_place(const AnchorFit& fit) {
  const std::size_t rows = fit.problem.rows.size();
  if (rows < 2 * kLeastStretchRows) return std::nullopt;
  if (const std::optional<AnchorFit> far = find_far_place(fit)) {
    std::vector<double> prefer = preferences(fit.problem.rows, fit, *far);
    Stretch stretch = largest_stretch(prefer);
    double torn = torn_share(prefer, stretch);
    // The stretch may be that of the fit's own place, in the midst of the other's.
    for (double& value : prefer) value = -value;
    const Stretch own = largest_stretch(prefer);
    if (const double torn_own = torn_share(prefer, own); torn_own < torn) {
      torn = torn_own;
      stretch = own;
    }
    if (torn > kTornShare) {
      return SecondPlace{.first = stretch.first,
                         .last = stretch.last,
                         .place_m = far->anchor.head<3>(),
                         .usual_place_m = fit.anchor.head<3>(),
                         .torn_share = torn};
    }
    if (auto parted = part(fit.problem, widened(fit.problem.rows, stretch))) return parted;
  }
  const StretchGains gains(fit.problem, fit.kernels, without_walls(fit), std::min(kBins, rows / kRowsPerBin));
  Stretch best;
  double largest = kLeastGain;
  for (std::size_t from = 0; from < gains.bins(); ++from) {
    for (std::size_t to = from + 1; to <= gains.bins(); ++to) {
      const Stretch stretch{.first = gains.first_row(from), .last = gains.first_row(to)};
      if (!is_parted(fit.problem.rows, stretch)) continue;
      const double gain = gains.gain(from, to);
      if (gain <= largest) continue;
      largest = gain;
      best = stretch;
    }
  }
  return part(fit.problem, best);
}

}  // namespace groma::calibration
