#include "host/calibration/covariance_budget.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <span>
#include <string>
#include <vector>

#include <Eigen/LU>

#include "test/support/random.hpp"

namespace groma::calibration {
namespace {

constexpr Eigen::Index kUnknowns = 5;  // of one tag
constexpr double kNearest_m = 3.0;

// A site with one anchor at z = 2 m and one tag.
class CovarianceBudget : public ::testing::Test {
 protected:
  CovarianceBudget() {
    AnchorFit& fit = site_.fits.emplace_back();
    fit.problem.rows = rows_;
    fit.problem.tag_count = 1;
    fit.problem.position.information = 1e-4 * Eigen::Matrix3d::Identity();
    fit.kernels.resize(1);
    fit.anchor.resize(kUnknowns);
    fit.anchor << 4.0, 3.0, 2.0, 0.0, 1.0;
    site_.beginning.resize(1);
    AnchorEvidence& evidence = site_.evidence.emplace_back();
    evidence.rows = rows_.size();
    evidence.nearest_m = kNearest_m;
    evidence.los_share = 0.95;
  }
  [[nodiscard]] Eigen::MatrixXd budget() const { return covariance_budget(site_, 0, solved_).covariance; }

  std::vector<Observation> rows_{100};
  Site site_;
  Eigen::MatrixXd solved_ = 1e-2 * Eigen::MatrixXd::Identity(kUnknowns, kUnknowns);
};

// As one more observation of the position, with twice the distance to the nearest antenna as its sigma.
TEST_F(CovarianceBudget, TheReachBoundsAnOpenDirection) {
  test::Random random(5);
  Eigen::MatrixXd root(kUnknowns, kUnknowns);
  for (Eigen::Index i = 0; i < kUnknowns; ++i) root.row(i) = random.gaussians(kUnknowns).transpose();
  root.row(2) *= 1000.0;
  solved_ = root * root.transpose() + Eigen::MatrixXd::Identity(kUnknowns, kUnknowns);
  Eigen::MatrixXd information = solved_.inverse();
  information.diagonal().head<3>().array() += 1.0 / std::pow(2.0 * kNearest_m, 2);
  const Eigen::MatrixXd expected = information.inverse();
  EXPECT_LT((budget() - expected).norm(), 1e-6 * expected.norm());
}

// The second moment about the fit.
TEST_F(CovarianceBudget, TheOtherSideCountsWithItsProbability) {
  const Eigen::MatrixXd before = budget();
  MirrorHypothesis mirror{.anchor = site_.fits[0].anchor, .cost_excess = 0.7};
  mirror.anchor(2) = -1.0;
  site_.evidence[0].mirror = mirror;
  const double probability = std::exp(-0.7) / (1.0 + std::exp(-0.7));
  Eigen::MatrixXd added = budget() - before;
  EXPECT_NEAR(added(2, 2), 9.0 * probability, 1e-9);
  added(2, 2) = 0.0;
  EXPECT_LT(added.norm(), 1e-9);
}

TEST_F(CovarianceBudget, TermsHaveTheirNames) {
  MirrorHypothesis mirror{.anchor = site_.fits[0].anchor, .cost_excess = 0.7};
  mirror.anchor(2) = -1.0;
  site_.evidence[0].mirror = mirror;
  std::vector<std::string> names;
  for (const BudgetTerm& term : covariance_budget(site_, 0, solved_).terms) names.emplace_back(term.name);
  EXPECT_THAT(names, ::testing::ElementsAre("ranges", "reach of the ranges", "mirror side across the plane",
                                            "frame of the poses"));
}

// What a wrong height does to the ranges, the biases make up for; not where x and y are weak.
TEST_F(CovarianceBudget, TheBiasesFollowTheHeightOfTheOtherSide) {
  solved_(2, 3) = solved_(3, 2) = -0.8e-2;
  solved_(0, 3) = solved_(3, 0) = 0.3e-2;
  for (const double weak_m2 : {0.0, 0.2}) {
    solved_(0, 0) = 1e-2 + weak_m2;
    site_.evidence[0].mirror.reset();
    const Eigen::MatrixXd before = budget();
    MirrorHypothesis mirror{.anchor = site_.fits[0].anchor, .cost_excess = 0.0};
    mirror.anchor(2) = -1.0;
    site_.evidence[0].mirror = mirror;
    const Eigen::MatrixXd added = budget() - before;
    // Half of 3 m squared, by d beta / d z = -0.8.
    EXPECT_NEAR(added(2, 2), 4.5, 1e-9);
    EXPECT_NEAR(added(2, 3), weak_m2 > 0.0 ? 0.0 : -0.8 * 4.5, 0.05);
    EXPECT_NEAR(added(3, 3), weak_m2 > 0.0 ? 0.0 : 0.64 * 4.5, 0.05);
    EXPECT_NEAR(added.topLeftCorner(2, 5).norm(), 0.0, 1e-9);
  }
}

// Ranges that contradict each other make the biases uncertain, and leave the survey's covariance.
TEST_F(CovarianceBudget, ASurveyedPositionKeepsItsCovariance) {
  site_.evidence[0].los_states =
      LosEvidence{.polls = {0.1, 0.2, 0.7}, .counts_missed = true, .far_share = 0.3};
  site_.error.unseen_frame_covariance = 0.01 * Eigen::Matrix4d::Identity();
  const Eigen::MatrixXd estimated = budget();
  EXPECT_GT(estimated(0, 0), 2.0 * solved_(0, 0));
  site_.fits[0].problem.position.surveyed = true;
  const Eigen::MatrixXd surveyed = budget();
  EXPECT_EQ(surveyed.topRows(3), solved_.topRows(3));
  EXPECT_EQ(surveyed.leftCols(3), solved_.leftCols(3));
  EXPECT_GT(surveyed(3, 3), 2.0 * solved_(3, 3));
}

TEST_F(CovarianceBudget, AnotherHeightByTheBeginningCountsOnlyWhereItWasKnown) {
  const double before_m2 = budget()(2, 2);
  AnchorFit& first = site_.beginning[0];
  first = site_.fits[0];
  first.problem.rows = std::span(rows_).first(60);
  first.anchor(2) = 3.0;
  site_.evidence[0].held_out = score_held_out(first, {});
  EXPECT_NEAR(budget()(2, 2), before_m2, 1e-12);
  site_.evidence[0].held_out.height_variance_m2 = 0.01;
  EXPECT_NEAR(budget()(2, 2), before_m2 + 1.0, 1e-9);
}

}  // namespace
}  // namespace groma::calibration
