#include "host/calibration/drive_error.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include <Eigen/Cholesky>

#include "host/calibration/site_solver.hpp"
#include "test/host/calibration/site_simulation.hpp"

namespace groma::calibration {
namespace {

struct Solved {
  Association association;
  std::vector<AnchorFit> fits;
  DriveError error;
};

// The fits refer to the association: do not copy.
void solve(const test::SimulatedSite& site, Solved& out) {
  const Drive drive = site.drive();
  out.association = associate(drive, HeightSource::kPose);
  out.fits = solve_site({.association = &out.association,
                         .priors = drive.priors,
                         .known_anchors = {},
                         .end_s = std::numeric_limits<double>::infinity()},
                        {});
  refine_site(out.fits, 5);
  out.error = correct_drive(out.association, out.fits);
}

// Mean of the antennas' positions.
Eigen::Vector2d center_of(const Solved& solved) {
  Eigen::Vector2d sum_m = Eigen::Vector2d::Zero();
  double rows = 0.0;
  for (const AnchorFit& fit : solved.fits) {
    for (const Observation& row : fit.problem.rows) sum_m += row.tag_m.head<2>();
    rows += static_cast<double>(fit.problem.rows.size());
  }
  return sum_m / rows;
}

TEST(DriveError, EstimatesSizeAndCorrelationTimeOfPoseDrift) {
  for (const double correlation_s : {5.0, 60.0}) {
    const test::SimulatedSite site = test::simulate_site({.ranges_per_pair = 600,
                                                          .pose_sigma_m = 0.05,
                                                          .pose_yaw_sigma_rad = 0.01,
                                                          .pose_correlation_s = correlation_s},
                                                         4);
    Solved solved;
    solve(site, solved);
    EXPECT_NEAR(std::log(solved.error.prior.drift.correlation_s / correlation_s), 0.0, std::log(1.5));
    EXPECT_NEAR(std::log(solved.error.prior.drift.sigma_m / 0.05), 0.0, std::log(2.0)) << correlation_s;
  }
}

// An error that repeats each lap shifts the whole map by little, unlike a first-order process. The smooth
// drift is selected, and the frame's covariance contains the mean pose error.
TEST(DriveError, DistinguishesSmoothFromRoughDrift) {
  double nees = 0.0;
  double sigma_m = 0.0;
  constexpr std::uint64_t kSeeds = 8;
  for (std::uint64_t seed = 1; seed <= kSeeds; ++seed) {
    test::SiteSettings settings{.ranges_per_pair = 600,
                                .pose_sigma_m = 0.05,
                                .pose_yaw_sigma_rad = 0.01,
                                .pose_correlation_s = 17.0,
                                .pose_damping_ratio = 0.1};
    const test::SimulatedSite site = test::simulate_site(settings, seed);
    Solved smooth;
    solve(site, smooth);
    ASSERT_TRUE(smooth.error.prior.drift.damping_ratio.has_value()) << seed;
    EXPECT_LT(*smooth.error.prior.drift.damping_ratio, 1.0) << seed;
    Eigen::Vector2d shift_m = Eigen::Vector2d::Zero();
    for (std::size_t i = 0; i < site.poses.size(); ++i) {
      shift_m +=
          Eigen::Vector2d(site.poses[i].x_m - site.truth[i].x_m, site.poses[i].y_m - site.truth[i].y_m);
    }
    shift_m /= static_cast<double>(site.poses.size());
    // The shift is that of the drive's center, which a turn about it leaves in place; the map's origin is far
    // away.
    Eigen::Matrix<double, 2, 4> at_center = Eigen::Matrix<double, 2, 4>::Zero();
    at_center.leftCols<2>().setIdentity();
    const Eigen::Vector2d center_m = center_of(smooth);
    at_center.col(3) << -center_m.y(), center_m.x();
    const Eigen::Matrix2d frame = at_center * smooth.error.frame_covariance * at_center.transpose();
    nees += shift_m.dot(frame.ldlt().solve(shift_m));
    sigma_m += std::sqrt(0.5 * frame.trace()) / kSeeds;

    settings.pose_damping_ratio.reset();
    Solved rough;
    solve(test::simulate_site(settings, seed), rough);
    EXPECT_FALSE(rough.error.prior.drift.damping_ratio.has_value()) << seed;
  }
  // 16 degrees of freedom, 99 %.
  EXPECT_GT(nees, 5.14);
  EXPECT_LT(nees, 34.3);
  RecordProperty("frame_sigma_m", std::to_string(sigma_m));
}

// Observations move towards the true antennas by more than half of the pose error.
TEST(DriveError, MovesTheAntennasTowardsTheTruth) {
  const test::SimulatedSite site = test::simulate_site(
      {.ranges_per_pair = 600, .pose_sigma_m = 0.1, .pose_yaw_sigma_rad = 0.02, .pose_correlation_s = 20.0},
      5);
  Solved solved;
  solve(site, solved);
  const Association before = associate(site.drive(), HeightSource::kPose);
  double square_before_m2 = 0.0;
  double square_after_m2 = 0.0;
  for (std::size_t a = 0; a < before.anchors.size(); ++a) {
    for (std::size_t i = 0; i < before.anchors[a].rows.size(); ++i) {
      const Observation& row = before.anchors[a].rows[i];
      const Eigen::Vector3d truth_m =
          test::antenna_of(test::true_pose(row.t_s, site.settings.route), before.tags[row.tag]);
      square_before_m2 += (row.tag_m - truth_m).squaredNorm();
      square_after_m2 += (solved.association.anchors[a].rows[i].tag_m - truth_m).squaredNorm();
    }
  }
  EXPECT_LT(square_after_m2, 0.25 * square_before_m2);
}

TEST(DriveError, LeavesExactPosesAsTheyAre) {
  const test::SimulatedSite site = test::simulate_site({}, 6);
  Solved solved;
  solve(site, solved);
  EXPECT_EQ(solved.error.prior.drift.sigma_m, 0.0);
  EXPECT_NEAR(solved.error.range_delay_s, 0.0, 3.0 * solved.error.range_delay_sigma_s);
  EXPECT_LT(solved.error.range_delay_sigma_s, 0.01);
  EXPECT_TRUE(solved.error.body.empty());
  const Association before = associate(site.drive(), HeightSource::kPose);
  for (std::size_t a = 0; a < before.anchors.size(); ++a) {
    EXPECT_TRUE(solved.error.added_covariance[a].isZero(0.0));
    EXPECT_EQ(solved.association.anchors[a].rows.back().tag_m, before.anchors[a].rows.back().tag_m);
  }
  EXPECT_NEAR(solved.error.frame_covariance(2, 2), 0.002 * 0.002, 1e-12);
  // A turn of the frame leaves the drive's center in place.
  const Eigen::Vector2d center_m = center_of(solved);
  Eigen::Matrix<double, 2, 4> at_center = Eigen::Matrix<double, 2, 4>::Identity();
  at_center.col(3) << -center_m.y(), center_m.x();
  const Eigen::Matrix2d shift_m2 = at_center * solved.error.frame_covariance * at_center.transpose();
  EXPECT_LT((shift_m2 - 0.002 * 0.002 * Eigen::Matrix2d::Identity()).norm(), 1e-12);
}

// Lever arms and patterns drawn from their priors are estimated, consistently with their covariance.
TEST(DriveError, EstimatesLeverArmsAndPatterns) {
  double nees = 0.0;
  double terms = 0.0;
  double square_before_m2 = 0.0;
  double square_after_m2 = 0.0;
  for (std::uint64_t seed = 1; seed <= 8; ++seed) {
    const test::SimulatedSite site = test::simulate_site({.ranges_per_pair = 400,
                                                          .sigma_m = 0.05,
                                                          .lever_arm_sigma_m = kLeverArmSigma_m,
                                                          .pattern_sigma_m = kPatternSigma_m},
                                                         seed);
    Solved solved;
    solve(site, solved);
    ASSERT_EQ(solved.error.body.size(), site.tags.size()) << seed;
    for (std::size_t tag = 0; tag < site.tags.size(); ++tag) {
      BodyVector truth;
      truth << site.lever_arm_error_m[tag], site.pattern_m[tag];
      const BodyVector error = solved.error.body[tag].mean - truth;
      nees += error.dot(solved.error.body[tag].covariance.ldlt().solve(error));
      terms += static_cast<double>(kBodyTerms);
      square_before_m2 += truth.head<2>().squaredNorm();
      square_after_m2 += error.head<2>().squaredNorm();
    }
  }
  // 99 %.
  EXPECT_NEAR(nees, terms, 2.576 * std::sqrt(2.0 * terms));
  EXPECT_LT(square_after_m2, 0.25 * square_before_m2);
}

// Range errors that depend on place look like pose drift or a pattern at short lags; but each anchor has its
// own.
TEST(DriveError, DoesNotTakePlaceDependentErrorsForDriftOrPatterns) {
  for (std::uint64_t seed = 1; seed <= 6; ++seed) {
    const test::SimulatedSite site =
        test::simulate_site({.ranges_per_pair = 600, .place_error_m = 0.08}, seed);
    Solved solved;
    solve(site, solved);
    EXPECT_EQ(solved.error.prior.drift.sigma_m, 0.0) << seed;
    EXPECT_TRUE(solved.error.body.empty()) << seed;
  }
}

}  // namespace
}  // namespace groma::calibration
