// The whole calibration on simulated drives. calibration_campaign_test.cpp tests its accuracy.
#include "host/calibration/calibrate.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "test/host/calibration/site_simulation.hpp"

namespace groma::calibration {
namespace {

TEST(Calibrate, EstimatesTheRangeDelay) {
  const test::SimulatedSite late = test::simulate_site({.ranges_per_pair = 600, .range_delay_s = 0.05}, 9);
  const model::Calibration found = calibrate(late.drive()).calibration;
  EXPECT_NEAR(found.range_delay_s, 0.05, 0.01);
  EXPECT_NEAR(found.range_delay_s, 0.05, 5.0 * found.range_delay_sigma_s);
  const test::SimulatedSite punctual = test::simulate_site({.ranges_per_pair = 600}, 9);
  const model::Calibration none = calibrate(punctual.drive()).calibration;
  EXPECT_GT(none.range_delay_sigma_s, 0.0);
  EXPECT_NEAR(none.range_delay_s, 0.0, 3.0 * none.range_delay_sigma_s);
}

TEST(Calibrate, ReportsTheCommonFramesCovariance) {
  const test::SimulatedSite site = test::simulate_site({.pose_sigma_m = 0.05}, 10);
  const Eigen::Matrix4d frame = calibrate(site.drive()).calibration.common_frame_covariance;
  EXPECT_EQ(frame.llt().info(), Eigen::Success);
  EXPECT_GT(std::sqrt(frame(2, 2)), 0.001);
  EXPECT_LT(std::sqrt(frame(3, 3)), 0.02);
}

// Such as the poses of a planar SLAM, whose z is 0 on a ramp too, or a configured plane on sloping ground.
TEST(Calibrate, TakesTheHeightsThatExplainTheRanges) {
  const auto largest_error_m = [](const test::SimulatedSite& site) {
    const model::Calibration found = calibrate(site.drive()).calibration;
    double largest_m = 0.0;
    for (std::size_t a = 0; a < site.anchors.size(); ++a) {
      largest_m = std::max(largest_m, (found.anchors[a].position_m - site.anchors[a].position_m).norm());
    }
    return largest_m;
  };
  test::SimulatedSite wrong_poses = test::simulate_site({}, 12);
  test::SimulatedSite wrong_surface = wrong_poses;
  for (model::PoseSample& pose : wrong_poses.poses) pose.z_m += 0.1 * (pose.x_m - 11.0);
  for (model::PoseSample& pose : wrong_surface.poses) pose.roll_rad = pose.pitch_rad = 0.0;
  wrong_surface.floor = model::Surface(model::Plane(0.0, Eigen::Vector3d(-0.1, 0.0, 1.0)));
  EXPECT_LT(largest_error_m(wrong_poses), 0.15);
  EXPECT_LT(largest_error_m(wrong_surface), 0.15);
}

// Poses that are poor for a quarter of the drive and, on demand, report their covariance.
test::SimulatedSite partly_poor(std::uint64_t seed, double correlation_s, bool with_covariance) {
  test::SimulatedSite site = test::simulate_site({.ranges_per_pair = 400, .beta_sigma_m = 0.3}, seed);
  test::Random random(seed + 100);
  Eigen::Vector3d error = random.gaussians(3);
  for (std::size_t i = 0; i < site.poses.size(); ++i) {
    model::PoseSample& pose = site.poses[i];
    const double keep = std::exp(-0.05 / correlation_s);
    error = keep * error + std::sqrt(1.0 - keep * keep) * random.gaussians(3);
    const bool poor = pose.t_s > 90.0 && pose.t_s < 150.0;
    const double sigma_m = poor ? 0.4 : 0.01;
    const double sigma_rad = poor ? 0.04 : 0.001;
    pose.x_m += sigma_m * error.x();
    pose.y_m += sigma_m * error.y();
    pose.yaw_rad = model::wrap_angle(pose.yaw_rad + sigma_rad * error.z());
    if (!with_covariance) continue;
    pose.covariance = {sigma_m * sigma_m, 0.0, 0.0, sigma_m * sigma_m, 0.0, sigma_rad * sigma_rad};
  }
  return site;
}

TEST(Calibrate, WeightsPosesByTheirCovarianceOverManyDrives) {
  struct Score {
    double square_error_m2 = 0.0;
    double nees = 0.0;
    double anchors = 0.0;
  };
  for (const double correlation_s : {0.02, 1.0, 20.0}) {
    const auto score = [&](bool with_covariance) {
      Score out;
      for (std::uint64_t seed = 1; seed <= 6; ++seed) {
        const test::SimulatedSite site = partly_poor(seed, correlation_s, with_covariance);
        const model::Calibration found = calibrate(site.drive()).calibration;
        for (std::size_t a = 0; a < site.anchors.size(); ++a) {
          const Eigen::Vector3d error_m = found.anchors[a].position_m - site.anchors[a].position_m;
          const Eigen::Matrix3d covariance = found.anchors[a].covariance.topLeftCorner<3, 3>();
          out.square_error_m2 += error_m.squaredNorm();
          out.nees += error_m.dot(covariance.ldlt().solve(error_m)) / 3.0;
          out.anchors += 1.0;
        }
      }
      return out;
    };
    const Score with = score(true);
    const Score without = score(false);
    EXPECT_LT(with.square_error_m2, without.square_error_m2);
    EXPECT_GT(with.nees / with.anchors, 0.7);
    EXPECT_LT(with.nees / with.anchors, 1.3);
  }
}

TEST(Calibrate, IsDeterministic) {
  const test::SimulatedSite site = test::simulate_site({.outlier_share = 0.2}, 5);
  const Result one = calibrate(site.drive());
  const Result two = calibrate(site.drive());
  for (std::size_t a = 0; a < site.anchors.size(); ++a) {
    EXPECT_EQ(one.calibration.anchors[a].position_m, two.calibration.anchors[a].position_m);
    EXPECT_EQ(one.calibration.anchors[a].covariance, two.calibration.anchors[a].covariance);
  }
}

TEST(Calibrate, ReportsPairsHeldOutScoreAndVerdict) {
  const test::SimulatedSite site = test::simulate_site({}, 6);
  const Result result = calibrate(site.drive());
  EXPECT_EQ(result.calibration.verdict, model::Verdict::kUsable);
  EXPECT_EQ(result.ranges_used + result.ranges_rejected, site.ranges.size());
  for (const model::AnchorCalibration& anchor : result.calibration.anchors) {
    EXPECT_EQ(anchor.verdict, model::AnchorVerdict::kOk);
    EXPECT_TRUE(anchor.advice.empty());
    ASSERT_TRUE(anchor.held_out_rms_m.has_value());
    EXPECT_NEAR(*anchor.held_out_rms_m, 0.1, 0.04);
    ASSERT_TRUE(anchor.mirror_ratio.has_value());
    EXPECT_GT(*anchor.mirror_ratio, 0.0);
    EXPECT_LT(*anchor.mirror_ratio, 1.0);
    ASSERT_EQ(anchor.pairs.size(), 3U);
    ASSERT_EQ(anchor.covariance.rows(), 9);
    for (Eigen::Index j = 0; j < 3; ++j) {
      const model::PairBias& pair = anchor.pairs[static_cast<std::size_t>(j)];
      EXPECT_EQ(pair.tag_id, j + 1);
      EXPECT_NEAR(pair.beta_sigma_m * pair.beta_sigma_m, anchor.covariance(3 + j, 3 + j), 1e-12);
      EXPECT_NEAR(pair.gamma_sigma * pair.gamma_sigma, anchor.covariance(6 + j, 6 + j), 1e-12);
    }
  }
}

// A single tag at one height does not show on which side of it an anchor is. An earlier calibration does,
// where its height is trusted; else the other side stays in the covariance.
TEST(Calibrate, AWeakEarlierHeightDoesNotDecideTheSide) {
  const test::SimulatedSite site = test::simulate_site({}, 11);
  Drive drive = site.drive();
  drive.tags = drive.tags.first(1);
  const auto calibrated = [&](model::AnchorVerdict verdict) {
    model::Calibration earlier;
    for (const model::Anchor& anchor : site.anchors) {
      model::AnchorCalibration& known = earlier.anchors.emplace_back();
      known.id = anchor.id;
      known.position_m = anchor.position_m;
      known.covariance = 1e-3 * Eigen::MatrixXd::Identity(model::kPairSize, model::kPairSize);
      known.pairs.push_back({.tag_id = 1});
      known.verdict = verdict;
    }
    return calibrate(drive, {.earlier = &earlier}).calibration;
  };
  const model::Calibration trusted = calibrated(model::AnchorVerdict::kOk);
  const model::Calibration weak = calibrated(model::AnchorVerdict::kWeakZ);
  int decided = 0;
  for (std::size_t a = 0; a < site.anchors.size(); ++a) {
    const double z_m = site.anchors[a].position_m.z();
    const double apart_m = 2.0 * std::abs(z_m - drive.tags[0].lever_arm_m.z());
    const double variance_m2 = trusted.anchors[a].covariance(2, 2);
    if (variance_m2 > 0.05 * apart_m * apart_m) continue;
    ++decided;
    EXPECT_LT(std::abs(trusted.anchors[a].position_m.z() - z_m), 0.5 * apart_m) << site.anchors[a].id;
    EXPECT_GT(weak.anchors[a].covariance(2, 2), variance_m2 + 0.2 * apart_m * apart_m) << site.anchors[a].id;
  }
  EXPECT_GE(decided, 6);
}

TEST(Calibrate, EstimatesAKnownAnchorWhosePositionIsNotFinite) {
  const test::SimulatedSite site = test::simulate_site({}, 8);
  std::vector<model::Anchor> known = site.anchors;
  constexpr std::size_t kUnknown = 2;
  known[kUnknown].position_m.x() = std::numeric_limits<double>::quiet_NaN();
  Drive drive = site.drive();
  drive.known_anchors = known;
  const model::Calibration found = calibrate(drive).calibration;
  for (std::size_t a = 0; a < site.anchors.size(); ++a) {
    const model::AnchorCalibration& anchor = found.anchors[a];
    EXPECT_EQ(anchor.mirror_ratio.has_value(), a == kUnknown);
    if (a != kUnknown) {
      EXPECT_EQ(anchor.position_m, site.anchors[a].position_m);
      continue;
    }
    const Eigen::Vector3d error_m = anchor.position_m - site.anchors[a].position_m;
    const Eigen::Matrix3d covariance_m2 = anchor.covariance.topLeftCorner<3, 3>();
    EXPECT_LT(error_m.dot(covariance_m2.ldlt().solve(error_m)), 16.27);  // 99.9 %
    EXPECT_LT(error_m.norm(), 0.3);
  }
}

TEST(Calibrate, EstimatesOnlyTheBiasesOfKnownAnchors) {
  const test::SimulatedSite site = test::simulate_site({.outlier_share = 0.15}, 7);
  Drive drive = site.drive();
  drive.known_anchors = site.anchors;
  const Result result = calibrate(drive);
  for (std::size_t a = 0; a < site.anchors.size(); ++a) {
    const model::AnchorCalibration& anchor = result.calibration.anchors[a];
    EXPECT_EQ(anchor.position_m, site.anchors[a].position_m);
    EXPECT_NEAR(std::sqrt(anchor.covariance(2, 2)), 0.02, 1e-9);
    // An error of the survey along the line to the tags becomes a bias: the two are correlated.
    EXPECT_GT(anchor.covariance.block(0, 3, 3, 3).cwiseAbs().maxCoeff(), 1e-5);
    EXPECT_GT(Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(anchor.covariance).eigenvalues().minCoeff(),
              0.0);
    EXPECT_FALSE(anchor.mirror_ratio.has_value());
    for (std::size_t j = 0; j < 3; ++j) {
      EXPECT_NEAR(anchor.pairs[j].beta_m, site.beta_m[a][j], 5.0 * anchor.pairs[j].beta_sigma_m);
      EXPECT_LT(anchor.pairs[j].beta_sigma_m, 0.1);
    }
  }
}

}  // namespace
}  // namespace groma::calibration
