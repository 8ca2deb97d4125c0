#include "host/calibration/anchor_solver.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>

namespace groma::calibration {
namespace {

constexpr double kFirstDamping = 1e-4;
constexpr double kMaxDamping = 1e10;
// A step this small in every parameter, as a share of its own sigma, ends the search.
constexpr double kConvergedSigmas = 1e-2;

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
  return cost;
}

// A step's length in units of the information: a bound on every parameter's share of its sigma.
double length_in_sigmas(const NormalEquations& equations, const Eigen::VectorXd& step) {
  return std::sqrt(std::max(0.0, step.dot(equations.information * step)));
}

}  // namespace

NormalEquations linearize(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                          const AnchorVector& anchor) {
  const std::size_t tags = problem.tag_count;
  const Eigen::Index size = anchor.size();
  std::vector<PairBlock> blocks(tags, PairBlock::Zero());
  std::vector<PairRow> slopes(tags, PairRow::Zero());

  CostSum cost;
  for (const Observation& row : problem.rows) {
    const model::AntennaPrediction predicted = predict(row, anchor, tags);
    const KernelValue value = kernels[row.tag].at(row.range_m - predicted.range_m);
    cost.add(value);
    const PairRow j = pair_jacobian(predicted, anchor(gamma_index(row.tag, tags)));
    slopes[row.tag] -= value.slope * j;
    add_square(j, value.weight, blocks[row.tag]);
  }

  NormalEquations out;
  out.cost = prior_cost(problem, anchor) + cost.cost();
  out.gradient = Eigen::VectorXd::Zero(size);
  out.information = Eigen::MatrixXd::Zero(size, size);
  out.gradient.head<3>() = problem.position.information * (anchor.head<3>() - problem.position.mean_m);
  out.information.topLeftCorner<3, 3>() = problem.position.information;
  const model::RangePriors& priors = problem.priors;
  for (std::size_t tag = 0; tag < tags; ++tag) {
    const Eigen::Index beta = beta_index(tag);
    const Eigen::Index gamma = gamma_index(tag, tags);
    const PairBlock block = blocks[tag].selfadjointView<Eigen::Lower>();
    const PairRow& slope = slopes[tag];
    out.gradient.head<3>() += slope.head<3>();
    out.gradient(beta) = slope(3) + (anchor(beta) - priors.beta_m.mean) / square(priors.beta_m.sigma);
    out.gradient(gamma) = slope(4) + (anchor(gamma) - priors.gamma.mean) / square(priors.gamma.sigma);
    out.information.topLeftCorner<3, 3>() += block.topLeftCorner<3, 3>();
    out.information.block<3, 1>(0, beta) = block.block<3, 1>(0, 3);
    out.information.block<1, 3>(beta, 0) = block.block<1, 3>(3, 0);
    out.information.block<3, 1>(0, gamma) = block.block<3, 1>(0, 4);
    out.information.block<1, 3>(gamma, 0) = block.block<1, 3>(4, 0);
    out.information(beta, gamma) = block(3, 4);
    out.information(gamma, beta) = block(4, 3);
    out.information(beta, beta) = block(3, 3) + 1.0 / square(priors.beta_m.sigma);
    out.information(gamma, gamma) = block(4, 4) + 1.0 / square(priors.gamma.sigma);
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
    cost.add(kernels[row.tag].at(residual_m(row, anchor, problem.tag_count)));
  }
  return prior_cost(problem, anchor) + cost.cost();
}

AnchorSolution solve_anchor(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                            const AnchorVector& start, int max_iterations) {
  AnchorSolution out{.anchor = start};
  NormalEquations here = linearize(problem, kernels, start);
  out.cost = here.cost;
  double damping = kFirstDamping;
  for (int i = 0; i < max_iterations && damping < kMaxDamping; ++i) {
    Eigen::MatrixXd damped = here.information;
    damped.diagonal() *= 1.0 + damping;
    const Eigen::LDLT<Eigen::MatrixXd> factors(damped);
    const Eigen::VectorXd step = -factors.solve(here.gradient);
    if (!step.allFinite()) {
      damping = std::max(damping * 10.0, 1e-3);
      continue;
    }
    const double length = length_in_sigmas(here, step);
    const AnchorVector candidate = out.anchor + step;
    NormalEquations there = linearize(problem, kernels, candidate);
    if (!(there.cost <= out.cost)) {
      if (length < kConvergedSigmas) {
        out.converged = true;
        break;
      }
      damping *= 10.0;
      continue;
    }
    out.anchor = candidate;
    out.cost = there.cost;
    here = std::move(there);
    damping = std::max(damping * 0.1, 1e-12);
    if (length < kConvergedSigmas) {
      out.converged = true;
      break;
    }
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
