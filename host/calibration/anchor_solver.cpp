#include "host/calibration/anchor_solver.hpp"

#include <cmath>
#include <limits>
#include <utility>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// Numerics: nearly a Gauss-Newton step at first; at the largest damping a step is 1e-10 of that, and is zero.
constexpr double kFirstDamping = 1e-4;
constexpr double kMaxDamping = 1e10;
// Smaller damping hardly changes a step: this one shortens it to 1/1.1.
constexpr double kFeltDamping = 0.1;
// Converged if no parameter changes by more than this share of its sigma: 0.0004 in chi square.
constexpr double kConvergedSigmas = 2e-2;

// By hand: with 8 blocks the ratio for 9 unknowns has a sigma of sqrt(2 / (8 * 9)) = 0.17; the shortest block
// holds a few ranges of each pair; the most blocks bound memory, at 34 minutes.
constexpr double kMinBlocks = 8.0;
constexpr double kScoreBlock_s = 0.5;
constexpr double kMaxScoreBlocks = 4096.0;
// Excess scatter counts if it is above this many of its own standard deviations: 0.6 % by chance (normal,
// one-sided) for each block length.
constexpr double kSignificance = 2.5;
// Block lengths up to 1 s and up to 8 s: by hand; DriveError.DoesNotTakePlaceDependentErrors... holds with
// them.
constexpr std::size_t kBriefLevels = 2;
constexpr std::size_t kLastingLevels = 5;
// Lower limit of a kernel's mean curvature, as a share of its majorizer's: it keeps the information positive.
// By hand; the CalibrationCampaign tests hold with it (NEES 1.0).
constexpr double kMinCurvatureShare = 0.3;

// Jackknife: parts of the drive, solver steps for each. By hand: five parts have four degrees of freedom for
// three coordinates; 50 ranges are ten in each part.
constexpr int kParts = 5;
constexpr int kJackknifeSteps = 6;
constexpr std::size_t kMinJackknifeRows = 50;
// 99.7 % quantile of the largest eigenvalue of a Wishart matrix of 3 dimensions and 4 degrees of freedom,
// divided by the latter.
constexpr double kLargestByChance = 5.5;
// Variance of Student's t with 4 degrees of freedom.
constexpr double kStudent = 2.0;

using model::square;

// `seen`: the value of the pair's kernel; `row`: Observation::index.
RowValue value_of(const AnchorProblem& problem, std::uint32_t row, const KernelValue& seen, double residual_m,
                  const AnchorVector& anchor, double pose_variance_m2) noexcept {
  RowValue out{.seen = seen};
  if (problem.los_states == nullptr) return out;
  const RangeLos& los_states = problem.los_states->rows[row];
  const double los = static_cast<double>(los_states.los) * seen.density;
  KernelValue through;
  double nlos = 0.0;
  if (los_states.long_nlos > 0.0F) {
    through = widened_value(problem.los_states->long_nlos, pose_variance_m2,
                            residual_m - long_nlos_excess_m(los_states, anchor, problem.tag_count));
    nlos = static_cast<double>(los_states.long_nlos) * through.density;
  }
  out.seen.density = los + nlos + static_cast<double>(los_states.other_density);
  out.los_count = los / out.seen.density;
  out.seen.slope *= out.los_count;
  out.seen.weight *= out.los_count;
  out.nlos_slope = nlos / out.seen.density * through.slope;
  out.nlos_weight = nlos / out.seen.density * through.weight;
  return out;
}

// Derivative of a long NLOS range: also by the two parts of its excess.
struct LongNlosRow {
  Eigen::Matrix<double, model::kPairSize + 2, 1> derivative;
  std::array<Eigen::Index, model::kPairSize + 2> index{};  // of the anchor's unknowns
  std::size_t size = model::kPairSize + 1;                 // one more in an episode

  LongNlosRow(const PairRow& j, const RangeLos& los_states, std::size_t tag, std::size_t tag_count) noexcept {
    derivative << j, 1.0, 1.0;
    const PairIndex pair = pair_index(tag, tag_count);
    *std::copy(pair.begin(), pair.end(), index.begin()) = excess_index(tag_count);
    if (los_states.episode != kNoEpisode) index[size++] = episode_index(los_states.episode, tag_count);
  }
  // Adds weight J J^T.
  void add_square(double weight, Eigen::MatrixXd& out) const noexcept {
    for (std::size_t i = 0; i < size; ++i) {
      for (std::size_t k = 0; k < size; ++k) out(index[i], index[k]) += weight * by(i) * by(k);
    }
  }
  // Adds factor J.
  template <typename Vector>
  void add(double factor, Vector&& out) const noexcept {
    for (std::size_t i = 0; i < size; ++i) out(index[i]) += factor * by(i);
  }

 private:
  [[nodiscard]] double by(std::size_t i) const noexcept { return derivative(static_cast<Eigen::Index>(i)); }
};

double prior_cost(const AnchorProblem& problem, const AnchorVector& anchor) {
  const Eigen::Vector3d offset_m = anchor.head<3>() - problem.position.mean_m;
  double cost = 0.5 * offset_m.dot(problem.position.information * offset_m);
  const model::TermVector means = model::means_of(problem.priors);
  const model::TermVector sigmas = model::sigmas_of(problem.priors);
  for (std::size_t tag = 0; tag < problem.tag_count; ++tag) {
    const model::TermVector off = terms_of(anchor, tag, problem.tag_count) - means;
    cost += 0.5 * off.cwiseQuotient(sigmas).squaredNorm();
  }
  if (problem.los_states == nullptr || !problem.los_states->has_long_nlos) return cost;
  const LongNlosPrior& long_nlos = problem.los_states->prior;
  const Eigen::Index common = excess_index(problem.tag_count);
  cost += 0.5 * square((anchor(common) - long_nlos.mean_m) / long_nlos.sigma_m);
  cost += 0.5 * anchor.tail(anchor.size() - common - 1).squaredNorm() / square(long_nlos.episode_sigma_m);
  return cost;
}

// Length of a step in the metric of the information: bounds every parameter's step over its sigma.
double length_in_sigmas(const NormalEquations& equations, const Eigen::VectorXd& step) {
  double sum = 0.0;
  for (Eigen::Index column = 0; column < step.size(); ++column) {
    sum += step(column) * step.dot(equations.information.col(column));
  }
  return std::sqrt(std::max(0.0, sum));
}

// The normal equations of one problem at any of its solutions.
class Linearizer {
 public:
  Linearizer(const AnchorProblem& problem, std::span<const RobustKernel> kernels)
      : problem_(problem),
        kernels_(kernels),
        columns_(problem.rows, problem.tag_count),
        prior_(information_of_priors(problem)),
        prior_mean_(anchor_at(problem.position.mean_m, problem.tag_count, problem.priors)) {}

  // Reuses the memory of `out`.
  void linearize(const AnchorVector& anchor, NormalEquations& out) const {
    out.gradient.setZero(anchor.size());
    out.information.setZero(anchor.size(), anchor.size());
    CostSum cost;
    for (std::size_t tag = 0; tag < problem_.tag_count; ++tag) add_rows(tag, anchor, cost, out);
    out.cost = prior_cost(problem_, anchor) + cost.cost();
    out.information += prior_;
    add_prior_gradient(anchor, out.gradient);
    out.information.triangularView<Eigen::StrictlyUpper>() = out.information.transpose();
    if (!problem_.position.surveyed) return;
    out.gradient.head<3>().setZero();
    out.information.topRows<3>().setZero();
    out.information.leftCols<3>().setZero();
    out.information.topLeftCorner<3, 3>() = problem_.position.information;
  }

 private:
  void add_rows(std::size_t tag, const AnchorVector& anchor, CostSum& cost, NormalEquations& out) const {
    const model::TermVector terms = terms_of(anchor, tag, problem_.tag_count);
    // Sums over the ranges of weight x x^T (lower triangle) and of slope x. Times `factor`, x = (direction,
    // by_terms()) is the derivative of eq. (12).
    PairRow factor = PairRow::Ones();
    factor.head<3>().setConstant(-model::scale_of(terms));
    PairBlock square = PairBlock::Zero();
    PairRow slope = PairRow::Zero();
    for (Eigen::Index block = 0; block < columns_.blocks(tag); ++block) {
      std::array<Lanes, model::kPairSize> x;
      for (std::size_t axis = 0; axis < 3; ++axis) {
        const auto column = static_cast<Eigen::Index>(axis);
        x[axis] = columns_.at(tag, block, RowColumns::kAntenna + column) - anchor(column);
      }
      const Lanes distance_m = (x[0].square() + x[1].square() + x[2].square()).sqrt();
      const Lanes inverse = (distance_m > model::kMinDistance_m).select(1.0 / distance_m, 0.0);
      for (std::size_t axis = 0; axis < 3; ++axis) x[axis] *= inverse;
      model::by_terms<Lanes>(Lanes::Ones(), distance_m, x, &x[3]);
      Lanes expected_m = terms(0) * x[3];
      for (Eigen::Index term = 1; term < terms.size(); ++term)
        expected_m += terms(term) * x[static_cast<std::size_t>(3 + term)];
      const Lanes residual_m = columns_.at(tag, block, RowColumns::kRange) - expected_m;
      const KernelLanes value = value_at(tag, block, factor, x, residual_m, anchor, out);
      cost.add(value.density, columns_.rows_in(tag, block));
      for (Eigen::Index column = 0; column < factor.size(); ++column) {
        const Lanes& by = x[static_cast<std::size_t>(column)];
        const Lanes weighted = value.weight * by;
        for (Eigen::Index row = column; row < factor.size(); ++row) {
          square(row, column) += (weighted * x[static_cast<std::size_t>(row)]).sum();
        }
        slope(column) += (value.slope * by).sum();
      }
    }
    const PairIndex index = pair_index(tag, problem_.tag_count);
    for (Eigen::Index column = 0; column < factor.size(); ++column) {
      const Eigen::Index to = index[static_cast<std::size_t>(column)];
      out.gradient(to) -= factor(column) * slope(column);
      for (Eigen::Index row = column; row < factor.size(); ++row) {
        out.information(index[static_cast<std::size_t>(row)], to) +=
            factor(row) * factor(column) * square(row, column);
      }
    }
  }

  // Kernel values of one block; adds its long NLOS parts to the equations.
  [[nodiscard]] KernelLanes value_at(std::size_t tag, Eigen::Index block, const PairRow& factor,
                                     const std::array<Lanes, model::kPairSize>& x, const Lanes& residual_m,
                                     const AnchorVector& anchor, NormalEquations& out) const {
    Lanes variance_m2 = Lanes::Zero();
    Lanes share = Lanes::Ones();
    if (columns_.has_spread()) {
      const auto spread_m2 = [&](Eigen::Index term) {
        return columns_.at(tag, block, RowColumns::kSpread + term);
      };
      const Lanes j_x = factor(0) * x[0];
      const Lanes j_y = factor(1) * x[1];
      variance_m2 =
          (j_x * j_x * spread_m2(0) + 2.0 * j_x * j_y * spread_m2(1) + j_y * j_y * spread_m2(2)).max(0.0);
      const double scale_m = kernels_[tag].shape().scale_m;
      share = scale_m / (scale_m * scale_m + variance_m2).sqrt();
    }
    KernelLanes value = kernels_[tag].at(share * residual_m);
    if (columns_.has_spread()) {
      value.density *= share;
      value.slope *= share;
      value.weight *= share.square();
    }
    if (problem_.los_states == nullptr) return value;
    for (Eigen::Index lane = 0; lane < columns_.rows_in(tag, block); ++lane) {
      const std::uint32_t row = columns_.index(tag, block, lane);
      const RowValue whole =
          value_of(problem_, row,
                   {.density = value.density(lane), .slope = value.slope(lane), .weight = value.weight(lane)},
                   residual_m(lane), anchor, variance_m2(lane));
      value.density(lane) = whole.seen.density;
      value.slope(lane) = whole.seen.slope;
      value.weight(lane) = whole.seen.weight;
      if (!(whole.nlos_weight > 0.0)) continue;
      PairRow j = factor;
      for (std::size_t k = 0; k < x.size(); ++k) j(static_cast<Eigen::Index>(k)) *= x[k](lane);
      const LongNlosRow nlos(j, problem_.los_states->rows[row], tag, problem_.tag_count);
      nlos.add(-whole.nlos_slope, out.gradient);
      nlos.add_square(whole.nlos_weight, out.information);
    }
    return value;
  }

  void add_prior_gradient(const AnchorVector& anchor, Eigen::VectorXd& gradient) const {
    const Eigen::Index common = excess_index(problem_.tag_count);
    const Eigen::Index terms = common - 3;
    gradient.head<3>() += problem_.position.information * (anchor.head<3>() - problem_.position.mean_m);
    gradient.segment(3, terms) +=
        prior_.diagonal().segment(3, terms).cwiseProduct(anchor.segment(3, terms) - prior_mean_.tail(terms));
    if (problem_.los_states == nullptr || !problem_.los_states->has_long_nlos) return;
    const LongNlosPrior& long_nlos = problem_.los_states->prior;
    const Eigen::Index episodes = anchor.size() - common - 1;
    gradient(common) += (anchor(common) - long_nlos.mean_m) / square(long_nlos.sigma_m);
    gradient.tail(episodes) += anchor.tail(episodes) / square(long_nlos.episode_sigma_m);
  }

  const AnchorProblem& problem_;
  std::span<const RobustKernel> kernels_;
  RowColumns columns_;
  Eigen::MatrixXd prior_;
  AnchorVector prior_mean_;  // without the excesses
};

// Solves the damped equations; false if the damped information is not positive definite. Cholesky in place:
// for so few unknowns a library's setup takes longer than the solution. `factor`: memory for the lower
// triangle, with its diagonal inverted.
bool solve_damped(const NormalEquations& equations, double damping, Eigen::MatrixXd& factor,
                  Eigen::VectorXd& step) {
  const Eigen::Index size = equations.gradient.size();
  factor = equations.information;
  step = -equations.gradient;
  for (Eigen::Index column = 0; column < size; ++column) {
    double pivot = (1.0 + damping) * factor(column, column);
    for (Eigen::Index k = 0; k < column; ++k) pivot -= square(factor(column, k));
    if (!(pivot > 0.0)) return false;
    const double inverse = 1.0 / std::sqrt(pivot);
    factor(column, column) = inverse;
    for (Eigen::Index row = column + 1; row < size; ++row) {
      double sum = factor(row, column);
      for (Eigen::Index k = 0; k < column; ++k) sum -= factor(row, k) * factor(column, k);
      factor(row, column) = sum * inverse;
    }
  }
  for (Eigen::Index row = 0; row < size; ++row) {
    for (Eigen::Index k = 0; k < row; ++k) step(row) -= factor(row, k) * step(k);
    step(row) *= factor(row, row);
  }
  for (Eigen::Index row = size; row-- > 0;) {
    for (Eigen::Index k = row + 1; k < size; ++k) step(row) -= factor(k, row) * step(k);
    step(row) *= factor(row, row);
  }
  return step.allFinite();
}

struct PairMoments {
  PairBlock weighted = PairBlock::Zero();  // sum of weight J J^T, its lower triangle
  double weight = 0.0;
  double curvature = 0.0;
  double square_slope = 0.0;
};

// Adds factor times the symmetric matrix whose lower triangle is given.
void add_pair(const PairBlock& lower, double factor, std::size_t tag, std::size_t tag_count,
              Eigen::MatrixXd& out) {
  const PairBlock block = lower.selfadjointView<Eigen::Lower>();
  const PairIndex index = pair_index(tag, tag_count);
  out(index, index) += factor * block;
}

// `scores`: one row per block of the shortest length.
std::array<Scatter, kBlockLevels> scatter_by_block_length(const Eigen::MatrixXd& information,
                                                          const Eigen::MatrixXd& score_variance,
                                                          const Eigen::MatrixXd& scores) {
  // With L L^T the information, the square of a score s in its metric is |L^-1 s|^2.
  const Eigen::LLT<Eigen::MatrixXd> factors(information);
  const Eigen::MatrixXd inverse =
      factors.matrixL().solve(Eigen::MatrixXd::Identity(information.rows(), information.cols()));
  const double independent = (inverse * score_variance).cwiseProduct(inverse).sum();
  std::array<Eigen::VectorXd, kBlockLevels> squares;
  Eigen::Index blocks = scores.rows();
  for (Eigen::VectorXd& square : squares) {
    square = Eigen::VectorXd::Zero(blocks);
    blocks = (blocks + 1) / 2;
  }
  Eigen::VectorXd whitened(scores.rows());
  for (Eigen::Index k = 0; k < scores.cols(); ++k) {
    whitened.setZero();
    for (Eigen::Index i = 0; i <= k; ++i) whitened += inverse(k, i) * scores.col(i);
    for (Eigen::VectorXd& square : squares) {
      const Eigen::Index size = square.size();
      square.array() += whitened.head(size).array().square();
      for (Eigen::Index block = 0; 2 * block < size; ++block) {
        const double second = 2 * block + 1 < size ? whitened(2 * block + 1) : 0.0;
        whitened(block) = whitened(2 * block) + second;
      }
    }
  }
  std::array<Scatter, kBlockLevels> out;
  for (std::size_t level = 0; level < kBlockLevels; ++level) {
    Scatter& scatter = out[level];
    scatter.observed = squares[level].sum();
    scatter.blocks = static_cast<double>((squares[level].array() > 0.0).count());
    // The scores of all blocks sum to nearly zero at the solution: one block's worth is missing.
    if (scatter.blocks > 1.0) scatter.expected = independent * (1.0 - 1.0 / scatter.blocks);
  }
  return out;
}

double ratio(const Scatter& scatter) {
  return scatter.expected > 0.0 ? scatter.observed / scatter.expected : 1.0;
}

// Largest significant ratio among block lengths, at least 1.
double significant_ratio(std::span<const Scatter> levels, double dimensions) {
  if (model::is_ablated(model::Mechanism::kCalibrationInflation)) return 1.0;
  double largest = 1.0;
  for (const Scatter& scatter : levels) {
    if (scatter.blocks < kMinBlocks) continue;
    const double deviation = std::sqrt(2.0 / (scatter.blocks * dimensions));
    const double found = ratio(scatter);
    if (found > 1.0 + kSignificance * deviation) largest = std::max(largest, found);
  }
  return largest;
}

}  // namespace

Eigen::Index excess_index(std::size_t tag_count) noexcept {
  return model::anchor_size(static_cast<Eigen::Index>(tag_count));
}

Eigen::Index episode_index(std::int32_t episode, std::size_t tag_count) noexcept {
  return excess_index(tag_count) + 1 + episode;
}

PairIndex pair_index(std::size_t tag, std::size_t tag_count) noexcept {
  return model::pair_indices(static_cast<Eigen::Index>(tag), static_cast<Eigen::Index>(tag_count));
}

model::TermVector terms_of(const AnchorVector& anchor, std::size_t tag, std::size_t tag_count) noexcept {
  return model::terms_of(anchor, static_cast<Eigen::Index>(tag), static_cast<Eigen::Index>(tag_count));
}

model::AntennaPrediction predict(const Observation& row, const AnchorVector& anchor,
                                 std::size_t tag_count) noexcept {
  return model::predict_antenna_range(row.tag_m, anchor.head<3>(), terms_of(anchor, row.tag, tag_count));
}

double residual_m(const Observation& row, const AnchorVector& anchor, std::size_t tag_count) noexcept {
  return row.range_m - predict(row, anchor, tag_count).range_m;
}

double pose_variance_m2(const Observation& row, const AnchorVector& anchor, std::size_t tag_count) noexcept {
  const Eigen::Vector3d spread_m2 = row.pose_spread_m2.cast<double>();
  if (!(spread_m2(0) + spread_m2(2) > 0.0)) return 0.0;
  const Eigen::Vector3d way = row.tag_m - anchor.head<3>();
  const Eigen::Vector2d j = model::scale_of(terms_of(anchor, row.tag, tag_count)) /
                            std::max(way.norm(), model::kMinDistance_m) * way.head<2>();
  const double variance_m2 =
      j.x() * j.x() * spread_m2(0) + 2.0 * j.x() * j.y() * spread_m2(1) + j.y() * j.y() * spread_m2(2);
  return std::max(0.0, variance_m2);
}

double noise_share(const RobustKernel& kernel, double pose_variance_m2) noexcept {
  if (!(pose_variance_m2 > 0.0)) return 1.0;
  const double scale_m = kernel.shape().scale_m;
  return scale_m / std::sqrt(scale_m * scale_m + pose_variance_m2);
}

KernelValue widened_value(const RobustKernel& kernel, double pose_variance_m2, double residual_m) noexcept {
  if (!(pose_variance_m2 > 0.0)) return kernel.at(residual_m);
  const double share = noise_share(kernel, pose_variance_m2);
  KernelValue out = kernel.at(share * residual_m);
  out.density *= share;
  out.slope *= share;
  out.weight *= share * share;
  return out;
}

double long_nlos_excess_m(const RangeLos& los_states, const AnchorVector& anchor,
                          std::size_t tag_count) noexcept {
  const double common_m = anchor(excess_index(tag_count));
  return los_states.episode == kNoEpisode ? common_m
                                          : common_m + anchor(episode_index(los_states.episode, tag_count));
}

void add_square(const PairRow& j, double weight, PairBlock& lower) noexcept {
  for (Eigen::Index column = 0; column < j.size(); ++column) {
    const double weighted = weight * j(column);
    for (Eigen::Index row = column; row < j.size(); ++row) lower(row, column) += weighted * j(row);
  }
}

RowAt row_at(const AnchorFit& fit, const Observation& row) noexcept {
  const std::size_t tags = fit.problem.tag_count;
  RowAt out{.predicted = predict(row, fit.anchor, tags)};
  out.residual_m = row.range_m - out.predicted.range_m;
  const RobustKernel& kernel = fit.kernels[row.tag];
  const double variance_m2 = pose_variance_m2(row, fit.anchor, tags);
  out.noise_share = noise_share(kernel, variance_m2);
  out.value = value_of(fit.problem, row.index, widened_value(kernel, variance_m2, out.residual_m),
                       out.residual_m, fit.anchor, variance_m2);
  out.j.head<3>() = -out.predicted.scale * out.predicted.direction;
  out.j.tail<model::kPairSize - 3>() = out.predicted.d_terms;
  return out;
}

Eigen::MatrixXd information_of_priors(const AnchorProblem& problem) {
  const auto tags = static_cast<Eigen::Index>(problem.tag_count);
  const Eigen::Index common = excess_index(problem.tag_count);
  const Eigen::Index extra = problem.los_states != nullptr ? problem.los_states->extra_unknowns() : 0;
  Eigen::MatrixXd out = Eigen::MatrixXd::Zero(common + extra, common + extra);
  out.topLeftCorner<3, 3>() = problem.position.information;
  out.diagonal().segment(3, common - 3) =
      model::per_tag(model::sigmas_of(problem.priors).cwiseAbs2().cwiseInverse(), tags);
  if (extra == 0) return out;
  out(common, common) = 1.0 / square(problem.los_states->prior.sigma_m);
  out.diagonal().tail(extra - 1).setConstant(1.0 / square(problem.los_states->prior.episode_sigma_m));
  return out;
}

NormalEquations linearize(const AnchorFit& fit) {
  NormalEquations out;
  Linearizer(fit.problem, fit.kernels).linearize(fit.anchor, out);
  return out;
}

double robust_cost(const AnchorFit& fit) {
  CostSum cost;
  for (const Observation& row : fit.problem.rows) cost.add(row_at(fit, row).value.seen);
  return prior_cost(fit.problem, fit.anchor) + cost.cost();
}

AnchorSolution solve_anchor(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                            const AnchorVector& start, int max_iterations) {
  const Linearizer linearizer(problem, kernels);
  AnchorSolution out{.anchor = start};
  NormalEquations here;
  NormalEquations there;
  linearizer.linearize(start, here);
  out.cost = here.cost;
  Eigen::MatrixXd factor;
  Eigen::VectorXd step;
  AnchorVector candidate;
  double damping = kFirstDamping;
  for (int taken = 0; taken < max_iterations && damping < kMaxDamping;) {
    if (!solve_damped(here, damping, factor, step)) {
      damping = std::max(10.0 * damping, kFeltDamping);
      continue;
    }
    candidate = out.anchor + step;
    if (length_in_sigmas(here, step) < kConvergedSigmas) {
      // The quadratic model bounds the cost from above: so short a step needs no check.
      out.anchor = candidate;
      out.cost += 0.5 * here.gradient.dot(step);
      break;
    }
    linearizer.linearize(candidate, there);
    if (!(there.cost <= out.cost)) {
      damping = std::max(10.0 * damping, kFeltDamping);
      continue;
    }
    ++taken;
    out.anchor = candidate;
    out.cost = there.cost;
    std::swap(here, there);
    damping = std::max(damping * 0.1, 1e-12);
  }
  out.moved_sigmas = length_in_sigmas(here, out.anchor - start);
  return out;
}

Evidence gather_evidence(const AnchorFit& fit) {
  const AnchorProblem& problem = fit.problem;
  const std::size_t tags = problem.tag_count;
  const Eigen::Index size = fit.anchor.size();
  Evidence out;
  out.prior_information = information_of_priors(problem);
  out.information = out.prior_information;
  out.surveyed = problem.position.surveyed;
  out.score_variance = Eigen::MatrixXd::Zero(size, size);
  if (problem.rows.empty()) return out;

  const double begin_s = problem.rows.front().t_s;
  const double duration_s = problem.rows.back().t_s - begin_s;
  const double block_s = std::max(kScoreBlock_s, duration_s / kMaxScoreBlocks);
  const auto blocks = 1 + static_cast<Eigen::Index>(duration_s / block_s);
  Eigen::MatrixXd scores = Eigen::MatrixXd::Zero(blocks, size);
  std::vector<PairMoments> pairs(tags);
  for (const Observation& row : problem.rows) {
    const RowAt at = row_at(fit, row);
    const RowValue& whole = at.value;
    const KernelValue& value = whole.seen;
    PairMoments& pair = pairs[row.tag];
    add_square(at.j, value.weight, pair.weighted);
    pair.weight += value.weight;
    // Curvature of the mixture: the variance of the slope between LOS and NLOS counts too.
    pair.curvature += whole.los_count * at.noise_share * at.noise_share *
                      fit.kernels[row.tag].curvature(at.noise_share * at.residual_m);
    if (whole.los_count > 0.0) {
      pair.curvature -= (1.0 / whole.los_count - 1.0) * value.slope * value.slope;
    }
    pair.square_slope += value.slope * value.slope;

    const double elapsed_s = std::max(0.0, row.t_s - begin_s);
    const Eigen::Index block = std::min(blocks - 1, static_cast<Eigen::Index>(elapsed_s / block_s));
    scores(block, pair_index(row.tag, tags)) += value.slope * at.j.transpose();
    if (!(whole.nlos_weight > 0.0)) continue;
    const LongNlosRow nlos(at.j, problem.los_states->rows[row.index], row.tag, tags);
    nlos.add(whole.nlos_slope, scores.row(block).transpose());
    nlos.add_square(whole.nlos_weight, out.information);
    nlos.add_square(whole.nlos_slope * whole.nlos_slope, out.score_variance);
  }
  for (std::size_t tag = 0; tag < tags; ++tag) {
    const PairMoments& pair = pairs[tag];
    if (!(pair.weight > 0.0)) continue;
    const double curvature = model::is_ablated(model::Mechanism::kCalibrationCurvature)
                                 ? 1.0
                                 : std::clamp(pair.curvature / pair.weight, kMinCurvatureShare, 1.0);
    add_pair(pair.weighted, curvature, tag, tags, out.information);
    add_pair(pair.weighted, pair.square_slope / pair.weight, tag, tags, out.score_variance);
  }
  out.scatter = scatter_by_block_length(out.information, out.score_variance, scores);
  const auto dimensions = static_cast<double>(size);
  out.brief_inflation = significant_ratio(std::span(out.scatter).first<kBriefLevels>(), dimensions);
  out.lasting_inflation = significant_ratio(std::span(out.scatter).first<kLastingLevels>(), dimensions);
  return out;
}

void gather_evidence(std::span<AnchorFit> fits) {
  for (AnchorFit& fit : fits) fit.evidence = gather_evidence(fit);
}

void estimate_inflation(std::span<AnchorFit> fits) {
  std::array<Scatter, kBlockLevels> site;
  double dimensions = 1.0;
  for (AnchorFit& fit : fits) {
    dimensions = static_cast<double>(fit.evidence.information.rows());
    for (std::size_t level = 0; level < kBlockLevels; ++level) {
      const Scatter& scatter = fit.evidence.scatter[level];
      if (!(scatter.expected > 0.0)) continue;
      // Normalized, so that anchors with more ranges do not dominate.
      site[level].observed += scatter.blocks * ratio(scatter);
      site[level].expected += scatter.blocks;
      site[level].blocks += scatter.blocks;
    }
    fit.inflation = significant_ratio(fit.evidence.scatter, dimensions);
  }
  const double common = significant_ratio(site, dimensions);
  for (AnchorFit& fit : fits) fit.inflation = std::max(fit.inflation, common);
}

std::optional<Eigen::Matrix3d> jackknife_covariance(const AnchorFit& fit) {
  const std::span<const Observation> rows = fit.problem.rows;
  if (rows.size() < kMinJackknifeRows || fit.problem.position.surveyed) return std::nullopt;
  if (model::is_ablated(model::Mechanism::kCalibrationJackknife)) return std::nullopt;
  const double begin_s = rows.front().t_s;
  const double part_s = (rows.back().t_s - begin_s) / kParts;
  Eigen::Matrix3d sum = Eigen::Matrix3d::Zero();
  std::vector<Observation> kept;
  kept.reserve(rows.size());
  for (int part = 0; part < kParts; ++part) {
    const double from_s = begin_s + part * part_s;
    const double to_s = part + 1 == kParts ? rows.back().t_s + 1.0 : from_s + part_s;
    kept.clear();
    std::copy_if(rows.begin(), rows.end(), std::back_inserter(kept),
                 [&](const Observation& row) { return row.t_s < from_s || row.t_s >= to_s; });
    AnchorProblem problem = fit.problem;
    problem.rows = kept;
    const Eigen::Vector3d moved_m =
        (solve_anchor(problem, fit.kernels, fit.anchor, kJackknifeSteps).anchor - fit.anchor).head<3>();
    sum += moved_m * moved_m.transpose();
  }
  return Eigen::Matrix3d((kParts - 1.0) / kParts * sum);
}

Eigen::MatrixXd excess_of_jackknife(const Eigen::Matrix3d& jackknife, const Eigen::MatrixXd& expected) {
  const Eigen::Index size = expected.rows();
  const Eigen::LLT<Eigen::Matrix3d> root(expected.topLeftCorner<3, 3>());
  if (root.info() != Eigen::Success || !jackknife.allFinite()) return Eigen::MatrixXd::Zero(size, size);
  const Eigen::Matrix3d half = root.matrixL().solve(jackknife);
  const Eigen::Matrix3d relative = root.matrixL().solve(half.transpose());
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> axes(0.5 * (relative + relative.transpose()));
  Eigen::Matrix3d more = Eigen::Matrix3d::Zero();
  for (Eigen::Index axis = 0; axis < 3; ++axis) {
    const double ratio = axes.eigenvalues()(axis);
    if (ratio < kLargestByChance) continue;
    const Eigen::Vector3d direction = axes.eigenvectors().col(axis);
    more += (kStudent * ratio - 1.0) * direction * direction.transpose();
  }
  const Eigen::MatrixXd by_position = root.matrixL().solve(expected.topRows<3>());
  return by_position.transpose() * more * by_position;
}

Eigen::MatrixXd anchor_covariance(const Evidence& evidence, double inflation) {
  const Eigen::Index size = evidence.information.rows();
  if (evidence.surveyed) {
    const Eigen::Index biases = size - 3;
    const Eigen::LDLT<Eigen::MatrixXd> information(evidence.information.bottomRightCorner(biases, biases));
    // Change of the biases by the change of the position.
    const Eigen::MatrixXd by_position = -information.solve(evidence.information.bottomLeftCorner(biases, 3));
    const Eigen::Matrix3d position =
        evidence.prior_information.topLeftCorner<3, 3>().ldlt().solve(Eigen::Matrix3d::Identity());
    const Eigen::MatrixXd variance = evidence.prior_information.bottomRightCorner(biases, biases) +
                                     inflation * evidence.score_variance.bottomRightCorner(biases, biases);
    const Eigen::MatrixXd half = information.solve(variance);
    Eigen::MatrixXd covariance(size, size);
    covariance.topLeftCorner<3, 3>() = position;
    covariance.bottomLeftCorner(biases, 3) = by_position * position;
    covariance.topRightCorner(3, biases) = covariance.bottomLeftCorner(biases, 3).transpose();
    covariance.bottomRightCorner(biases, biases) =
        information.solve(half.transpose()) + by_position * position * by_position.transpose();
    return 0.5 * (covariance + covariance.transpose());
  }
  const Eigen::MatrixXd inverse = evidence.information.ldlt().solve(Eigen::MatrixXd::Identity(size, size));
  const Eigen::MatrixXd variance = evidence.prior_information + inflation * evidence.score_variance;
  const Eigen::MatrixXd covariance = inverse * variance * inverse;
  return 0.5 * (covariance + covariance.transpose());
}

Eigen::MatrixXd rough_covariance(const AnchorFit& fit) {
  constexpr std::size_t kRows = 200;  // by hand, a bound on time
  const AnchorProblem& problem = fit.problem;
  const std::size_t tags = problem.tag_count;
  const std::size_t step = 1 + problem.rows.size() / kRows;
  std::vector<PairBlock> pairs(tags, PairBlock::Zero());
  for (std::size_t i = 0; i < problem.rows.size(); i += step) {
    const RowAt at = row_at(fit, problem.rows[i]);
    add_square(at.j, at.value.seen.weight, pairs[problem.rows[i].tag]);
  }
  Eigen::MatrixXd information = information_of_priors(problem);
  for (std::size_t tag = 0; tag < tags; ++tag) {
    add_pair(pairs[tag], static_cast<double>(step), tag, tags, information);
  }
  return information.ldlt().solve(Eigen::MatrixXd::Identity(information.rows(), information.cols()));
}

double prediction_sigma_m(const PairRow& j, std::size_t tag, const Eigen::MatrixXd& covariance) noexcept {
  const auto tags = static_cast<std::size_t>(covariance.rows() - 3) / model::kPairTerms.size();
  const PairIndex index = pair_index(tag, tags);
  double variance_m2 = 0.0;
  for (std::size_t i = 0; i < index.size(); ++i) {
    for (std::size_t k = 0; k < index.size(); ++k) {
      variance_m2 +=
          j(static_cast<Eigen::Index>(i)) * j(static_cast<Eigen::Index>(k)) * covariance(index[i], index[k]);
    }
  }
  return std::sqrt(std::max(0.0, variance_m2));
}

}  // namespace groma::calibration
