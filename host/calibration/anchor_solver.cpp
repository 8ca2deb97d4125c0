#include "host/calibration/anchor_solver.hpp"

#include <utility>

namespace groma::calibration {
namespace {

constexpr double kFirstDamping = 1e-4;
constexpr double kMaxDamping = 1e10;
// Less than this hardly changes a step.
constexpr double kFeltDamping = 0.1;
// A step this small in every parameter, as a share of its own sigma, ends the search.
constexpr double kConvergedSigmas = 2e-2;

using model::square;

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
  double sum = 0.0;
  for (Eigen::Index column = 0; column < step.size(); ++column) {
    sum += step(column) * step.dot(equations.information.col(column));
  }
  return std::sqrt(std::max(0.0, sum));
}

// What the rows of one tag in sight say: sums of weight times the products of (direction, 1, distance), the
// derivative of their ranges but for gamma and its sign, and of slope times them.
struct PairSums {
  Eigen::Matrix3d direction_square = Eigen::Matrix3d::Zero();  // its lower triangle
  Eigen::Vector3d direction = Eigen::Vector3d::Zero();
  Eigen::Vector3d direction_distance = Eigen::Vector3d::Zero();
  double weight = 0.0;
  double distance = 0.0;
  double distance_square = 0.0;
  Eigen::Vector3d slope_direction = Eigen::Vector3d::Zero();
  double slope = 0.0;
  double slope_distance = 0.0;

  void add(const std::array<Lanes, 3>& towards, const Lanes& distance_m, const Lanes& slopes,
           const Lanes& weights) noexcept {
    for (std::size_t column = 0; column < 3; ++column) {
      const auto c = static_cast<Eigen::Index>(column);
      const Lanes weighted = weights * towards[column];
      for (std::size_t row = column; row < 3; ++row) {
        direction_square(static_cast<Eigen::Index>(row), c) += (weighted * towards[row]).sum();
      }
      direction(c) += weighted.sum();
      direction_distance(c) += (weighted * distance_m).sum();
      slope_direction(c) += (slopes * towards[column]).sum();
    }
    const Lanes weighted = weights * distance_m;
    weight += weights.sum();
    distance += weighted.sum();
    distance_square += (weighted * distance_m).sum();
    slope += slopes.sum();
    slope_distance += (slopes * distance_m).sum();
  }

  void add_to(std::size_t tag, std::size_t tag_count, double by_gamma, NormalEquations& out) const {
    const Eigen::Index beta = beta_index(tag);
    const Eigen::Index gamma = gamma_index(tag, tag_count);
    Eigen::MatrixXd& information = out.information;
    for (Eigen::Index column = 0; column < 3; ++column) {
      out.gradient(column) += by_gamma * slope_direction(column);
      for (Eigen::Index row = column; row < 3; ++row) {
        information(row, column) += by_gamma * by_gamma * direction_square(row, column);
      }
      information(beta, column) -= by_gamma * direction(column);
      information(gamma, column) -= by_gamma * direction_distance(column);
    }
    information(beta, beta) += weight;
    information(gamma, beta) += distance;
    information(gamma, gamma) += distance_square;
    out.gradient(beta) -= slope;
    out.gradient(gamma) -= slope_distance;
  }
};

void add_priors(const AnchorProblem& problem, const AnchorVector& anchor, NormalEquations& out) {
  const std::size_t tags = problem.tag_count;
  const Eigen::Vector3d offset_m = anchor.head<3>() - problem.position.mean_m;
  out.gradient.head<3>() += problem.position.information * offset_m;
  out.information.topLeftCorner<3, 3>() += problem.position.information;
  const double by_beta = 1.0 / square(problem.priors.beta_m.sigma);
  const double by_gamma = 1.0 / square(problem.priors.gamma.sigma);
  for (std::size_t tag = 0; tag < tags; ++tag) {
    const Eigen::Index beta = beta_index(tag);
    const Eigen::Index gamma = gamma_index(tag, tags);
    out.gradient(beta) += by_beta * (anchor(beta) - problem.priors.beta_m.mean);
    out.gradient(gamma) += by_gamma * (anchor(gamma) - problem.priors.gamma.mean);
    out.information(beta, beta) += by_beta;
    out.information(gamma, gamma) += by_gamma;
  }
  if (problem.sight == nullptr || !problem.sight->behind_wall) return;
  const WallPrior& wall = problem.sight->prior;
  const Eigen::Index common = wall_index(tags);
  const Eigen::Index episodes = anchor.size() - common - 1;
  out.gradient(common) += (anchor(common) - wall.mean_m) / square(wall.sigma_m);
  out.gradient.tail(episodes) += anchor.tail(episodes) / square(wall.episode_sigma_m);
  out.information(common, common) += 1.0 / square(wall.sigma_m);
  out.information.diagonal().tail(episodes).array() += 1.0 / square(wall.episode_sigma_m);
}

// As of one row; towards: unit vectors from anchor to antenna.
Lanes pose_variance_m2(const RowColumns& columns, std::size_t tag, Eigen::Index block, double gamma,
                       const std::array<Lanes, 3>& towards) {
  const Lanes x = gamma * towards[0];
  const Lanes y = gamma * towards[1];
  const Lanes variance_m2 = x * x * columns.spread_m2(tag, block, 0) +
                            2.0 * x * y * columns.spread_m2(tag, block, 1) +
                            y * y * columns.spread_m2(tag, block, 2);
  return variance_m2.max(0.0);
}

// `columns`: of the problem's rows. The result's memory is used again.
void linearize(const AnchorProblem& problem, const RowColumns& columns, std::span<const RobustKernel> kernels,
               const AnchorVector& anchor, NormalEquations& out) {
  const std::size_t tags = problem.tag_count;
  out.gradient.setZero(anchor.size());
  out.information.setZero(anchor.size(), anchor.size());
  CostSum cost;
  for (std::size_t tag = 0; tag < tags; ++tag) {
    const double beta_m = anchor(beta_index(tag));
    const double gamma = anchor(gamma_index(tag, tags));
    PairSums sums;
    for (Eigen::Index block = 0; block < columns.blocks(tag); ++block) {
      std::array<Lanes, 3> towards;  // unit vectors from anchor to antenna
      for (Eigen::Index axis = 0; axis < 3; ++axis) {
        towards[static_cast<std::size_t>(axis)] = columns.antenna_m(tag, block, axis) - anchor(axis);
      }
      const Lanes distance_m = (towards[0].square() + towards[1].square() + towards[2].square()).sqrt();
      const Lanes inverse = (distance_m > model::kMinDistance_m).select(1.0 / distance_m, 0.0);
      for (Lanes& axis : towards) axis *= inverse;
      const Lanes residual_m = columns.range_m(tag, block) - (gamma * distance_m + beta_m);
      Lanes variance_m2 = Lanes::Zero();
      Lanes share = Lanes::Ones();
      if (columns.tells_spread()) {
        variance_m2 = pose_variance_m2(columns, tag, block, gamma, towards);
        const double scale_m = kernels[tag].shape().scale_m;
        share = scale_m / (scale_m * scale_m + variance_m2).sqrt();
      }
      KernelLanes value = kernels[tag].at(share * residual_m);
      if (columns.tells_spread()) {
        value.density *= share;
        value.slope *= share;
        value.weight *= share.square();
      }
      const Eigen::Index count = columns.rows_in(tag, block);
      for (Eigen::Index lane = 0; problem.sight != nullptr && lane < count; ++lane) {
        const RowSight& sight = problem.sight->rows[columns.index(tag, block, lane)];
        const RowValue whole = value_of(
            *problem.sight, sight,
            {.density = value.density(lane), .slope = value.slope(lane), .weight = value.weight(lane)},
            residual_m(lane), anchor, tags, variance_m2(lane));
        value.density(lane) = whole.seen.density;
        value.slope(lane) = whole.seen.slope;
        value.weight(lane) = whole.seen.weight;
        if (!(whole.wall_weight > 0.0)) continue;
        const PairRow j{-gamma * towards[0](lane), -gamma * towards[1](lane), -gamma * towards[2](lane), 1.0,
                        distance_m(lane)};
        const WallRow walled = wall_row(j, sight, tag, tags);
        add(walled, -whole.wall_slope, out.gradient);
        add_square(walled, whole.wall_weight, out.information);
      }
      cost.add(value.density, count);
      sums.add(towards, distance_m, value.slope, value.weight);
    }
    sums.add_to(tag, tags, gamma, out);
  }
  add_priors(problem, anchor, out);
  out.cost = prior_cost(problem, anchor) + cost.cost();
  out.information.triangularView<Eigen::StrictlyUpper>() = out.information.transpose();
  if (!problem.position.surveyed) return;
  out.gradient.head<3>().setZero();
  out.information.topRows<3>().setZero();
  out.information.leftCols<3>().setZero();
  out.information.topLeftCorner<3, 3>() = problem.position.information;
}

// Steps of the damped equations. Cholesky in place: of so few unknowns, a library's setting out takes longer
// than the way.
class DampedStep {
 public:
  // False where the information, so damped, is not positive.
  [[nodiscard]] bool solve(const NormalEquations& equations, double damping) {
    const Eigen::Index size = equations.gradient.size();
    factor_ = equations.information;
    step_ = -equations.gradient;
    for (Eigen::Index column = 0; column < size; ++column) {
      double pivot = (1.0 + damping) * factor_(column, column);
      for (Eigen::Index k = 0; k < column; ++k) pivot -= square(factor_(column, k));
      if (!(pivot > 0.0)) return false;
      const double inverse = 1.0 / std::sqrt(pivot);
      factor_(column, column) = inverse;
      for (Eigen::Index row = column + 1; row < size; ++row) {
        double sum = factor_(row, column);
        for (Eigen::Index k = 0; k < column; ++k) sum -= factor_(row, k) * factor_(column, k);
        factor_(row, column) = sum * inverse;
      }
    }
    for (Eigen::Index row = 0; row < size; ++row) {
      for (Eigen::Index k = 0; k < row; ++k) step_(row) -= factor_(row, k) * step_(k);
      step_(row) *= factor_(row, row);
    }
    for (Eigen::Index row = size; row-- > 0;) {
      for (Eigen::Index k = row + 1; k < size; ++k) step_(row) -= factor_(k, row) * step_(k);
      step_(row) *= factor_(row, row);
    }
    return step_.allFinite();
  }
  [[nodiscard]] const Eigen::VectorXd& step() const noexcept { return step_; }

 private:
  Eigen::MatrixXd factor_;  // lower triangle, its diagonal inverted
  Eigen::VectorXd step_;
};

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
  NormalEquations out;
  linearize(problem, RowColumns(problem.rows, problem.tag_count), kernels, anchor, out);
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
  const RowColumns columns(problem.rows, problem.tag_count);
  AnchorSolution out{.anchor = start};
  NormalEquations here;
  NormalEquations there;
  linearize(problem, columns, kernels, start, here);
  out.cost = here.cost;
  DampedStep damped;
  AnchorVector candidate;
  double damping = kFirstDamping;
  for (int taken = 0; taken < max_iterations && damping < kMaxDamping;) {
    if (!damped.solve(here, damping)) {
      damping = std::max(10.0 * damping, kFeltDamping);
      continue;
    }
    const Eigen::VectorXd& step = damped.step();
    candidate = out.anchor + step;
    if (length_in_sigmas(here, step) < kConvergedSigmas) {
      // The information's parabola lies above the cost: so short a step needs no look.
      out.anchor = candidate;
      out.cost += 0.5 * here.gradient.dot(step);
      out.converged = true;
      break;
    }
    linearize(problem, columns, kernels, candidate, there);
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

AnchorVector anchor_at(const Eigen::Vector3d& position_m, std::size_t tag_count,
                       const model::RangePriors& priors) {
  AnchorVector anchor(3 + 2 * static_cast<Eigen::Index>(tag_count));
  anchor.head<3>() = position_m;
  anchor.segment(3, static_cast<Eigen::Index>(tag_count)).setConstant(priors.beta_m.mean);
  anchor.tail(static_cast<Eigen::Index>(tag_count)).setConstant(priors.gamma.mean);
  return anchor;
}

}  // namespace groma::calibration
