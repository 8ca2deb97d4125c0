// Drives that cannot be calibrated, or hardly: a verdict and finite values, never a wrong position marked ok.
#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include <Eigen/Cholesky>

#include "host/calibration/calibrate.hpp"
#include "test/host/calibration/site_simulation.hpp"

namespace groma::calibration {
namespace {

using model::AnchorVerdict;
using model::Verdict;

void expect_finite(const Result& result) {
  for (const model::AnchorCalibration& anchor : result.calibration.anchors) {
    EXPECT_TRUE(anchor.position_m.allFinite());
    EXPECT_TRUE(anchor.covariance.allFinite());
    EXPECT_EQ(anchor.covariance.llt().info(), Eigen::Success) << "covariance not positive definite";
    for (const model::PairBias& pair : anchor.pairs) {
      EXPECT_TRUE(std::isfinite(pair.beta_m) && std::isfinite(pair.gamma));
      EXPECT_GT(pair.beta_sigma_m, 0.0);
      EXPECT_GT(pair.gamma_sigma, 0.0);
    }
    EXPECT_EQ(anchor.verdict == AnchorVerdict::kOk, anchor.advice.empty());
  }
}

// Each anchor marked ok has to be within its covariance of the truth.
void expect_no_lie(const Result& result, const test::SimulatedSite& site) {
  expect_finite(result);
  for (std::size_t a = 0; a < result.calibration.anchors.size(); ++a) {
    const model::AnchorCalibration& anchor = result.calibration.anchors[a];
    if (anchor.verdict != AnchorVerdict::kOk) continue;
    const Eigen::Vector3d error_m = anchor.position_m - site.anchors[a].position_m;
    EXPECT_LT(error_m.dot(anchor.covariance.topLeftCorner<3, 3>().ldlt().solve(error_m)), 16.3)
        << "anchor " << anchor.id << " off by " << error_m.transpose();
  }
}

TEST(DegenerateDrive, ThatNeverMovesIsUnusable) {
  const test::SimulatedSite site = with_path(test::simulate_site({}, 1), test::standing_pose);
  const Result result = calibrate(site.drive());
  expect_no_lie(result, site);
  for (const auto& anchor : result.calibration.anchors) EXPECT_NE(anchor.verdict, AnchorVerdict::kOk);
  EXPECT_EQ(result.calibration.verdict, Verdict::kUnusable);
}

TEST(DegenerateDrive, InAStraightLineLeavesTheSideOpen) {
  const test::SimulatedSite site = with_path(test::simulate_site({}, 2), test::straight_pose);
  // Three tags side by side distinguish the two sides; one does not.
  expect_no_lie(calibrate(site.drive()), site);
  Drive one_tag = site.drive();
  one_tag.tags = one_tag.tags.first(1);
  const Result result = calibrate(one_tag);
  expect_no_lie(result, site);
  for (const auto& anchor : result.calibration.anchors) {
    EXPECT_NE(anchor.verdict, AnchorVerdict::kOk) << anchor.id;
    EXPECT_NE(anchor.verdict, AnchorVerdict::kWeakZ) << anchor.id;
  }
  EXPECT_EQ(result.calibration.verdict, Verdict::kUnusable);
}

TEST(DegenerateDrive, WithOneTagMarksHeights) {
  const test::SimulatedSite site = test::simulate_site({}, 3);
  Drive drive = site.drive();
  drive.tags = drive.tags.first(1);
  const Result result = calibrate(drive);
  expect_no_lie(result, site);
  for (std::size_t a = 0; a < site.anchors.size(); ++a) {
    const model::AnchorCalibration& anchor = result.calibration.anchors[a];
    // The only antenna has one height: above and below look the same.
    ASSERT_TRUE(anchor.mirror_ratio.has_value());
    EXPECT_GT(*anchor.mirror_ratio, 0.9);
    EXPECT_NE(anchor.verdict, AnchorVerdict::kOk);
    EXPECT_LT((anchor.position_m - site.anchors[a].position_m).head<2>().norm(), 0.3);
  }
}

// Bumps of millimetres are in the poses, but errors of ranges that depend on the place are far larger.
// However many ranges there are, they do not tell above from below.
TEST(DegenerateDrive, WithOneTagOnAFloorWithBumpsOfMillimetresMarksHeights) {
  constexpr double kBump_m = 0.006;
  for (const std::uint64_t seed : {1U, 2U, 3U}) {
    const test::SiteSettings settings{.ranges_per_pair = 3000, .sigma_m = 0.02};
    test::SimulatedSite site = with_path(test::simulate_site(settings, seed), [](double t_s) {
      model::PoseSample pose = test::true_pose(t_s, test::Route::kWaves);
      pose.z_m = kBump_m * std::sin(1.1 * pose.x_m) * std::cos(0.9 * pose.y_m);
      return pose;
    });
    test::Random random(seed);
    std::vector<test::PlaceError> errors;
    for (std::size_t a = 0; a < site.anchors.size(); ++a) errors.emplace_back(0.01, random);
    for (model::RangeSample& range : site.ranges) {
      const Eigen::Vector2d place_m = test::place_on(test::Route::kWaves, range.t_s);
      range.range_m += errors[range.anchor_id - site.anchors.front().id].at(place_m);
    }
    Drive drive = site.drive();
    drive.tags = drive.tags.last(1);
    const Result result = calibrate(drive);
    expect_no_lie(result, site);
    for (const model::AnchorCalibration& anchor : result.calibration.anchors)
      EXPECT_NE(anchor.verdict, AnchorVerdict::kOk) << anchor.id;
  }
}

TEST(DegenerateDrive, WithoutPosesRangesTagsOrAnything) {
  const test::SimulatedSite site = test::simulate_site({}, 4);
  Drive no_poses = site.drive();
  no_poses.poses = {};
  Result result = calibrate(no_poses);
  expect_finite(result);
  EXPECT_EQ(result.calibration.verdict, Verdict::kUnusable);
  EXPECT_EQ(result.ranges_used, 0U);
  EXPECT_EQ(result.ranges_rejected, site.ranges.size());
  ASSERT_EQ(result.calibration.anchors.size(), site.anchors.size());
  for (const auto& anchor : result.calibration.anchors) EXPECT_EQ(anchor.verdict, AnchorVerdict::kNoData);

  Drive no_ranges = site.drive();
  no_ranges.ranges = {};
  result = calibrate(no_ranges);
  EXPECT_EQ(result.calibration.verdict, Verdict::kUnusable);
  EXPECT_TRUE(result.calibration.anchors.empty());

  Drive no_tags = site.drive();
  no_tags.tags = {};
  result = calibrate(no_tags);
  expect_finite(result);
  EXPECT_EQ(result.calibration.verdict, Verdict::kUnusable);

  EXPECT_EQ(calibrate(Drive{}).calibration.verdict, Verdict::kUnusable);
}

TEST(DegenerateDrive, WithOneRangeEachIsNoData) {
  test::SimulatedSite site = test::simulate_site({.ranges_per_pair = 1}, 5);
  const Result result = calibrate(site.drive());
  expect_finite(result);
  for (const auto& anchor : result.calibration.anchors) EXPECT_EQ(anchor.verdict, AnchorVerdict::kNoData);
}

TEST(DegenerateDrive, OfGarbageIsNeverTrusted) {
  test::SimulatedSite site = test::simulate_site({}, 6);
  test::Random random(6);
  for (model::RangeSample& range : site.ranges) range.range_m = random.uniform(0.0, 40.0);
  const Result result = calibrate(site.drive());
  expect_no_lie(result, site);
  EXPECT_NE(result.calibration.verdict, Verdict::kUsable);
}

TEST(DegenerateDrive, SurvivesZerosWrapsAndNotANumber) {
  test::SimulatedSite site = test::simulate_site({.outlier_share = 0.1}, 7);
  test::Random random(7);
  for (std::size_t i = 0; i < site.ranges.size(); ++i) {
    if (i % 11 == 0) site.ranges[i].range_m = 0.0;
    if (i % 13 == 0) site.ranges[i].range_m = 300e3;
    if (i % 17 == 0) site.ranges[i].range_m = std::numeric_limits<double>::quiet_NaN();
    if (i % 19 == 0) site.ranges[i].range_m = random.uniform(0.1, 900.0);
  }
  for (std::size_t i = 0; i < site.poses.size(); i += 31)
    site.poses[i].yaw_rad = std::numeric_limits<double>::quiet_NaN();
  const Result result = calibrate(site.drive());
  expect_no_lie(result, site);
  for (std::size_t a = 0; a < site.anchors.size(); ++a) {
    EXPECT_LT((result.calibration.anchors[a].position_m - site.anchors[a].position_m).head<2>().norm(), 0.2);
  }
}

TEST(DegenerateDrive, WithMeaninglessPriorsStaysFinite) {
  const test::SimulatedSite site = test::simulate_site({}, 8);
  Drive drive = site.drive();
  drive.priors.sigma_m = 0.0;
  drive.priors.beta_m = {std::numeric_limits<double>::quiet_NaN(), -1.0};
  drive.priors.gamma = {0.0, 0.0};
  expect_finite(calibrate(drive));
}

}  // namespace
}  // namespace groma::calibration
