#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <limits>
#include <optional>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/LU>

#include "host/calibration/anchor_solver.hpp"
#include "host/calibration/site_solver.hpp"
#include "test/host/calibration/site_simulation.hpp"

namespace groma::calibration {
namespace {

constexpr Eigen::Index kSize = 7;

Eigen::MatrixXd random_covariance(std::uint64_t seed) {
  test::Random random(seed);
  Eigen::MatrixXd root(kSize, kSize);
  for (Eigen::Index column = 0; column < kSize; ++column) root.col(column) = random.gaussians(kSize);
  return root * root.transpose() + 0.1 * Eigen::MatrixXd::Identity(kSize, kSize);
}

// Correlated residuals scatter the score `inflation` times as much.
TEST(AnchorCovariance, FollowsTheScatterOfTheScore) {
  constexpr double kInflation = 2.5;
  Evidence evidence;
  evidence.information = random_covariance(11);
  evidence.prior_information = random_covariance(12);
  evidence.score_variance = random_covariance(13);
  const Eigen::MatrixXd inverse = evidence.information.inverse();
  const Eigen::MatrixXd scatter = evidence.prior_information + kInflation * evidence.score_variance;
  const Eigen::MatrixXd expected = inverse * scatter * inverse;
  EXPECT_LT((anchor_covariance(evidence, kInflation) - expected).norm(), 1e-9 * expected.norm());
}

// The biases were solved with the position held: they move with its error, which is independent of the score.
TEST(AnchorCovariance, OfASurveyedAnchorHasTheSurveysErrorInTheBiases) {
  constexpr double kInflation = 2.5;
  constexpr Eigen::Index kBiases = kSize - 3;
  Evidence evidence;
  evidence.surveyed = true;
  evidence.information = random_covariance(14);
  evidence.prior_information = Eigen::MatrixXd::Identity(kSize, kSize);
  evidence.prior_information.topLeftCorner<3, 3>() = 2500.0 * Eigen::Matrix3d::Identity();
  evidence.score_variance = random_covariance(15);
  // Errors of the position and of the score, side by side.
  Eigen::MatrixXd errors = Eigen::MatrixXd::Zero(kSize, kSize);
  errors.topLeftCorner<3, 3>() = Eigen::Matrix3d::Identity() / 2500.0;
  errors.bottomRightCorner<kBiases, kBiases>() =
      evidence.prior_information.bottomRightCorner<kBiases, kBiases>() +
      kInflation * evidence.score_variance.bottomRightCorner<kBiases, kBiases>();
  Eigen::MatrixXd by_errors = Eigen::MatrixXd::Identity(kSize, kSize);
  const Eigen::MatrixXd inverse = evidence.information.bottomRightCorner<kBiases, kBiases>().inverse();
  by_errors.bottomLeftCorner<kBiases, 3>() = -inverse * evidence.information.bottomLeftCorner<kBiases, 3>();
  by_errors.bottomRightCorner<kBiases, kBiases>() = inverse;
  const Eigen::MatrixXd expected = by_errors * errors * by_errors.transpose();
  EXPECT_LT((anchor_covariance(evidence, kInflation) - expected).norm(), 1e-9 * expected.norm());
}

TEST(Jackknife, AddsNothingToACovarianceThatItAgreesWith) {
  const Eigen::MatrixXd expected = random_covariance(1);
  const Eigen::Matrix3d position = expected.topLeftCorner<3, 3>();
  EXPECT_EQ(excess_of_jackknife(position, expected).norm(), 0.0);
  EXPECT_EQ(excess_of_jackknife(5.0 * position, expected).norm(), 0.0) << "as large as that by chance";
  EXPECT_EQ(excess_of_jackknife(Eigen::Matrix3d::Zero(), expected).norm(), 0.0);
}

// One direction of the position scatters twenty times as much: its variance becomes 40 times as large, and
// the conditional covariance of the biases given the position stays.
TEST(Jackknife, WidensTheDirectionThatItContradicts) {
  const Eigen::MatrixXd expected = random_covariance(2);
  const Eigen::Matrix3d position = expected.topLeftCorner<3, 3>();
  const Eigen::Vector3d direction = position.llt().matrixL() * Eigen::Vector3d(0.6, 0.0, 0.8);
  const Eigen::Matrix3d jackknife = position + 19.0 * direction * direction.transpose();
  const Eigen::MatrixXd widened = expected + excess_of_jackknife(jackknife, expected);
  const Eigen::Matrix3d found = widened.topLeftCorner<3, 3>();
  EXPECT_NEAR((found - position - 39.0 * direction * direction.transpose()).norm(), 0.0, 1e-8);

  const Eigen::MatrixXd regression = expected.leftCols<3>() * position.inverse();
  EXPECT_NEAR((widened.leftCols<3>() * found.inverse() - regression).norm(), 0.0, 1e-8);
  const auto left = [](const Eigen::MatrixXd& covariance) -> Eigen::MatrixXd {
    return covariance.bottomRightCorner<4, 4>() - covariance.bottomLeftCorner<4, 3>() *
                                                      covariance.topLeftCorner<3, 3>().inverse() *
                                                      covariance.topRightCorner<3, 4>();
  };
  EXPECT_NEAR((left(widened) - left(expected)).norm(), 0.0, 1e-8);
}

// Expected jackknife of a linear problem with independent residuals: without a part, the solution moves with
// the covariance of the rest minus that of the whole.
Eigen::Matrix3d expected_jackknife(const AnchorFit& fit) {
  const auto covariance = [](const AnchorFit& of) -> Eigen::Matrix3d {
    return gather_evidence(of).information.inverse().topLeftCorner<3, 3>();
  };
  const double begin_s = fit.problem.rows.front().t_s;
  const double span_s = fit.problem.rows.back().t_s - begin_s;
  Eigen::Matrix3d sum = Eigen::Matrix3d::Zero();
  for (int part = 0; part < 5; ++part) {
    std::vector<Observation> kept;
    for (const Observation& row : fit.problem.rows) {
      const double share = 5.0 * (row.t_s - begin_s) / span_s;
      if (std::min(4, static_cast<int>(share)) != part) kept.push_back(row);
    }
    AnchorFit rest = fit;
    rest.problem.rows = kept;
    sum += covariance(rest) - covariance(fit);
  }
  return 0.8 * sum;
}

// Mean ratio of the jackknife to its expectation, over the anchors of some sites.
double mean_ratio(const test::SiteSettings& settings) {
  double sum = 0.0;
  double anchors = 0.0;
  for (std::uint64_t seed = 1; seed <= 4; ++seed) {
    const test::SimulatedSite site = test::simulate_site(settings, seed);
    const Drive drive = site.drive();
    const Association association = associate(drive, HeightSource::kPose);
    std::vector<AnchorFit> fits = solve_site({.association = &association,
                                              .priors = drive.priors,
                                              .known_anchors = {},
                                              .end_s = std::numeric_limits<double>::infinity()},
                                             {});
    refine_site(fits, 5);
    for (const AnchorFit& fit : fits) {
      const std::optional<Eigen::Matrix3d> jackknife = jackknife_covariance(fit);
      if (!jackknife) continue;
      sum += (expected_jackknife(fit).inverse() * *jackknife).trace() / 3.0;
      anchors += 1.0;
    }
  }
  EXPECT_EQ(anchors, 48.0);
  return sum / anchors;
}

TEST(Jackknife, IsThatOfALinearProblemWhereResidualsAreIndependent) {
  const double ratio = mean_ratio({.ranges_per_pair = 400});
  EXPECT_GT(ratio, 0.75);
  EXPECT_LT(ratio, 1.3);
}

TEST(Jackknife, DetectsPlaceDependentErrors) {
  EXPECT_GT(mean_ratio({.ranges_per_pair = 400, .place_error_m = 0.1}), 3.0);
}

TEST(Jackknife, NeedsEnoughRangesAndAFreePosition) {
  AnchorFit fit;
  EXPECT_FALSE(jackknife_covariance(fit).has_value());
  std::vector<Observation> rows(100);
  fit.problem.rows = rows;
  fit.problem.position.surveyed = true;
  EXPECT_FALSE(jackknife_covariance(fit).has_value());
}

}  // namespace
}  // namespace groma::calibration
