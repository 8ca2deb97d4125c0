#include "host/calibration/verdict.hpp"

#include <gtest/gtest.h>

namespace groma::calibration {
namespace {

using model::AnchorVerdict;

constexpr double kClearExcess = 50.0;

AnchorEvidence good_evidence() {
  AnchorEvidence out;
  out.rows = 1000;
  out.nearest_m = 3.0;
  out.los_share = 0.95;
  out.mirror = MirrorHypothesis{.anchor = {}, .cost_excess = kClearExcess};
  out.side = MirrorHypothesis{.anchor = {}, .cost_excess = kClearExcess};
  return out;
}

// covariance_m2: of the position.
AnchorVerdict verdict_of(const AnchorEvidence& evidence,
                         const Eigen::Matrix3d& covariance_m2 = 1e-4 * Eigen::Matrix3d::Identity()) {
  model::AnchorCalibration anchor;
  anchor.position_m = {4.0, 3.0, 2.5};
  anchor.covariance = 1e-4 * Eigen::MatrixXd::Identity(9, 9);
  anchor.covariance.topLeftCorner<3, 3>() = covariance_m2;
  anchor.ranges_used = evidence.rows;
  judge_anchor(evidence, anchor);
  EXPECT_EQ(anchor.advice.empty(), anchor.verdict == AnchorVerdict::kOk);
  return anchor.verdict;
}

TEST(JudgeAnchor, AGoodAnchorIsOk) {
  EXPECT_EQ(verdict_of(good_evidence()), AnchorVerdict::kOk);
}

TEST(JudgeAnchor, AnAnchorNeverInLosIsMarked) {
  AnchorEvidence evidence = good_evidence();
  evidence.los_share = 0.1;
  EXPECT_EQ(verdict_of(evidence), AnchorVerdict::kNeverLos);
  evidence = good_evidence();
  evidence.los_states = LosEvidence{.polls = {0.05, 0.15, 0.8}, .counts_missed = true};
  EXPECT_EQ(verdict_of(evidence), AnchorVerdict::kNeverLos);
}

TEST(JudgeAnchor, ReflectionsSayNothingAgainstASurveyedPosition) {
  AnchorEvidence evidence = good_evidence();
  evidence.mirror.reset();
  evidence.side.reset();
  evidence.los_states = LosEvidence{.polls = {0.5, 0.2, 0.3}, .counts_missed = true, .far_share = 0.2};
  EXPECT_EQ(verdict_of(evidence), AnchorVerdict::kWeak);
  evidence.surveyed = true;
  EXPECT_EQ(verdict_of(evidence), AnchorVerdict::kOk);
  evidence.los_states->polls = {0.2, 0.3, 0.5};
  EXPECT_EQ(verdict_of(evidence), AnchorVerdict::kOk) << "hardly in LOS: only its biases are less certain";
  evidence.held_out.share_of_scale = 5.0;
  EXPECT_EQ(verdict_of(evidence), AnchorVerdict::kOk);
  evidence.los_states->short_share = 0.05;
  EXPECT_EQ(verdict_of(evidence), AnchorVerdict::kWeak) << "nothing shortens a range";
}

TEST(JudgeAnchor, AnAnchorHalfHiddenHasToBeKnownBetter) {
  const Eigen::Matrix3d covariance_m2 = 0.1 * 0.1 * Eigen::Matrix3d::Identity();
  AnchorEvidence evidence = good_evidence();
  EXPECT_EQ(verdict_of(evidence, covariance_m2), AnchorVerdict::kOk);
  evidence.ignored_share = 0.4;
  EXPECT_EQ(verdict_of(evidence, covariance_m2), AnchorVerdict::kWeak);
  EXPECT_EQ(verdict_of(evidence), AnchorVerdict::kOk);
}

TEST(JudgeAnchor, AMirrorThatIsNearlyAsLikelyIsMarked) {
  AnchorEvidence evidence = good_evidence();
  evidence.mirror->cost_excess = 1.0;
  EXPECT_EQ(verdict_of(evidence), AnchorVerdict::kWeakZ);
  evidence = good_evidence();
  evidence.side->cost_excess = 1.0;
  EXPECT_EQ(verdict_of(evidence), AnchorVerdict::kWeak);
  // Ranges whose residuals are correlated distinguish the sides less.
  evidence = good_evidence();
  evidence.inflation = kClearExcess;
  evidence.side.reset();
  EXPECT_EQ(verdict_of(evidence), AnchorVerdict::kWeakZ);
}

TEST(JudgeAnchor, TheWorseHorizontalAxisDecides) {
  const Eigen::Vector3d along = Eigen::Vector3d(3.0, 4.0, 0.0) / 5.0;
  for (const double sigma_m : {0.2, 0.5, 2.0}) {
    const Eigen::Matrix3d covariance_m2 =
        1e-4 * Eigen::Matrix3d::Identity() + sigma_m * sigma_m * along * along.transpose();
    EXPECT_EQ(verdict_of(good_evidence(), covariance_m2),
              sigma_m < 0.3 ? AnchorVerdict::kOk : AnchorVerdict::kWeak)
        << sigma_m;
  }
}

}  // namespace
}  // namespace groma::calibration
