#include "host/calibration/association.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <numbers>
#include <vector>

#include "host/model/pose.hpp"
#include "test/support/random.hpp"

namespace groma::calibration {
namespace {

using model::PoseSample;
using model::RangeSample;

// Observation of one range at t_s by a robot that drives through the poses.
Observation only_row(const std::vector<PoseSample>& poses, double t_s, const model::Surface& surface,
                     HeightSource height = HeightSource::kPose) {
  const std::vector<RangeSample> ranges{{.t_s = t_s, .tag_id = 1, .anchor_id = 9, .range_m = 5.0}};
  const std::vector<model::Tag> tags{{1, {1.0, 0.5, 2.0}}};
  Drive drive;
  drive.ranges = ranges;
  drive.poses = poses;
  drive.tags = tags;
  drive.surface = &surface;
  const Association association = associate(drive, height);
  EXPECT_EQ(association.anchors.size(), 1U);
  EXPECT_EQ(association.anchors[0].rows.size(), 1U);
  return association.anchors[0].rows.empty() ? Observation{} : association.anchors[0].rows[0];
}

TEST(Association, InterpolatesYawAlongTheShorterArc) {
  const double pi = std::numbers::pi;
  const std::vector<PoseSample> poses{{.t_s = 0.0, .yaw_rad = pi - 0.1}, {.t_s = 0.2, .yaw_rad = -pi + 0.1}};
  const Observation row = only_row(poses, 0.1, model::Surface());
  // Heading along -x: lever arm (1, 0.5, 2) becomes (-1, -0.5, 2).
  EXPECT_NEAR(row.tag_m.x(), -1.0, 1e-9);
  EXPECT_NEAR(row.tag_m.y(), -0.5, 1e-9);
  EXPECT_NEAR(row.tag_m.z(), 2.0, 1e-9);
}

TEST(Association, GivesTheAntennasVelocityAndYawArm) {
  std::vector<PoseSample> poses;
  poses.reserve(5);
  const auto pose_at = [](double t_s) {
    return PoseSample{.t_s = t_s, .x_m = 2.0 * t_s, .y_m = -t_s, .z_m = 0.1 * t_s, .yaw_rad = 0.7 * t_s};
  };
  for (int i = 0; i < 5; ++i) poses.push_back(pose_at(0.2 * i));
  const Observation row = only_row(poses, 0.3, model::Surface());
  const Observation later = only_row(poses, 0.3001, model::Surface());
  EXPECT_NEAR((row.velocity_mps - (later.tag_m - row.tag_m) / 1e-4).norm(), 0.0, 1e-3);
  std::vector<PoseSample> turned = poses;
  for (PoseSample& pose : turned) pose.yaw_rad += 1e-6;
  const Eigen::Vector3d by_yaw = (only_row(turned, 0.3, model::Surface()).tag_m - row.tag_m) / 1e-6;
  EXPECT_NEAR((by_yaw.head<2>() - row.yaw_arm_m).norm(), 0.0, 1e-6);
  EXPECT_NEAR(by_yaw.z(), 0.0, 1e-9);
}

// Reference: covariance of the antenna from that of x, y and yaw, by numerical derivatives.
TEST(Association, PropagatesPoseCovarianceToTheAntenna) {
  test::Random random(5);
  const Eigen::Matrix3d root = Eigen::Vector3d(0.3, 0.2, 0.1).asDiagonal() *
                               Eigen::Matrix3d::NullaryExpr([&] { return random.gaussian(); });
  const Eigen::Matrix3d covariance = root * root.transpose();
  std::vector<PoseSample> poses{{.t_s = 0.0, .yaw_rad = 0.4}, {.t_s = 0.2, .x_m = 0.3, .yaw_rad = 0.6}};
  const auto covariance_of = [&](double factor) -> model::PoseCovariance {
    const Eigen::Matrix3d all = factor * covariance;
    return {all(0, 0), all(0, 1), all(0, 2), all(1, 1), all(1, 2), all(2, 2)};
  };
  EXPECT_EQ(only_row(poses, 0.05, model::Surface()).pose_spread_m2, Eigen::Vector3f::Zero());
  poses[0].covariance = covariance_of(1.0);
  EXPECT_EQ(only_row(poses, 0.05, model::Surface()).pose_spread_m2, Eigen::Vector3f::Zero())
      << "one pose with a covariance is not enough";
  poses[1].covariance = covariance_of(3.0);
  const Observation row = only_row(poses, 0.05, model::Surface());
  Eigen::Matrix<double, 2, 3> by_pose;
  for (Eigen::Index axis = 0; axis < 3; ++axis) {
    std::vector<PoseSample> moved = poses;
    for (PoseSample& pose : moved) {
      pose.x_m += axis == 0 ? 1e-6 : 0.0;
      pose.y_m += axis == 1 ? 1e-6 : 0.0;
      pose.yaw_rad += axis == 2 ? 1e-6 : 0.0;
    }
    by_pose.col(axis) = (only_row(moved, 0.05, model::Surface()).tag_m - row.tag_m).head<2>() / 1e-6;
  }
  const Eigen::Matrix2d expected = by_pose * (1.5 * covariance) * by_pose.transpose();
  EXPECT_NEAR(row.pose_spread_m2(0), expected(0, 0), 1e-5);
  EXPECT_NEAR(row.pose_spread_m2(1), expected(0, 1), 1e-5);
  EXPECT_NEAR(row.pose_spread_m2(2), expected(1, 1), 1e-5);
  poses[1].covariance = covariance_of(-1.0);
  EXPECT_EQ(only_row(poses, 0.05, model::Surface()).pose_spread_m2, Eigen::Vector3f::Zero())
      << "not a covariance";
}

TEST(Association, TakesAMissingAttitudeFromTheSurface) {
  const model::Surface slope(model::Plane(1.0, Eigen::Vector3d(-0.2, 0.1, 1.0)));
  const model::PlanarPose planar{.x_m = 3.0, .y_m = -2.0, .theta_rad = 1.1};
  const double z_m = slope.at(3.0, -2.0).z_m;
  const std::vector<PoseSample> poses{{.t_s = 0.0, .x_m = 3.0, .y_m = -2.0, .z_m = z_m, .yaw_rad = 1.1},
                                      {.t_s = 0.2, .x_m = 3.0, .y_m = -2.0, .z_m = z_m, .yaw_rad = 1.1}};
  const model::RigidPose expected = model::pose_on_surface(slope, planar).pose;
  const Eigen::Vector3d antenna_m = expected.position_m + expected.rotation * Eigen::Vector3d(1.0, 0.5, 2.0);
  EXPECT_NEAR((only_row(poses, 0.1, slope).tag_m - antenna_m).norm(), 0.0, 1e-9);
}

TEST(Association, TakesAMissingPitchFromTheSurface) {
  test::Random random(3);
  for (int i = 0; i < 20; ++i) {
    const model::Surface slope(
        model::Plane(0.0, Eigen::Vector3d(random.uniform(-0.3, 0.3), random.uniform(-0.3, 0.3), 1.0)));
    const double theta_rad = random.uniform(-3.0, 3.0);
    const Eigen::Matrix3d r =
        model::pose_on_surface(slope, {.x_m = 0.0, .y_m = 0.0, .theta_rad = theta_rad}).pose.rotation;
    const double yaw_rad = std::atan2(r(1, 0), r(0, 0));
    const double roll_rad = std::atan2(r(2, 1), r(2, 2));
    const PoseSample pose{.yaw_rad = yaw_rad, .roll_rad = roll_rad};
    const model::RigidPose found = interpolate_pose(pose, pose, 0.5, slope);
    EXPECT_NEAR((found.rotation - r).norm(), 0.0, 1e-9);
    const PoseSample pitch_only{.yaw_rad = yaw_rad, .pitch_rad = std::asin(-r(2, 0))};
    EXPECT_NEAR((interpolate_pose(pitch_only, pitch_only, 0.5, slope).rotation - r).norm(), 0.0, 1e-9);
  }
}

TEST(Association, TakesZyxWhereAttitudeIsKnown) {
  const PoseSample pose{.yaw_rad = 0.4, .roll_rad = -0.2, .pitch_rad = 0.3};
  const model::RigidPose found = interpolate_pose(pose, pose, 0.0, model::Surface());
  EXPECT_NEAR((found.rotation - model::rotation_from_zyx(0.4, 0.3, -0.2)).norm(), 0.0, 1e-12);
}

TEST(Association, RejectsInvalidRangesAndRangesWithoutAPose) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const std::vector<PoseSample> poses{
      {.t_s = 0.0}, {.t_s = 0.1}, {.t_s = 1.0}, {.t_s = 1.1, .x_m = nan}, {.t_s = 1.2}};
  const std::vector<RangeSample> ranges{
      {.t_s = -0.1, .tag_id = 1, .anchor_id = 9, .range_m = 5.0},  // before the poses
      {.t_s = 0.05, .tag_id = 1, .anchor_id = 9, .range_m = 5.0},  // good
      {.t_s = 0.05, .tag_id = 2, .anchor_id = 9, .range_m = 5.0},  // unknown tag
      {.t_s = 0.06, .tag_id = 1, .anchor_id = 9, .range_m = 0.0},
      {.t_s = 0.06, .tag_id = 1, .anchor_id = 9, .range_m = -3.0},
      {.t_s = 0.06, .tag_id = 1, .anchor_id = 9, .range_m = 300e3},
      {.t_s = 0.06, .tag_id = 1, .anchor_id = 9, .range_m = nan},
      {.t_s = nan, .tag_id = 1, .anchor_id = 9, .range_m = 5.0},
      {.t_s = 0.50, .tag_id = 1, .anchor_id = 9, .range_m = 5.0},  // in the long gap
      {.t_s = 1.15, .tag_id = 1, .anchor_id = 9, .range_m = 5.0},  // good: the NaN pose is dropped
      {.t_s = 0.07, .tag_id = 1, .anchor_id = 9, .range_m = 5.0},  // good, though late
      {.t_s = 1.30, .tag_id = 1, .anchor_id = 9, .range_m = 5.0},  // after the poses
  };
  const std::vector<model::Tag> tags{{1, Eigen::Vector3d::Zero()}};
  Drive drive;
  drive.ranges = ranges;
  drive.poses = poses;
  drive.tags = tags;
  const Association association = associate(drive, HeightSource::kPose);
  ASSERT_EQ(association.anchors.size(), 1U);
  EXPECT_EQ(association.anchors[0].rows.size(), 3U);
  EXPECT_EQ(association.anchors[0].rejected, 9U);
}

}  // namespace
}  // namespace groma::calibration
