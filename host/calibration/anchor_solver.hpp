// Position and pair biases of one anchor from its ranges: robust non-linear least squares.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/association.hpp"
#include "host/calibration/robust_kernel.hpp"
#include "host/model/range_model.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// The unknowns of one anchor: position, then beta of each tag, then gamma of each tag. Size 3 + 2T.
using AnchorVector = Eigen::VectorXd;

[[nodiscard]] inline Eigen::Index beta_index(std::size_t tag) noexcept {
  return 3 + static_cast<Eigen::Index>(tag);
}
[[nodiscard]] inline Eigen::Index gamma_index(std::size_t tag, std::size_t tag_count) noexcept {
  return 3 + static_cast<Eigen::Index>(tag_count + tag);
}

// Gaussian belief in the position; a zero eigenvalue leaves a direction open.
struct PositionPrior {
  Eigen::Vector3d mean_m = Eigen::Vector3d::Zero();
  Eigen::Matrix3d information = Eigen::Matrix3d::Zero();  // 1/m^2
  bool surveyed = false;  // known beforehand: held fixed, biases alone are learnt
};

struct AnchorProblem {
  std::span<const Observation> rows;
  std::size_t tag_count = 0;
  model::RangePriors priors;
  PositionPrior position;
};

// The range an observation should have shown.
[[nodiscard]] inline model::AntennaPrediction predict(const Observation& row, const AnchorVector& anchor,
                                                      std::size_t tag_count) noexcept {
  return model::predict_antenna_range(row.tag_m, anchor.head<3>(), anchor(beta_index(row.tag)),
                                      anchor(gamma_index(row.tag, tag_count)));
}
[[nodiscard]] inline double residual_m(const Observation& row, const AnchorVector& anchor,
                                       std::size_t tag_count) noexcept {
  return row.range_m - predict(row, anchor, tag_count).range_m;
}

// Derivative of the predicted range by position, beta and gamma of the one pair that it sees.
using PairRow = Eigen::Matrix<double, 5, 1>;
using PairBlock = Eigen::Matrix<double, 5, 5>;
// Adds weight J J^T to a lower triangle.
inline void add_square(const PairRow& j, double weight, PairBlock& lower) noexcept {
  for (Eigen::Index column = 0; column < 5; ++column) {
    const double weighted = weight * j(column);
    for (Eigen::Index row = column; row < 5; ++row) lower(row, column) += weighted * j(row);
  }
}
[[nodiscard]] inline PairRow pair_jacobian(const model::AntennaPrediction& predicted, double gamma) noexcept {
  return {-gamma * predicted.direction.x(), -gamma * predicted.direction.y(),
          -gamma * predicted.direction.z(), 1.0, predicted.distance_m};
}

// Quadratic model of the robust cost at one point: cost, gradient, and the information with each row's
// weight, priors included, nothing damped. A surveyed position has no gradient and is tied to nothing.
struct NormalEquations {
  double cost = 0.0;
  Eigen::VectorXd gradient;
  Eigen::MatrixXd information;
};

// One kernel a tag.
[[nodiscard]] NormalEquations linearize(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                                        const AnchorVector& anchor);
[[nodiscard]] double robust_cost(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                                 const AnchorVector& anchor);

struct AnchorSolution {
  AnchorVector anchor;
  double cost = 0.0;
  double moved_sigmas = 0.0;  // from the start: the length in the metric of the information
  bool converged = false;
};

// Levenberg-Marquardt from a start. The result is never worse than the start and always finite.
[[nodiscard]] AnchorSolution solve_anchor(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                                          const AnchorVector& start, int max_iterations);

// Biases at the means of their priors.
[[nodiscard]] AnchorVector anchor_at(const Eigen::Vector3d& position_m, std::size_t tag_count,
                                     const model::RangePriors& priors);

}  // namespace groma::calibration
