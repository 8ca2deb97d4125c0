#include "host/calibration/anchor_solver.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>

namespace groma::calibration {
namespace {

constexpr double kFirstDamping = 1e-4;
constexpr double kMaxDamping = 1e10;
// A step this small in every parameter, as a share of its own sigma, ends the search.
constexpr double kConvergedSigmas = 2e-2;

double square(double x) noexcept {
  return x * x;
}

double prior_cost(const AnchorProblem& problem, const AnchorVector& anchor) {
  const Eigen::Vector3d offset_m = anchor.head<3>() - problem.position.mean_m;
  double cost = 0.5 * offset_m.dot(problem.position.information * offset_m);
  const model::RangePriors& priors = problem.priors;
  for (std::size_t tag = 0; tag < problem.tag_count; ++tag) {
    const double beta = anchor(beta_index(tag)) - priors.beta_m.mean;
    const double gamma = anchor(gamma_index(tag, problem.tag_count)) - priors.gamma.mean;
    cost += 0.5 * square(beta / priors.beta_m.sigma) + 0.5 * square(gamma / priors.gamma.sigma);
  }
  if (problem.sight == nullptr || !problem.sight->behind_wall) return cost;
  const WallPrior& wall = problem.sight->prior;
  const Eigen::Index common = wall_index(problem.tag_count);
  cost += 0.5 * square((anchor(common) - wall.mean_m) / wall.sigma_m);
  cost += 0.5 * anchor.tail(anchor.size() - common - 1).squaredNorm() / square(wall.episode_sigma_m);
  return cost;
}

// A step's length in units of the information: a bound on every parameter's share of its sigma.
double length_in_sigmas(const NormalEquations& equations, const Eigen::VectorXd& step) {
  return std::sqrt(std::max(0.0, step.dot(equations.information * step)));
}

}  // namespace

Eigen::MatrixXd information_of_priors(const AnchorProblem& problem) {
  const auto tags = static_cast<Eigen::Index>(problem.tag_count);
  const Eigen::Index common = wall_index(problem.tag_count);
  const Eigen::Index extra =
      problem.sight != nullptr ? static_cast<Eigen::Index>(problem.sight->extra_unknowns()) : 0;
  Eigen::MatrixXd out = Eigen::MatrixXd::Zero(common + extra, common + extra);
  out.topLeftCorner<3, 3>() = problem.position.information;
  out.diagonal().segment(3, tags).setConstant(1.0 / square(problem.priors.beta_m.sigma));
  out.diagonal().segment(3 + tags, tags).setConstant(1.0 / square(problem.priors.gamma.sigma));
  if (extra == 0) return out;
  out(common, common) = 1.0 / square(problem.sight->prior.sigma_m);
  out.diagonal().tail(extra - 1).setConstant(1.0 / square(problem.sight->prior.episode_sigma_m));
  return out;
}

NormalEquations linearize(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                          const AnchorVector& anchor) {
  const std::size_t tags = problem.tag_count;
  const Eigen::Index size = anchor.size();
  std::vector<PairBlock> blocks(tags, PairBlock::Zero());
  std::vector<PairRow> slopes(tags, PairRow::Zero());

  NormalEquations out;
  out.gradient = Eigen::VectorXd::Zero(size);
  out.information = Eigen::MatrixXd::Zero(size, size);
  CostSum cost;
  for (const Observation& row : problem.rows) {
    const model::AntennaPrediction predicted = predict(row, anchor, tags);
    const RowValue value = value_of(problem, kernels, row, row.range_m - predicted.range_m, anchor);
    cost.add(value.seen);
    const PairRow j = pair_jacobian(predicted, anchor(gamma_index(row.tag, tags)));
    slopes[row.tag] -= value.seen.slope * j;
    add_square(j, value.seen.weight, blocks[row.tag]);
    if (!(value.wall_weight > 0.0)) continue;
    const WallRow walled = wall_row(j, problem.sight->rows[row.index], row.tag, tags);
    add(walled, -value.wall_slope, out.gradient);
    add_square(walled, value.wall_weight, out.information);
  }

  out.cost = prior_cost(problem, anchor) + cost.cost();
  out.information += information_of_priors(problem);
  out.gradient.head<3>() += problem.position.information * (anchor.head<3>() - problem.position.mean_m);
  const model::RangePriors& priors = problem.priors;
  for (std::size_t tag = 0; tag < tags; ++tag) {
    const Eigen::Index beta = beta_index(tag);
    const Eigen::Index gamma = gamma_index(tag, tags);
    const PairBlock block = blocks[tag].selfadjointView<Eigen::Lower>();
    const PairRow& slope = slopes[tag];
    out.gradient.head<3>() += slope.head<3>();
    out.gradient(beta) += slope(3) + (anchor(beta) - priors.beta_m.mean) / square(priors.beta_m.sigma);
    out.gradient(gamma) += slope(4) + (anchor(gamma) - priors.gamma.mean) / square(priors.gamma.sigma);
    out.information.topLeftCorner<3, 3>() += block.topLeftCorner<3, 3>();
    out.information.block<3, 1>(0, beta) += block.block<3, 1>(0, 3);
    out.information.block<1, 3>(beta, 0) += block.block<1, 3>(3, 0);
    out.information.block<3, 1>(0, gamma) += block.block<3, 1>(0, 4);
    out.information.block<1, 3>(gamma, 0) += block.block<1, 3>(4, 0);
    out.information(beta, gamma) += block(3, 4);
    out.information(gamma, beta) += block(4, 3);
    out.information(beta, beta) += block(3, 3);
    out.information(gamma, gamma) += block(4, 4);
  }
  if (problem.sight != nullptr && problem.sight->behind_wall) {
    const WallPrior& wall = problem.sight->prior;
    const Eigen::Index common = wall_index(tags);
    const Eigen::Index episodes = size - common - 1;
    out.gradient(common) += (anchor(common) - wall.mean_m) / square(wall.sigma_m);
    out.gradient.tail(episodes) += anchor.tail(episodes) / square(wall.episode_sigma_m);
  }
  if (problem.position.surveyed) {
    out.gradient.head<3>().setZero();
    out.information.topRows<3>().setZero();
    out.information.leftCols<3>().setZero();
    out.information.topLeftCorner<3, 3>() = problem.position.information;
  }
  return out;
}

double robust_cost(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                   const AnchorVector& anchor) {
  CostSum cost;
  for (const Observation& row : problem.rows) {
    cost.add(value_of(problem, kernels, row, residual_m(row, anchor, problem.tag_count), anchor).seen);
  }
  return prior_cost(problem, anchor) + cost.cost();
}

AnchorSolution solve_anchor(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                            const AnchorVector& start, int max_iterations) {
  AnchorSolution out{.anchor = start};
  NormalEquations here = linearize(problem, kernels, start);
  out.cost = here.cost;
  double damping = kFirstDamping;
  for (int taken = 0; taken < max_iterations && damping < kMaxDamping;) {
    Eigen::MatrixXd damped = here.information;
    damped.diagonal() *= 1.0 + damping;
    const Eigen::LDLT<Eigen::MatrixXd> factors(damped);
    const Eigen::VectorXd step = -factors.solve(here.gradient);
    if (!step.allFinite()) {
      damping = std::max(damping * 10.0, 1e-3);
      continue;
    }
    const AnchorVector candidate = out.anchor + step;
    if (length_in_sigmas(here, step) < kConvergedSigmas) {
      // The information's parabola lies above the cost: so short a step needs no look.
      out.anchor = candidate;
      out.cost += 0.5 * here.gradient.dot(step);
      out.converged = true;
      break;
    }
    NormalEquations there = linearize(problem, kernels, candidate);
    if (!(there.cost <= out.cost)) {
      damping *= 10.0;
      continue;
    }
    ++taken;
    out.anchor = candidate;
    out.cost = there.cost;
    here = std::move(there);
    damping = std::max(damping * 0.1, 1e-12);
  }
  out.moved_sigmas = length_in_sigmas(here, out.anchor - start);
  return out;
}

AnchorVector anchor_at(const Eigen::Vector3d& position_m, std::size_t tag_count,
                       const model::RangePriors& priors) {
  AnchorVector anchor(3 + 2 * static_cast<Eigen::Index>(tag_count));
  anchor.head<3>() = position_m;
  anchor.segment(3, static_cast<Eigen::Index>(tag_count)).setConstant(priors.beta_m.mean);
  anchor.tail(static_cast<Eigen::Index>(tag_count)).setConstant(priors.gamma.mean);
  return anchor;
}

}  // namespace groma::calibration
