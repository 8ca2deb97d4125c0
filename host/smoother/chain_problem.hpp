// Least squares over a chain of blocks, each coupled to the next, and a shared vector coupled to all blocks.
#pragma once

#include <cstddef>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Core>

namespace groma::smoother {

// The Gauss-Newton normal equations: block tridiagonal with a border for the shared vector. Solved by block
// elimination, in time and memory linear in the number of blocks.
class ChainProblem {
 public:
  // residual = by_first d(block k) + by_second d(block k + 1) + by_shared d(shared vector at the indices
  // `shared`) + noise; information: inverse covariance of that noise.
  struct Term {
    Term(Eigen::Index block_size, Eigen::Index residual_size, Eigen::Index shared_size);

    Eigen::MatrixXd by_first;   // residual_size x block_size
    Eigen::MatrixXd by_second;  // residual_size x block_size
    Eigen::MatrixXd by_shared;  // residual_size x shared_size
    std::vector<Eigen::Index> shared;
    Eigen::VectorXd residual;
    Eigen::MatrixXd information;  // residual_size x residual_size
  };

  struct Solution {
    std::vector<Eigen::VectorXd> blocks;
    Eigen::VectorXd shared;
  };

  // The last `considered` components of the shared vector are considered: they are not estimated, but their
  // prior covariance contributes to the covariances of the blocks.
  ChainProblem(std::size_t blocks, Eigen::Index block_size, Eigen::Index shared_size,
               Eigen::Index considered = 0);

  void clear();
  // Prior of the shared vector: zero mean, unit covariance. unknowns: its current value, zero for considered
  // components.
  void add_shared_prior(const Eigen::VectorXd& unknowns);
  // Adds a term between the blocks k and k + 1; both must exist.
  void add(std::size_t k, const Term& term);

  // Half the sum of squares of all terms and the prior, whitened.
  [[nodiscard]] double cost() const noexcept { return cost_; }

  // Requires positive definite normal equations. A Levenberg-Marquardt damping of the shared vector is
  // added to its information, with the blocks eliminated. Once per clear().
  [[nodiscard]] Solution solve(double damping = 0.0);
  // Marginal covariance of each block, after solve(), jointly with the components of the shared vector given
  // by `shared`, which follow the block's own rows. None of these may be considered.
  [[nodiscard]] std::vector<Eigen::MatrixXd> covariances(const std::vector<Eigen::Index>& shared = {}) const;

 private:
  struct Block {
    Eigen::MatrixXd own;
    Eigen::MatrixXd next;    // coupling with the next block
    Eigen::MatrixXd shared;  // coupling with the shared vector
    Eigen::VectorXd right;
    // After elimination: own^-1 times next, shared, right.
    Eigen::MatrixXd inverse;
    Eigen::MatrixXd to_next;
    Eigen::MatrixXd to_shared;
    Eigen::VectorXd alone;
  };

  std::vector<Block> blocks_;
  Eigen::MatrixXd shared_;
  Eigen::VectorXd shared_right_;
  double cost_ = 0.0;
  Eigen::Index block_size_;
  Eigen::Index shared_size_;
  Eigen::Index considered_;
  Eigen::LLT<Eigen::MatrixXd> shared_root_;  // of the estimated part
  Eigen::MatrixXd by_considered_;            // -d estimated / d considered
};

}  // namespace groma::smoother
