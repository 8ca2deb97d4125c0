#include "host/calibration/anchor_solver.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>
#include <vector>

#include "host/calibration/mirror.hpp"
#include "host/calibration/site_solver.hpp"
#include "test/host/calibration/exact_kernel.hpp"
#include "test/support/numerical_jacobian.hpp"
#include "test/support/random.hpp"

namespace groma::calibration {
namespace {

constexpr std::size_t kSolvedTags = 3;

// Ranges from random places to one anchor, with biases; with noise and NLOS ranges on demand.
struct Scene {
  std::vector<Observation> rows;
  AnchorVector truth;
  AnchorProblem problem;
};

Scene make_scene(std::uint64_t seed, double noise_m, double blocked_share) {
  test::Random random(seed);
  Scene scene;
  scene.truth = anchor_at({8.0, -3.0, 2.5}, kSolvedTags, {});
  for (std::size_t tag = 0; tag < kSolvedTags; ++tag) {
    const PairIndex index = pair_index(tag, kSolvedTags);
    scene.truth(index[3 + model::kBeta]) = 0.3 * random.gaussian();
    scene.truth(index[3 + model::kGamma]) = 1.0 + 0.004 * random.gaussian();
  }
  for (int i = 0; i < 300; ++i) {
    Observation row;
    row.t_s = 0.1 * i;
    row.tag = static_cast<std::uint32_t>(static_cast<std::size_t>(i) % kSolvedTags);
    row.tag_m = {random.uniform(-6.0, 6.0), random.uniform(-6.0, 6.0), 0.3 + 0.7 * row.tag};
    row.range_m = predict(row, scene.truth, kSolvedTags).range_m + noise_m * random.gaussian();
    if (random.uniform() < blocked_share) row.range_m += random.uniform(0.5, 3.0);
    scene.rows.push_back(row);
  }
  scene.problem.rows = scene.rows;
  scene.problem.tag_count = kSolvedTags;
  scene.problem.position.information = 1e-4 * Eigen::Matrix3d::Identity();
  return scene;
}

TEST(AnchorSolver, GradientIsTheDerivativeOfTheCost) {
  const Scene scene = make_scene(1, 0.1, 0.2);
  const KernelShape shape = KernelShape{}.with_nlos(0.2);
  const std::vector<RobustKernel> kernels(kSolvedTags, RobustKernel(shape));
  // By the kernel's definition, not its table.
  const auto exact_cost = [&](const AnchorVector& anchor) {
    const Eigen::Vector3d offset_m = anchor.head<3>() - scene.problem.position.mean_m;
    double cost = 0.5 * offset_m.dot(scene.problem.position.information * offset_m);
    for (std::size_t tag = 0; tag < kSolvedTags; ++tag) {
      const PairIndex index = pair_index(tag, kSolvedTags);
      for (std::size_t i = 0; i < model::kPairTerms.size(); ++i) {
        const model::ScalarPrior& prior = scene.problem.priors.*model::kPairTerms[i].prior;
        cost += 0.5 * std::pow((anchor(index[3 + i]) - prior.mean) / prior.sigma, 2);
      }
    }
    for (const Observation& row : scene.rows) {
      cost -= std::log(test::exact_density(shape, residual_m(row, anchor, kSolvedTags)));
    }
    return cost;
  };
  test::Random random(2);
  for (int i = 0; i < 10; ++i) {
    const AnchorVector at = scene.truth + 0.05 * random.gaussians(scene.truth.size());
    const auto cost = [&](const Eigen::VectorXd& anchor) {
      return Eigen::VectorXd::Constant(1, exact_cost(anchor));
    };
    const Eigen::VectorXd expected = test::numerical_jacobian(cost, at, 1e-6).transpose();
    const NormalEquations found = linearize({.problem = scene.problem, .anchor = at, .kernels = kernels});
    EXPECT_NEAR((found.gradient - expected).norm() / (1.0 + expected.norm()), 0.0, 3e-4);
    EXPECT_NEAR(found.cost, exact_cost(at), 2e-4 * static_cast<double>(scene.rows.size()));
    EXPECT_NEAR(found.cost, robust_cost({.problem = scene.problem, .anchor = at, .kernels = kernels}),
                1e-9 * std::abs(found.cost));
  }
}

// Beside many ranges the priors are hardly visible.
TEST(AnchorSolver, WithoutRangesTheGradientIsThatOfThePriors) {
  AnchorProblem problem;
  problem.tag_count = kSolvedTags;
  problem.priors.beta_m = {0.1, 0.3};
  problem.priors.gamma = {0.99, 0.02};
  problem.position.mean_m = {1.0, 2.0, 3.0};
  problem.position.information = Eigen::Vector3d(4.0, 5.0, 6.0).asDiagonal();
  const std::vector<RobustKernel> kernels(kSolvedTags);
  AnchorVector anchor = anchor_at({2.0, 0.0, 3.5}, kSolvedTags, problem.priors);
  anchor.segment(3, 3) << 0.4, -0.2, 0.1;
  anchor.segment(6, 3) << 1.01, 0.97, 0.99;
  Eigen::VectorXd expected = Eigen::VectorXd::Zero(anchor.size());
  expected.head<9>() << 4.0, -10.0, 3.0, 0.3 / 0.09, -0.3 / 0.09, 0.0, 0.02 / 0.0004, -0.02 / 0.0004, 0.0;
  const NormalEquations found = linearize({.problem = problem, .anchor = anchor, .kernels = kernels});
  EXPECT_LT((found.gradient - expected).norm(), 1e-9);
}

TEST(AnchorSolver, InformationIsTheHessianWhereRangesArePerfect) {
  const Scene scene = make_scene(3, 0.0, 0.0);
  // An almost Gaussian kernel: its weight is the cost's curvature.
  const std::vector<RobustKernel> kernels(
      kSolvedTags, RobustKernel(KernelShape{.scale_m = 0.1, .wide = 1e-9, .gross = 1e-9}.with_nlos(1e-9)));
  const auto gradient = [&](const Eigen::VectorXd& anchor) {
    return Eigen::VectorXd(
        linearize({.problem = scene.problem, .anchor = anchor, .kernels = kernels}).gradient);
  };
  const Eigen::MatrixXd expected = test::numerical_jacobian(gradient, scene.truth, 1e-6);
  const Eigen::MatrixXd found =
      linearize({.problem = scene.problem, .anchor = scene.truth, .kernels = kernels}).information;
  EXPECT_NEAR((found - expected).norm() / expected.norm(), 0.0, 1e-4);
}

// With an almost Gaussian kernel, a range is weighted by its whole variance.
TEST(AnchorSolver, WeightsARangeByItsPosesCovariance) {
  Scene scene = make_scene(7, 0.1, 0.0);
  KernelShape shape{.scale_m = 0.1, .wide = 0.0, .bumps = {}, .gross = 1e-9};
  const std::vector<RobustKernel> kernels(kSolvedTags, RobustKernel(shape));
  test::Random random(8);
  Eigen::MatrixXd information = information_of_priors(scene.problem);
  for (Observation& row : scene.rows) {
    const Eigen::Vector2d one = 0.3 * random.gaussians(2);
    const Eigen::Vector2d other = 0.1 * random.gaussians(2);
    const Eigen::Matrix2d spread = one * one.transpose() + other * other.transpose();
    row.pose_spread_m2 = Eigen::Vector3d(spread(0, 0), spread(0, 1), spread(1, 1)).cast<float>();
    const PairIndex index = pair_index(row.tag, kSolvedTags);
    const double gamma = scene.truth(index[3 + model::kGamma]);
    const Eigen::Vector3d way = row.tag_m - scene.truth.head<3>();
    const Eigen::Vector2d j = gamma * way.normalized().head<2>();
    const double variance_m2 = 0.01 + j.dot(spread * j);
    const double r = 1.5 * std::sqrt(variance_m2);
    Observation off = row;
    off.range_m = predict(row, scene.truth, kSolvedTags).range_m + r;
    const KernelValue value =
        row_at({.problem = scene.problem, .anchor = scene.truth, .kernels = kernels}, off).value.seen;
    EXPECT_NEAR(value.weight * variance_m2, 1.0, 2e-3);
    EXPECT_NEAR(value.slope * variance_m2 / r, 1.0, 2e-3);
    EXPECT_NEAR(value.density * std::sqrt(2.0 * std::numbers::pi * variance_m2) / std::exp(-0.5 * 2.25), 1.0,
                2e-3);
    Eigen::VectorXd by_all = Eigen::VectorXd::Zero(scene.truth.size());
    by_all(index) << -gamma * way.normalized(), model::by_terms(way.norm(), way.normalized());
    information += by_all * by_all.transpose() / variance_m2;
  }
  // All ranges together weigh as each by itself.
  const NormalEquations whole =
      linearize({.problem = scene.problem, .anchor = scene.truth, .kernels = kernels});
  EXPECT_LT((whole.information - information).norm(), 2e-3 * information.norm());
  EXPECT_NEAR(whole.cost, robust_cost({.problem = scene.problem, .anchor = scene.truth, .kernels = kernels}),
              1e-3 * std::abs(whole.cost));
}

TEST(AnchorSolver, NeverEndsWorseThanItStarted) {
  const Scene scene = make_scene(4, 0.1, 0.4);
  const std::vector<RobustKernel> kernels(kSolvedTags, RobustKernel(KernelShape{}.with_nlos(0.3)));
  test::Random random(5);
  for (int i = 0; i < 50; ++i) {
    const AnchorVector start = anchor_at(20.0 * random.gaussians(3), kSolvedTags, {});
    const AnchorSolution solution = solve_anchor(scene.problem, kernels, start, 20);
    EXPECT_TRUE(solution.anchor.allFinite());
    EXPECT_LE(solution.cost,
              robust_cost({.problem = scene.problem, .anchor = start, .kernels = kernels}) + 1e-9);
  }
}

TEST(AnchorSolver, StaysFiniteWhenTheAnchorIsAtTheAntenna) {
  const Scene scene = make_scene(6, 0.1, 0.0);
  const std::vector<RobustKernel> kernels(kSolvedTags, RobustKernel());
  const AnchorVector start = anchor_at(scene.rows[0].tag_m, kSolvedTags, {});
  EXPECT_TRUE(solve_anchor(scene.problem, kernels, start, 20).anchor.allFinite());
}

TEST(Search, FindsTheAnchorWithoutAStart) {
  for (std::uint64_t seed = 10; seed < 30; ++seed) {
    const Scene scene = make_scene(seed, 0.1, 0.3);
    const AnchorFit found = search(scene.problem);
    EXPECT_LT((found.anchor - scene.truth).head<2>().norm(), 0.4) << "seed " << seed;
  }
}

TEST(SpreadAlongTheWay, ALongStopCountsNoMoreThanAShortOne) {
  std::vector<Observation> rows;
  for (int i = 0; i < 10000; ++i) {
    Observation row;
    row.t_s = i;
    // Stationary for nine tenths of the time.
    row.tag_m.x() = i < 9000 ? 0.0 : 0.1 * (i - 9000);
    rows.push_back(row);
  }
  const std::vector<Observation> few = spread_along_the_way(rows, 1, 100);
  ASSERT_GE(few.size(), 50U);
  EXPECT_LE(few.size(), 101U);
  std::size_t standing = 0;
  for (const Observation& row : few) standing += row.tag_m.x() == 0.0 ? 1U : 0U;
  EXPECT_LT(standing, few.size() / 4);
}

TEST(TagSpread, MirrorsAcrossTheFloorPlane) {
  test::Random random(8);
  std::vector<Observation> rows(500);
  for (Observation& row : rows) row.tag_m = {random.uniform(-9.0, 9.0), random.uniform(-4.0, 4.0), 1.0};
  const TagSpread spread = tag_spread(rows);
  const Eigen::Vector3d mirrored = spread.mirror({1.0, 2.0, 3.5}, 2);
  EXPECT_NEAR((mirrored - Eigen::Vector3d(1.0, 2.0, -1.5)).norm(), 0.0, 1e-9);
}

}  // namespace
}  // namespace groma::calibration
