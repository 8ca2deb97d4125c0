// Recorded and simulated runs from the shared data folder; skipped where it is absent.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

#include <Eigen/Cholesky>

#include "host/calibration/calibrate.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/dataset.hpp"
#include "test/support/shared_data.hpp"

namespace groma::calibration {
namespace {

constexpr double kFar_m = 1.5;
constexpr double kAny = std::numeric_limits<double>::infinity();

class RecordedRun : public ::testing::Test {
 protected:
  void load(const std::string& name) {
    GROMA_SHARED_OR_SKIP(folder, name);
    dataset_ = io::read_dataset(folder);
    Drive drive;
    drive.ranges = dataset_.ranges;
    drive.poses = dataset_.pose_prior;
    drive.tags = dataset_.tags;
    drive.surface = &dataset_.surface;
    drive.priors = dataset_.range_priors;
    result_ = calibrate(drive);
  }

  [[nodiscard]] double mean_xy_error_m() const {
    double sum_m = 0.0;
    double anchors = 0.0;
    for (const model::AnchorCalibration& anchor : result_.calibration.anchors) {
      for (const model::Anchor& surveyed : dataset_.surveyed_anchors) {
        if (surveyed.id != anchor.id || anchor.ranges_used + anchor.ranges_rejected < 100) continue;
        sum_m += (anchor.position_m - surveyed.position_m).head<2>().norm();
        anchors += 1.0;
      }
    }
    return sum_m / anchors;
  }

  // Calls `look` with each anchor, its error, and its height error in sigmas.
  template <typename Look>
  void for_each_error(const Look& look) const {
    for (const model::AnchorCalibration& anchor : result_.calibration.anchors) {
      for (const model::Anchor& surveyed : dataset_.surveyed_anchors) {
        if (surveyed.id != anchor.id) continue;
        const Eigen::Vector3d error_m = anchor.position_m - surveyed.position_m;
        look(anchor, error_m, std::abs(error_m.z()) / std::sqrt(anchor.covariance(2, 2)));
      }
    }
  }

  // No anchor that is further off than this is marked ok.
  void expect_marked(double beyond_m, double beyond_sigmas_z) const {
    for_each_error(
        [&](const model::AnchorCalibration& anchor, const Eigen::Vector3d& error_m, double sigmas_z) {
          if (error_m.norm() <= beyond_m && sigmas_z <= beyond_sigmas_z) return;
          EXPECT_NE(io::word(anchor.verdict), "ok") << anchor.id << " is off by " << error_m.transpose();
        });
  }

  // No anchor outside its 99.7 % ellipsoid is marked ok.
  void expect_no_lie() const {
    for_each_error([&](const model::AnchorCalibration& anchor, const Eigen::Vector3d& error_m, double) {
      if (anchor.verdict != model::AnchorVerdict::kOk) return;
      const Eigen::Matrix3d covariance = anchor.covariance.topLeftCorner<3, 3>();
      EXPECT_LT(error_m.dot(covariance.ldlt().solve(error_m)), 14.16)
          << anchor.id << " is off by " << error_m.transpose();
    });
  }

  io::Dataset dataset_;
  Result result_;
};

TEST_F(RecordedRun, Plaza1FindsAnchorsAndScale) {
  load("real/plaza1");
  if (IsSkipped()) return;
  EXPECT_LE(mean_xy_error_m(), 0.09);
  EXPECT_TRUE(result_.calibration.tags.empty());
  for (const model::AnchorCalibration& anchor : result_.calibration.anchors) {
    EXPECT_NEAR(anchor.pairs[0].gamma, 1.065, 0.02);
    EXPECT_EQ(anchor.verdict, model::AnchorVerdict::kWeakZ) << "all in one plane: heights are undetermined";
  }
}

TEST_F(RecordedRun, LiasFastFindsAnchorsAndMarksHeights) {
  load("real/lias_fast");
  if (IsSkipped()) return;
  EXPECT_LE(mean_xy_error_m(), 0.12);
  for (const model::AnchorCalibration& anchor : result_.calibration.anchors) {
    EXPECT_NE(anchor.verdict, model::AnchorVerdict::kOk);
  }
}

TEST_F(RecordedRun, McdFindsAnchorsFromTheSlamPrior) {
  load("real/mcd_ntu_day_09");
  if (IsSkipped()) return;
  EXPECT_LE(mean_xy_error_m(), 0.32);
  EXPECT_NEAR(result_.calibration.range_delay_s, 0.018, 0.008);
  EXPECT_TRUE(result_.calibration.tags.empty());
  expect_marked(kFar_m, 3.0);
  for_each_error([](const model::AnchorCalibration& anchor, const Eigen::Vector3d&, double sigmas_z) {
    EXPECT_LT(sigmas_z, 3.0) << anchor.id << ": the covariance must cover the error of the height";
  });
}

TEST_F(RecordedRun, InrolFindsAnchorsInThreeDimensions) {
  load("real/inrol_env1");
  if (IsSkipped()) return;
  EXPECT_LE(mean_xy_error_m(), 0.14);
  EXPECT_EQ(result_.calibration.tags.size(), 1U);
  expect_no_lie();
  expect_marked(kFar_m, kAny);
}

TEST_F(RecordedRun, StarlocFindsAnchorsWithLeverArmAndPattern) {
  load("real/starloc_loop2ds5");
  if (IsSkipped()) return;
  EXPECT_LE(mean_xy_error_m(), 0.18);
  EXPECT_EQ(result_.calibration.tags.size(), 1U);
  expect_no_lie();
  expect_marked(kFar_m, 3.0);
}

// Its ranges are raw: one anchor is 2.3 m off in height.
TEST_F(RecordedRun, StarlocWithRawRangesIsMarked) {
  load("real/starloc_loop2dfasts1");
  if (IsSkipped()) return;
  double largest_m = 0.0;
  for_each_error([&](const model::AnchorCalibration&, const Eigen::Vector3d& error_m, double) {
    largest_m = std::max(largest_m, error_m.norm());
  });
  EXPECT_GT(largest_m, kFar_m) << "otherwise this run tests nothing";
  expect_no_lie();
  expect_marked(kFar_m, kAny);
}

TEST_F(RecordedRun, IndoorSimulationMarksAnchorsWithoutLineOfSight) {
  load("simulated/indoor");
  if (IsSkipped()) return;
  for (const model::AnchorCalibration& anchor : result_.calibration.anchors) {
    const bool behind = anchor.id == 12 || anchor.id == 13 || anchor.id == 14;
    EXPECT_EQ(anchor.verdict == model::AnchorVerdict::kNeverLos, behind) << anchor.id;
  }
}

TEST_F(RecordedRun, CleanSimulationFindsAnchorsWithinTheirCovariance) {
  load("simulated/clean");
  if (IsSkipped()) return;
  EXPECT_LE(mean_xy_error_m(), 0.04);
  double nees = 0.0;
  for (std::size_t a = 0; a < dataset_.surveyed_anchors.size(); ++a) {
    const model::AnchorCalibration& anchor = result_.calibration.anchors[a];
    const Eigen::Vector3d error_m = anchor.position_m - dataset_.surveyed_anchors[a].position_m;
    nees += error_m.dot(anchor.covariance.topLeftCorner<3, 3>().ldlt().solve(error_m)) / 36.0;
  }
  EXPECT_LE(nees, 1.6);
}

}  // namespace
}  // namespace groma::calibration
