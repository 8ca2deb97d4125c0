#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <span>
#include <vector>

#include <Eigen/LU>

#include "host/calibration/calibrate.hpp"
#include "host/calibration/site.hpp"
#include "host/calibration/verdict.hpp"
#include "test/support/random.hpp"

namespace groma::calibration {
namespace {

TEST(AnchorEvidence, CountsRangesThatNlosDoesNotExplain) {
  Site site;
  site.association.anchors.resize(1);
  site.fits.resize(1);
  site.evidence.resize(1);
  site.los_states.anchors.resize(1);
  site.los_states.poll_shares.assign(1, LosVector(0.9, 0.05, 0.05));
  std::vector<std::vector<FittedRange>> fitted(1);
  for (int i = 0; i < 100; ++i) {
    const double residual_m = i < 10 ? 2.0 : (i < 15 ? -0.5 : 0.1);
    fitted[0].push_back(
        {.t_s = 0.1 * i, .tag_id = 1, .distance_m = 5.0 + 0.1 * i, .residual_m = residual_m, .los = 0.8});
  }
  gather_anchor_evidence(site, fitted);
  const AnchorEvidence& found = site.evidence[0];
  ASSERT_TRUE(found.los_states.has_value());
  EXPECT_NEAR(found.los_states->far_share, 0.10, 1e-12);
  EXPECT_NEAR(found.los_states->short_share, 0.05, 1e-12);
  EXPECT_NEAR(found.los_share, 0.8, 1e-12);
  EXPECT_NEAR(found.nearest_m, 5.0, 1e-12);
}

// Ranges near one place determine the anchor; later ones are from elsewhere, where they predict little. Their
// residuals are compared with the noise and the dense covariance of the prediction together.
TEST(ScoreHeldOut, CountsTheUncertaintyOfTheFit) {
  constexpr double kScale_m = 0.02;
  constexpr double kBetaSigma_m = 0.1;
  constexpr double kGammaSigma = 0.005;
  constexpr double kOff_m = 0.3;
  AnchorFit first;
  first.problem.tag_count = 1;
  first.problem.priors.beta_m = {0.0, kBetaSigma_m};
  first.problem.priors.gamma = {1.0, kGammaSigma};
  first.problem.position.information = 1e-4 * Eigen::Matrix3d::Identity();
  first.kernels = {RobustKernel(KernelShape{.scale_m = kScale_m, .wide = 0.0, .bumps = {}, .gross = 1e-9})};
  first.anchor = anchor_at({6.0, 2.0, 3.0}, 1, {});
  const auto by_unknowns = [&](const Observation& row) {
    const Eigen::Vector3d way_m = row.tag_m - first.anchor.head<3>();
    Eigen::VectorXd out(first.anchor.size());
    out << -way_m.normalized(), model::by_terms(way_m.norm(), way_m.normalized());
    return out;
  };
  Eigen::MatrixXd information = information_of_priors(first.problem);
  test::Random random(3);
  std::vector<Observation> rows(90);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    Observation& row = rows[i];
    row.t_s = 0.1 * static_cast<double>(i);
    const double reach_m = i < 60 ? 2.0 : 8.0;
    row.tag_m = {random.uniform(-reach_m, reach_m), random.uniform(-reach_m, reach_m),
                 random.uniform(0.0, 2.0)};
    row.range_m = (row.tag_m - first.anchor.head<3>()).norm();
    const Eigen::VectorXd j = by_unknowns(row);
    if (i < 60) information += j * j.transpose() / (kScale_m * kScale_m);
    if (i >= 60) row.range_m += i % 2 == 0 ? kOff_m : -kOff_m;
  }
  first.problem.rows = std::span(rows).first(60);
  const Eigen::MatrixXd covariance = information.inverse();
  double scale_m = 0.0;
  for (std::size_t i = 60; i < rows.size(); ++i) {
    const Eigen::VectorXd j = by_unknowns(rows[i]);
    scale_m += std::sqrt(kScale_m * kScale_m + j.dot(covariance * j)) / 30.0;
  }
  ASSERT_GT(scale_m, 1.5 * kScale_m);
  const HeldOut found = score_held_out(first, std::span(rows).subspan(60));
  ASSERT_TRUE(found.share_of_scale.has_value());
  EXPECT_NEAR(*found.rms_m, kOff_m, 1e-9);
  // 1.4826: the standard deviation of a Gaussian over its median absolute value.
  EXPECT_NEAR(*found.share_of_scale, 1.4826 * kOff_m / scale_m, 0.01 * kOff_m / scale_m);
  EXPECT_NEAR(found.height_variance_m2, covariance(2, 2), 0.01 * covariance(2, 2));
}

TEST(ScoreHeldOut, WithoutLaterRangesTheHeightIsUnknown) {
  AnchorFit first;
  first.problem.tag_count = 1;
  first.problem.position.information = Eigen::Matrix3d::Identity();
  first.kernels.resize(1);
  first.anchor = anchor_at(Eigen::Vector3d::Zero(), 1, {});
  const HeldOut found = score_held_out(first, {});
  EXPECT_FALSE(found.rms_m.has_value());
  EXPECT_EQ(found.height_variance_m2, std::numeric_limits<double>::infinity());
}

}  // namespace
}  // namespace groma::calibration
