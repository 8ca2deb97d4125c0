// Least squares over a chain of blocks, each related to the next, and beside them a vector that all share.
#pragma once

#include <cstddef>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Core>

namespace groma::smoother {

// Gauss-Newton's normal equations; solved by eliminating block after block, so that time and memory are
// linear in the number of blocks.
class ChainProblem {
 public:
  // residual = by_first d(block k) + by_second d(block k + 1) + by_shared d(shared at those places) + noise
  // of that information.
  struct Term {
    Term(Eigen::Index block_size, Eigen::Index residual_size, Eigen::Index shared_size);

    Eigen::MatrixXd by_first;   // residual_size x block_size
    Eigen::MatrixXd by_second;  // the same
    Eigen::MatrixXd by_shared;  // residual_size x shared_size
    std::vector<Eigen::Index> shared;
    Eigen::VectorXd residual;
    Eigen::MatrixXd information;  // residual_size x residual_size
  };

  struct Solution {
    std::vector<Eigen::VectorXd> blocks;
    Eigen::VectorXd shared;
  };

  // The last `considered` of the shared vector stay as they are: what they may be off by is in the
  // covariances of blocks, and nothing is learnt of them.
  ChainProblem(std::size_t blocks, Eigen::Index block_size, Eigen::Index shared_size,
               Eigen::Index considered = 0);

  void clear();
  // The shared vector, now at `unknowns`, is drawn with unit covariance about zero; of those considered,
  // `unknowns` is zero.
  void add_shared_prior(const Eigen::VectorXd& unknowns);
  // Between block k and the next one; k + 1 is a block, too.
  void add(std::size_t k, const Term& term);

  // The normal equations have to be positive definite.
  [[nodiscard]] Solution solve();
  // Of each block, after solve(): with all others and what is shared not known either. Beside it, behind the
  // block's own rows, those of the shared vector that are named; none of them is considered.
  [[nodiscard]] std::vector<Eigen::MatrixXd> covariances(const std::vector<Eigen::Index>& shared = {}) const;

 private:
  struct Block {
    Eigen::MatrixXd own;
    Eigen::MatrixXd next;    // with the next block
    Eigen::MatrixXd shared;  // with the shared vector
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
  Eigen::Index block_size_;
  Eigen::Index shared_size_;
  Eigen::Index considered_;
  Eigen::LLT<Eigen::MatrixXd> shared_root_;  // of what is solved for
  Eigen::MatrixXd by_considered_;            // what of it is off by each of those considered, negative
};

}  // namespace groma::smoother
