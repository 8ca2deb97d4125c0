#include "host/daemon/localizer.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "host/model/calibration.hpp"

namespace groma::daemon {
namespace {

model::Surface hills() {
  std::vector<double> heights_m;
  for (int i = 0; i < 8; ++i) {
    for (int j = 0; j < 8; ++j) heights_m.push_back(0.8 * std::sin(1.3 * i) + 0.6 * std::cos(0.9 * j));
  }
  return model::BSpline({.x0_m = -10.0, .y0_m = -10.0, .dx_m = 4.0, .dy_m = 4.0, .nx = 8, .ny = 8},
                        heights_m);
}

PoseEstimate pose_at(const model::Surface& surface, const model::PlanarPose& pose,
                     const Eigen::Matrix3d& covariance) {
  filter::Estimate estimate;
  estimate.pose = pose;
  estimate.covariance = covariance;
  return pose_on(surface, estimate);
}

Eigen::Matrix<double, 6, 1> values(const PoseEstimate& pose) {
  return {pose.x_m, pose.y_m, pose.z_m, pose.roll_rad, pose.pitch_rad, pose.yaw_rad};
}

TEST(PoseOn, CovarianceIsThatOfTheNumericalJacobian) {
  const model::Surface surface = hills();
  Eigen::Matrix3d planar;
  planar << 0.04, 0.01, -0.003, 0.01, 0.09, 0.002, -0.003, 0.002, 0.0025;
  for (const model::PlanarPose pose :
       {model::PlanarPose{0.3, -1.2, 0.4}, {2.2, 1.7, -2.9}, {-3.0, 0.1, 1.6}}) {
    const PoseEstimate estimate = pose_at(surface, pose, planar);
    Eigen::Matrix<double, 6, 3> jacobian;
    constexpr double kStep = 1e-6;
    for (int i = 0; i < 3; ++i) {
      const auto moved = [&](double by) {
        model::PlanarPose other = pose;
        (i == 0 ? other.x_m : i == 1 ? other.y_m : other.theta_rad) += by;
        return values(pose_at(surface, other, planar));
      };
      jacobian.col(i) = (moved(kStep) - moved(-kStep)) / (2.0 * kStep);
    }
    const Eigen::Matrix<double, 6, 6> expected = jacobian * planar * jacobian.transpose();
    EXPECT_LT((estimate.covariance - expected).cwiseAbs().maxCoeff(), 1e-8);
    // Where x, y and yaw are concerned it is the filter's own.
    EXPECT_NEAR(estimate.covariance(0, 1), planar(0, 1), 1e-17);
    EXPECT_NEAR(estimate.covariance(5, 5), planar(2, 2), 1e-17);
    EXPECT_GT(std::abs(estimate.roll_rad) + std::abs(estimate.pitch_rad), 0.02);
  }
}

TEST(PoseOn, AnglesRebuildTheRotation) {
  const model::Surface surface = hills();
  const model::PlanarPose planar{1.0, 2.0, 0.7};
  const PoseEstimate pose = pose_at(surface, planar, Eigen::Matrix3d::Identity());
  const Eigen::Matrix3d rotation = model::pose_on_surface(surface, planar).pose.rotation;
  const double yaw_zyx = std::atan2(rotation(1, 0), rotation(0, 0));
  EXPECT_LT((model::rotation_from_zyx(yaw_zyx, pose.pitch_rad, pose.roll_rad) - rotation).norm(), 1e-12);
}

// A robot on a circle of radius 5 m at 1 m/s on flat ground, and ranges without error.
class Circle : public ::testing::Test {
 protected:
  static constexpr double kRadius_m = 5.0;
  static constexpr double kOmega = 0.2;

  Circle() {
    for (int i = 0; i < 4; ++i) {
      anchors_.push_back({static_cast<model::NodeId>(100 + i),
                          {8.0 * (i % 2 == 0 ? 1 : -1), 8.0 * (i < 2 ? 1 : -1), 2.0 + 0.3 * i}});
    }
    setup_.tags = {{1, {0.2, 0.0, 0.5}}};
    model::RangePriors priors;
    priors.beta_m = {0.0, 0.05};
    setup_.calibration = model::surveyed_calibration(anchors_, setup_.tags, priors, 0.02);
  }

  [[nodiscard]] static model::PlanarPose truth(double t_s) {
    return {kRadius_m * std::sin(kOmega * t_s), kRadius_m * (1.0 - std::cos(kOmega * t_s)), kOmega * t_s};
  }
  [[nodiscard]] static model::OdometrySample row(double t_s) {
    return {t_s, kRadius_m * kOmega, 0.0, kOmega};
  }
  [[nodiscard]] static model::PoseSample prior(double t_s) {
    const auto pose = truth(t_s);
    return {.t_s = t_s, .x_m = pose.x_m, .y_m = pose.y_m, .z_m = 0.0, .yaw_rad = pose.theta_rad};
  }
  [[nodiscard]] model::RangeSample range(double t_s, std::size_t anchor) const {
    const auto pose = truth(t_s);
    const Eigen::Vector3d tag(pose.x_m + 0.2 * std::cos(pose.theta_rad),
                              pose.y_m + 0.2 * std::sin(pose.theta_rad), 0.5);
    return {.t_s = t_s,
            .tag_id = 1,
            .anchor_id = anchors_[anchor].id,
            .range_m = (tag - anchors_[anchor].position_m).norm()};
  }
  // From one time to another, with ranges or without.
  void drive(Localizer& localizer, double from_s, double to_s, bool ranges) const {
    const auto first = static_cast<int>(std::lround(from_s / 0.02));
    const auto last = static_cast<int>(std::lround(to_s / 0.02));
    for (int i = first; i < last; ++i) {
      localizer.on_odometry(row(0.02 * i));
      if (ranges && i % 2 == 0)
        localizer.on_range(range(0.02 * i + 0.01, static_cast<std::size_t>(i / 2 % 4)));
    }
  }

  std::vector<model::Anchor> anchors_;
  Localizer::Setup setup_;
};

TEST_F(Circle, GoesOnByAnotherCalibrationFromWhereItIs) {
  std::vector<PoseEstimate> poses;
  const model::Calibration whole = setup_.calibration;
  setup_.calibration.anchors.pop_back();
  Localizer localizer(setup_, [&](const PoseEstimate& pose) { poses.push_back(pose); });
  localizer.adopt(setup_.calibration);  // before it has started: it waits on
  EXPECT_FALSE(localizer.started());
  localizer.on_odometry(row(0.0));
  localizer.on_pose_prior(prior(0.0));
  drive(localizer, 0.02, 10.0, true);
  EXPECT_EQ(localizer.filter().anchors(), 3U);
  const PoseEstimate before = poses.back();
  localizer.adopt(whole);
  EXPECT_EQ(localizer.filter().anchors(), 4U);
  EXPECT_TRUE(localizer.started());
  drive(localizer, 10.0, 20.0, true);
  const PoseEstimate& after = *std::find_if(poses.begin(), poses.end(),
                                            [&](const PoseEstimate& pose) { return pose.t_s > before.t_s; });
  EXPECT_LT(std::hypot(after.x_m - before.x_m, after.y_m - before.y_m), 0.06);
  EXPECT_EQ(after.state, filter::State::kTracking);
  for (const PoseEstimate& pose : poses) {
    const auto true_pose = truth(pose.t_s);
    EXPECT_LT(std::hypot(pose.x_m - true_pose.x_m, pose.y_m - true_pose.y_m), 0.2) << pose.t_s;
  }
}

TEST_F(Circle, SaysNothingBeforeAPosePriorThenTracksThenTellsThatRangesAreGone) {
  std::vector<PoseEstimate> poses;
  setup_.tracker.relocates = false;
  Localizer localizer(setup_, [&](const PoseEstimate& pose) { poses.push_back(pose); });
  drive(localizer, 0.0, 2.0, true);
  EXPECT_TRUE(poses.empty());
  EXPECT_FALSE(localizer.started());

  localizer.on_pose_prior(prior(1.99));
  drive(localizer, 2.0, 10.0, true);
  ASSERT_EQ(poses.size(), 400U);
  EXPECT_EQ(poses.back().state, filter::State::kTracking);
  EXPECT_NEAR(poses.back().t_s, 9.98, 1e-9);
  EXPECT_NEAR(poses.back().x_m, truth(9.98).x_m, 0.05);
  EXPECT_NEAR(poses.back().y_m, truth(9.98).y_m, 0.05);
  EXPECT_NEAR(poses.back().yaw_rad, truth(9.98).theta_rad, 0.05);
  EXPECT_LT(poses.back().planar_covariance(0, 0), 0.01);

  drive(localizer, 10.0, 12.0, false);
  EXPECT_EQ(poses[400 + 40].state, filter::State::kTracking);
  EXPECT_EQ(poses.back().state, filter::State::kDegraded);
  EXPECT_EQ(poses.back().reason, filter::Reason::kNoRanges);
  drive(localizer, 12.0, 12.2, true);
  EXPECT_EQ(poses.back().state, filter::State::kTracking);
}

TEST_F(Circle, FindsItsPoseWithoutAPriorAndAgainWhenTheClockWasSet) {
  std::vector<PoseEstimate> poses;
  Localizer localizer(setup_, [&](const PoseEstimate& pose) { poses.push_back(pose); });
  drive(localizer, 100.0, 110.0, true);
  ASSERT_FALSE(poses.empty());
  EXPECT_EQ(poses.back().state, filter::State::kTracking);
  EXPECT_NEAR(poses.back().x_m, truth(109.98).x_m, 0.1);
  EXPECT_NEAR(poses.back().y_m, truth(109.98).y_m, 0.1);
  localizer.on_clock_set();
  EXPECT_FALSE(localizer.started());
  drive(localizer, 0.0, 10.0, true);
  EXPECT_EQ(poses.back().state, filter::State::kTracking);
  EXPECT_NEAR(poses.back().x_m, truth(9.98).x_m, 0.1);
}

TEST_F(Circle, WaitsForAPosePriorAgainWhenTheClockWasSet) {
  std::vector<PoseEstimate> poses;
  setup_.tracker.relocates = false;
  Localizer localizer(setup_, [&](const PoseEstimate& pose) { poses.push_back(pose); });
  localizer.on_pose_prior(prior(100.0));
  drive(localizer, 100.0, 102.0, true);
  EXPECT_EQ(poses.size(), 100U);
  localizer.on_clock_set();
  EXPECT_FALSE(localizer.started());
  drive(localizer, 0.0, 1.0, true);
  EXPECT_EQ(poses.size(), 100U);
  localizer.on_pose_prior(prior(0.99));
  drive(localizer, 1.0, 3.0, true);
  EXPECT_EQ(poses.size(), 200U);
  EXPECT_NEAR(poses.back().x_m, truth(2.98).x_m, 0.1);
}

TEST_F(Circle, GoesByOtherSensorsWhereThereAreNoRanges) {
  std::vector<PoseEstimate> poses;
  Localizer localizer(setup_, [&](const PoseEstimate& pose) { poses.push_back(pose); });
  for (int i = 0; i < 500; ++i) {
    const double t_s = 0.02 * i;
    // Wheels that tell of twice the turn; a gyro, and now and then a pose, that know better.
    model::OdometrySample turned = row(t_s);
    turned.omega_radps *= 2.0;
    localizer.on_odometry(turned);
    localizer.on_sensor(model::YawRateSample{t_s, kOmega});
    if (i % 50 != 0) continue;
    model::PoseSample pose = prior(t_s);
    pose.covariance = model::PoseCovariance{1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4};
    localizer.on_sensor(pose);
  }
  ASSERT_FALSE(poses.empty());
  EXPECT_NEAR(poses.back().x_m, truth(9.98).x_m, 0.05);
  EXPECT_NEAR(poses.back().y_m, truth(9.98).y_m, 0.05);
  EXPECT_NEAR(poses.back().yaw_rad, truth(9.98).theta_rad, 0.05);
}

TEST_F(Circle, TwoModelsSeeTheSameAndAnswerDifferently) {
  setup_.filter.model = filter::Model::kSchmidt;
  std::vector<PoseEstimate> schmidt;
  Localizer first(setup_, [&](const PoseEstimate& pose) { schmidt.push_back(pose); });
  setup_.filter.model = filter::Model::kOdometry;
  std::vector<PoseEstimate> odometry;
  Localizer second(setup_, [&](const PoseEstimate& pose) { odometry.push_back(pose); });
  for (Localizer* localizer : {&first, &second}) {
    localizer->on_pose_prior(prior(0.0));
    drive(*localizer, 0.0, 5.0, true);
  }
  ASSERT_EQ(schmidt.size(), odometry.size());
  EXPECT_LT(schmidt.back().planar_covariance.trace(), odometry.back().planar_covariance.trace());
  EXPECT_EQ(odometry.back().state, filter::State::kDegraded);
}

}  // namespace
}  // namespace groma::daemon
