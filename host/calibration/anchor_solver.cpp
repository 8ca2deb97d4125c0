#include "host/calibration/anchor_solver.hpp"

#include <utility>

namespace groma::calibration {
namespace {

// Numerics: nearly a Gauss-Newton step at first; at the largest damping a step is 1e-10 of that, and is zero.
constexpr double kFirstDamping = 1e-4;
constexpr double kMaxDamping = 1e10;
// Smaller damping hardly changes a step: this one shortens it to 1/1.1.
constexpr double kFeltDamping = 0.1;
// Converged if no parameter changes by more than this share of its sigma: 0.0004 in chi square.
constexpr double kConvergedSigmas = 2e-2;

using model::square;

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

}  // namespace

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

}  // namespace groma::calibration
