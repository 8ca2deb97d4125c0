#include "host/smoother/chain_problem.hpp"

#include <gtest/gtest.h>

#include <Eigen/LU>

#include "test/support/random.hpp"

namespace groma::smoother {
namespace {

constexpr std::size_t kBlocks = 7;
constexpr Eigen::Index kBlockSize = 3;
constexpr Eigen::Index kSharedSize = 5;
constexpr Eigen::Index kChainSize = static_cast<Eigen::Index>(kBlocks) * kBlockSize;

// Reference: the normal equations as one dense matrix.
struct Dense {
  Eigen::MatrixXd information = Eigen::MatrixXd::Zero(kChainSize + kSharedSize, kChainSize + kSharedSize);
  Eigen::VectorXd right = Eigen::VectorXd::Zero(kChainSize + kSharedSize);

  double cost = 0.0;

  void add(std::size_t k, const ChainProblem::Term& term) {
    cost += 0.5 * term.residual.dot(term.information * term.residual);
    Eigen::MatrixXd row = Eigen::MatrixXd::Zero(term.residual.size(), kChainSize + kSharedSize);
    const auto at = static_cast<Eigen::Index>(k) * kBlockSize;
    row.middleCols(at, kBlockSize) = term.by_first;
    row.middleCols(at + kBlockSize, kBlockSize) = term.by_second;
    for (std::size_t j = 0; j < term.shared.size(); ++j) {
      row.col(kChainSize + term.shared[j]) += term.by_shared.col(static_cast<Eigen::Index>(j));
    }
    information += row.transpose() * term.information * row;
    right += row.transpose() * term.information * term.residual;
  }
};

class WithConsidered : public ::testing::TestWithParam<Eigen::Index> {};
INSTANTIATE_TEST_SUITE_P(ChainProblem, WithConsidered, ::testing::Values(0, 2, 5));

TEST_P(WithConsidered, SolutionAndCovariancesEqualTheDenseProblem) {
  const Eigen::Index considered = GetParam();
  const Eigen::Index solved = kSharedSize - considered;
  test::Random random(11);
  ChainProblem problem(kBlocks, kBlockSize, kSharedSize, considered);
  // clear() removes the terms of a previous round.
  problem.clear();
  ChainProblem::Term stale(kBlockSize, 1, 0);
  stale.by_first.setOnes();
  stale.information.setOnes();
  problem.add(0, stale);
  problem.clear();

  Dense dense;
  Eigen::VectorXd unknowns = random.gaussians(kSharedSize);
  unknowns.tail(considered).setZero();
  problem.add_shared_prior(unknowns);
  dense.information.bottomRightCorner(kSharedSize, kSharedSize).setIdentity();
  dense.right.tail(kSharedSize) = -unknowns;
  dense.cost = 0.5 * unknowns.squaredNorm();
  for (int i = 0; i < 60; ++i) {
    const std::size_t k = static_cast<std::size_t>(i) % (kBlocks - 1);
    ChainProblem::Term term(kBlockSize, 2, 3);
    term.by_first = Eigen::MatrixXd::NullaryExpr(2, kBlockSize, [&] { return random.gaussian(); });
    term.by_second = Eigen::MatrixXd::NullaryExpr(2, kBlockSize, [&] { return random.gaussian(); });
    term.by_shared = Eigen::MatrixXd::NullaryExpr(2, 3, [&] { return random.gaussian(); });
    term.shared = {i % kSharedSize, (i + 1) % kSharedSize, (i + 3) % kSharedSize};
    term.residual = random.gaussians(2);
    const Eigen::MatrixXd root = Eigen::MatrixXd::NullaryExpr(2, 2, [&] { return random.gaussian(); });
    term.information = root * root.transpose() + Eigen::MatrixXd::Identity(2, 2);
    problem.add(k, term);
    dense.add(k, term);
  }

  EXPECT_NEAR(problem.cost(), dense.cost, 1e-10 * dense.cost);
  const ChainProblem::Solution solution = problem.solve();
  const Eigen::Index size = kChainSize + solved;
  const Eigen::MatrixXd inverse = dense.information.topLeftCorner(size, size).inverse();
  const Eigen::VectorXd expected = inverse * dense.right.head(size);
  // Derivative of the estimated part w.r.t. the considered one, which has unit covariance.
  const Eigen::MatrixXd moved = inverse * dense.information.topRightCorner(size, considered);
  const Eigen::MatrixXd covariance = inverse + moved * moved.transpose();
  const std::vector<Eigen::MatrixXd> covariances = problem.covariances();
  std::vector<Eigen::Index> beside;
  if (solved > 0) beside = {solved - 1, 0};
  const std::vector<Eigen::MatrixXd> with_shared = problem.covariances(beside);
  for (std::size_t k = 0; k < kBlocks; ++k) {
    const auto at = static_cast<Eigen::Index>(k) * kBlockSize;
    EXPECT_LT((solution.blocks[k] - expected.segment(at, kBlockSize)).norm(), 1e-10) << k;
    EXPECT_LT((covariances[k] - covariance.block(at, at, kBlockSize, kBlockSize)).norm(), 1e-10) << k;
    std::vector<Eigen::Index> rows;
    rows.reserve(kBlockSize + beside.size());
    for (Eigen::Index i = 0; i < kBlockSize; ++i) rows.push_back(at + i);
    for (const Eigen::Index shared : beside) rows.push_back(kChainSize + shared);
    EXPECT_LT((with_shared[k] - covariance(rows, rows)).norm(), 1e-10) << k;
  }
  EXPECT_LT((solution.shared.head(solved) - expected.tail(solved)).norm(), 1e-10);
  EXPECT_EQ(solution.shared.tail(considered).norm(), 0.0);
}

// A damped step is shorter in the shared vector, and the blocks follow it.
TEST(ChainProblem, DampingShortensTheSharedStep) {
  const auto solve = [](double damping) {
    ChainProblem problem(2, 1, 1);
    problem.add_shared_prior(Eigen::VectorXd::Zero(1));
    ChainProblem::Term term(1, 2, 1);
    term.by_first << 1.0, 0.0;
    term.by_second << 0.0, 1.0;
    term.by_shared << 1.0, 2.0;
    term.shared = {0};
    term.residual << 0.0, 3.0;
    term.information = Eigen::Matrix2d::Identity();
    problem.add(0, term);
    ChainProblem::Term known(1, 1, 0);
    known.by_second << 1.0;
    known.information << 3.0;
    problem.add(0, known);
    return problem.solve(damping);
  };
  // With the blocks eliminated: information 1 + 4 * 3 / (1 + 3) = 4, descent 2 * 3 * 3 / (1 + 3) = 4.5.
  for (const double damping : {0.0, 1.0, 8.0}) {
    const ChainProblem::Solution step = solve(damping);
    const double shared = 4.5 / (4.0 + damping);
    EXPECT_NEAR(step.shared(0), shared, 1e-12);
    EXPECT_NEAR(step.blocks[0](0), -shared, 1e-12);
    EXPECT_NEAR(step.blocks[1](0), (3.0 - 2.0 * shared) / 4.0, 1e-12);
  }
}

}  // namespace
}  // namespace groma::smoother
