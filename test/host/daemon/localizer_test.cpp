#include "host/daemon/localizer.hpp"

#include <fmt/format.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "host/clock/time_mapper.hpp"
#include "host/daemon/session.hpp"
#include "host/model/calibration.hpp"
#include "test/host/link/node_frames.hpp"
#include "test/support/allocations.hpp"

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
    // The block of x, y and yaw equals the filter's covariance.
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

// Against quaternions: the smallest rotation from z to the numerical normal, and then the turn by the
// heading.
TEST(PoseOn, QuaternionIsTheTiltThenTheHeading) {
  const model::Surface surface = hills();
  for (const model::PlanarPose planar :
       {model::PlanarPose{1.0, 2.0, 0.7}, {-3.0, 0.5, -2.9}, {2.2, -1.7, 3.1}, {0.0, 0.0, -0.01}}) {
    constexpr double kStep = 1e-5;
    const auto height = [&](double x_m, double y_m) { return surface.at(x_m, y_m).z_m; };
    const double gx =
        (height(planar.x_m + kStep, planar.y_m) - height(planar.x_m - kStep, planar.y_m)) / 2e-5;
    const double gy =
        (height(planar.x_m, planar.y_m + kStep) - height(planar.x_m, planar.y_m - kStep)) / 2e-5;
    const double norm = std::sqrt(1.0 + gx * gx + gy * gy);
    // Half way between z and the normal n: the quaternion (z x n, 1 + z n), normalized.
    const double tilt_w = std::sqrt(0.5 * (1.0 + 1.0 / norm));
    const double tilt_x = gy / norm / (2.0 * tilt_w);
    const double tilt_y = -gx / norm / (2.0 * tilt_w);
    const double c = std::cos(0.5 * planar.theta_rad);
    const double s = std::sin(0.5 * planar.theta_rad);
    Eigen::Vector4d expected(tilt_x * c + tilt_y * s, tilt_y * c - tilt_x * s, tilt_w * s, tilt_w * c);
    if (expected.w() < 0.0) expected = -expected;
    const PoseEstimate pose = pose_at(surface, planar, Eigen::Matrix3d::Identity());
    EXPECT_LT((pose.quaternion - expected).norm(), 1e-8) << planar.theta_rad;
    EXPECT_NEAR(pose.quaternion.norm(), 1.0, 1e-14);
    EXPECT_GE(pose.quaternion.w(), 0.0);
  }
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
  [[nodiscard]] static model::OdometrySample odometry_at(double t_s) {
    return {t_s, kRadius_m * kOmega, 0.0, kOmega};
  }
  [[nodiscard]] static model::PoseSample prior(double t_s) {
    const auto pose = truth(t_s);
    return {.t_s = t_s, .x_m = pose.x_m, .y_m = pose.y_m, .z_m = 0.0, .yaw_rad = pose.theta_rad};
  }
  [[nodiscard]] model::RangeSample range(double t_s, std::size_t anchor) const {
    const auto pose = truth(t_s + carried_s_);
    const Eigen::Vector3d tag(pose.x_m + 0.2 * std::cos(pose.theta_rad),
                              pose.y_m + 0.2 * std::sin(pose.theta_rad), 0.5);
    return {.t_s = t_s,
            .tag_id = 1,
            .anchor_id = anchors_[anchor].id,
            .range_m = (tag - anchors_[anchor].position_m).norm()};
  }
  // Feeds odometry from one time to another, with ranges or without.
  void drive(Localizer& localizer, double from_s, double to_s, bool ranges) const {
    const auto first = static_cast<int>(std::lround(from_s / 0.02));
    const auto last = static_cast<int>(std::lround(to_s / 0.02));
    for (int i = first; i < last; ++i) {
      localizer.on_odometry(odometry_at(0.02 * i));
      if (ranges && i % 2 == 0)
        localizer.on_range(range(0.02 * i + 0.01, static_cast<std::size_t>(i / 2 % 4)));
    }
  }

  std::vector<model::Anchor> anchors_;
  Localizer::Setup setup_;
  double carried_s_ = 0.0;  // the robot was moved to its position at this much later
};

TEST_F(Circle, GivesAPoseForEachImpossibleSampleAndCountsIt) {
  for (const bool ahead : {false, true}) {
    std::vector<PoseEstimate> poses;
    Localizer localizer(setup_, [&](const PoseEstimate& pose) { poses.push_back(pose); });
    localizer.on_odometry(odometry_at(0.0));
    localizer.on_pose_prior(prior(0.0));
    drive(localizer, 0.02, 5.0, true);
    for (int i = 250; i < 260; ++i) {
      const double t_s = 0.02 * i;
      model::OdometrySample sample = odometry_at(t_s);
      if (i == 252) sample.vx_mps = 1e308;
      if (i == 254) sample.omega_radps = -1e12;
      if (ahead) localizer.on_odometry_ahead(sample);
      localizer.on_odometry(sample);
      EXPECT_EQ(poses.back().t_s, t_s);
      EXPECT_NEAR(poses.back().x_m, truth(t_s).x_m, 0.1);
      EXPECT_TRUE(poses.back().covariance.allFinite());
      EXPECT_EQ(poses.back().state, filter::State::kTracking);
    }
    EXPECT_EQ(localizer.implausible(), 2U);
    localizer.on_sensor(model::YawRateSample{5.2, 1e308});
    localizer.on_sensor(model::PositionSample{5.2, 1e300, 0.0, {1.0, 0.0, 1.0}});
    EXPECT_EQ(localizer.implausible(), 4U);
    localizer.on_clock_set();
    EXPECT_EQ(localizer.implausible(), 4U) << "of the whole run";
  }
}

TEST_F(Circle, ContinuesWithAnotherCalibrationFromItsPose) {
  std::vector<PoseEstimate> poses;
  const model::Calibration whole = setup_.calibration;
  setup_.calibration.anchors.pop_back();
  Localizer localizer(setup_, [&](const PoseEstimate& pose) { poses.push_back(pose); });
  localizer.adopt(setup_.calibration);  // before it has started: it waits on
  EXPECT_FALSE(localizer.started());
  localizer.on_odometry(odometry_at(0.0));
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

TEST_F(Circle, WaitsForAPosePriorThenTracksThenReportsNoRanges) {
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

TEST_F(Circle, GivesTheVelocityOfTheCorrectedOdometry) {
  for (const bool ahead : {false, true}) {
    std::vector<PoseEstimate> poses;
    Localizer localizer(setup_, [&](const PoseEstimate& pose) { poses.push_back(pose); });
    localizer.on_odometry(odometry_at(0.0));
    localizer.on_pose_prior(prior(0.0));
    // The wheels are 3 % larger than configured.
    const auto scaled_at = [&](double t_s) {
      model::OdometrySample sample = odometry_at(t_s);
      sample.vx_mps /= 1.03;
      return sample;
    };
    for (int i = 1; i < 3000; ++i) {
      if (ahead) localizer.on_odometry_ahead(scaled_at(0.02 * i));
      localizer.on_odometry(scaled_at(0.02 * i));
      localizer.on_range(range(0.02 * i + 0.01, static_cast<std::size_t>(i % 4)));
    }
    const PoseEstimate& last = poses.back();
    EXPECT_NEAR(last.velocity.x(), kRadius_m * kOmega, 0.01);
    EXPECT_NEAR(last.velocity.y(), 0.0, 0.01);
    EXPECT_NEAR(last.velocity.z(), kOmega, 0.005);
    EXPECT_LT(std::sqrt(last.velocity_covariance(0, 0)), std::sqrt(poses.front().velocity_covariance(0, 0)));
    EXPECT_GT(last.velocity_covariance(2, 2), 0.0);
  }
}

TEST_F(Circle, StartsAtAGivenPoseAndLeavesItIfTheRangesDisagree) {
  const auto seconds_to_track = [&](const std::optional<filter::Start>& start) {
    std::vector<PoseEstimate> poses;
    Localizer localizer(setup_, [&](const PoseEstimate& pose) { poses.push_back(pose); });
    if (start) localizer.start_at_next_odometry(*start);
    drive(localizer, 100.0, 130.0, true);
    const auto tracks = std::find_if(poses.begin(), poses.end(), [](const PoseEstimate& pose) {
      return pose.state == filter::State::kTracking;
    });
    if (tracks == poses.end()) return 1e9;
    for (auto pose = tracks; pose != poses.end(); ++pose) {
      const auto where = truth(pose->t_s);
      EXPECT_LT(std::hypot(pose->x_m - where.x_m, pose->y_m - where.y_m), 0.4) << pose->t_s;
    }
    return tracks->t_s - 100.0;
  };
  const double cold_s = seconds_to_track(std::nullopt);
  filter::Start start{.pose = truth(100.0), .position_sigma_m = 1.0, .heading_sigma_rad = 0.3};
  start.pose.x_m += 0.7;
  start.pose.theta_rad += 0.2;
  const double warm_s = seconds_to_track(start);
  EXPECT_LT(warm_s, 1.5);
  EXPECT_LT(warm_s, cold_s);
  // The robot was carried to the other side of its circle.
  start.pose = truth(100.0 + 3.14159 / kOmega);
  EXPECT_LT(seconds_to_track(start), 20.0);
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

TEST_F(Circle, UsesOtherSensorsWithoutRanges) {
  std::vector<PoseEstimate> poses;
  Localizer localizer(setup_, [&](const PoseEstimate& pose) { poses.push_back(pose); });
  for (int i = 0; i < 500; ++i) {
    const double t_s = 0.02 * i;
    // The odometry's yaw rate is twice the true one; a gyro and occasional poses are right.
    model::OdometrySample turned = odometry_at(t_s);
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

TEST_F(Circle, TwoModelsGiveDifferentCovariances) {
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

// The same robot behind a session, all clocks equal: an odometry sample each 0.02 s, and each 0.1 s a
// report of ranges 0.06 to 0.12 s old.
class Live : public Circle {
 protected:
  static constexpr double kBegin_s = 10.0;

  void begin(double reorder_lag_s) {
    session_ = std::make_unique<Session>(SessionConfig{.reorder_lag_s = reorder_lag_s});
    tag_ = session_->add_node("tag-1", 0);
    localizer_ = std::make_unique<Localizer>(
        setup_, [this](const PoseEstimate& pose) { poses_.push_back(pose); },
        [this](const PoseEstimate& pose) { settled_.push_back(pose); });
    session_->attach(*localizer_);
  }
  void line(const std::string& text, double now_s) const {
    session_->robot_bytes({reinterpret_cast<const std::uint8_t*>(text.data()), text.size()}, now_s);
  }
  void odometry(double t_s, double now_s, double omega_radps = kOmega) const {
    line(fmt::format("{{\"class\":\"ODOMETRY\",\"t_s\":{},\"vx_mps\":{},\"vy_mps\":0,\"omega_radps\":{}}}\n",
                     t_s, kRadius_m * kOmega, omega_radps),
         now_s);
  }
  void pose_prior(double t_s, double now_s) const {
    const auto pose = truth(now_s);
    line(fmt::format(
             "{{\"class\":\"POSE_PRIOR\",\"t_s\":{},\"x_m\":{},\"y_m\":{},\"z_m\":0,\"yaw_rad\":{}}}\n", t_s,
             pose.x_m, pose.y_m, pose.theta_rad),
         now_s);
  }
  void report(double now_s) {
    const auto ticks = [](double s) { return std::llround(s * clock::kDeviceTicksPerSecond); };
    std::vector<groma_Range> ranges;
    for (std::size_t i = 0; i < anchors_.size(); ++i) {
      const double age_s = 0.12 - 0.02 * static_cast<double>(i);
      const double range_m = range(now_s - age_s, i).range_m;
      ranges.push_back(link::test::make_range(anchors_[i].id, range_m, ticks(-age_s)));
    }
    session_->node_bytes(tag_,
                         link::test::frame_of(link::test::make_report(
                             sequence_++, 1, static_cast<std::uint64_t>(ticks(now_s)), ranges)),
                         now_s);
  }
  // robot_s: offset of the robot's clock from the others.
  void drive(double from_s, double to_s, bool with_odometry = true, double robot_s = 0.0) {
    for (auto i = std::lround(from_s / 0.02); i < std::lround(to_s / 0.02); ++i) {
      const double t_s = 0.02 * static_cast<double>(i);
      if (with_odometry) odometry(t_s + robot_s, t_s);
      if (with_odometry && i % 50 == 0) pose_prior(t_s + robot_s, t_s);
      session_->advance(t_s + 0.001);
      if (i % 5 == 0) report(t_s + 0.002);
      session_->advance(t_s + 0.002);
    }
  }
  [[nodiscard]] bool times_increase() const {
    return std::adjacent_find(poses_.begin(), poses_.end(), [](const PoseEstimate& a, const PoseEstimate& b) {
             return a.t_s >= b.t_s;
           }) == poses_.end();
  }
  [[nodiscard]] double error_m(const PoseEstimate& pose, double robot_s = 0.0) const {
    const auto true_pose = truth(pose.t_s - robot_s + carried_s_);
    return std::hypot(pose.x_m - true_pose.x_m, pose.y_m - true_pose.y_m);
  }
  // The pose published at once for each odometry sample equals the settled one, except for the state.
  void expect_same_as_settled() const {
    ASSERT_FALSE(poses_.empty());
    std::size_t compared = 0;
    auto settled = settled_.begin();
    for (const PoseEstimate& pose : poses_) {
      while (settled != settled_.end() && settled->t_s < pose.t_s) ++settled;
      if (settled == settled_.end()) break;
      ASSERT_EQ(pose.t_s, settled->t_s);
      ASSERT_EQ(pose.x_m, settled->x_m) << pose.t_s;
      ASSERT_EQ(pose.y_m, settled->y_m);
      ASSERT_EQ(pose.yaw_rad, settled->yaw_rad);
      ASSERT_EQ(pose.covariance, settled->covariance);
      ++compared;
    }
    EXPECT_GT(compared, 200U);
  }

  std::unique_ptr<Session> session_;
  std::unique_ptr<Localizer> localizer_;
  std::size_t tag_ = 0;
  std::uint32_t sequence_ = 0;
  std::vector<PoseEstimate> poses_;
  std::vector<PoseEstimate> settled_;
};

TEST_F(Live, APoseIsPublishedInTheCallOfItsSample) {
  begin(0.2);
  drive(kBegin_s, 16.0);
  ASSERT_FALSE(poses_.empty());
  // The prior started the filter after reorder_lag_s.
  EXPECT_NEAR(poses_.front().t_s, kBegin_s + 0.2, 0.021);
  EXPECT_EQ(poses_.size(), static_cast<std::size_t>(std::lround((16.0 - poses_.front().t_s) / 0.02)));
  EXPECT_TRUE(times_increase());

  const std::size_t before = poses_.size();
  odometry(16.0, 16.0);
  ASSERT_EQ(poses_.size(), before + 1);
  EXPECT_EQ(poses_.back().t_s, 16.0);
  EXPECT_EQ(poses_.back().state, filter::State::kTracking);
  EXPECT_LT(error_m(poses_.back()), 0.05);
  EXPECT_LT(settled_.back().t_s, 15.81);
  session_->advance(16.0);
  odometry(16.0, 16.01);
  odometry(15.9, 16.01);
  session_->flush();
  EXPECT_EQ(poses_.size(), before + 1);
  EXPECT_EQ(settled_.back().t_s, 16.0);
}

TEST_F(Live, WithoutALagThePoseIsTheFilters) {
  begin(0.0);
  drive(kBegin_s, 16.0);
  expect_same_as_settled();
  EXPECT_LT(error_m(poses_.back()), 0.05);
}

// The odometry's yaw rate is twice the true one, a gyro is right, and there are no ranges: waiting changes no
// pose.
TEST_F(Live, UsesAWaitingGyroSample) {
  begin(0.2);
  for (int i = 0; i < 300; ++i) {
    const double t_s = kBegin_s + 0.02 * i;
    odometry(t_s, t_s, 2.0 * kOmega);
    if (i == 0) pose_prior(t_s, t_s);
    session_->advance(t_s);
    line(fmt::format("{{\"class\":\"IMU\",\"t_s\":{},\"omega_radps\":{}}}\n", t_s + 0.01, kOmega),
         t_s + 0.01);
  }
  session_->flush();
  expect_same_as_settled();
  EXPECT_NEAR(poses_.back().yaw_rad, model::wrap_angle(truth(poses_.back().t_s).theta_rad), 0.05);
}

TEST_F(Live, EachLateSampleHasAPose) {
  begin(0.2);
  drive(kBegin_s, 14.0);
  const std::size_t before = poses_.size();
  drive(14.0, 14.4, /*with_odometry=*/false);
  EXPECT_EQ(poses_.size(), before);
  for (int i = 0; i <= 20; ++i) {
    const double t_s = 14.0 + 0.02 * i;
    odometry(t_s, 14.4);
    ASSERT_EQ(poses_.size(), before + static_cast<std::size_t>(i) + 1);
    EXPECT_EQ(poses_.back().t_s, t_s);
    EXPECT_LT(error_m(poses_.back()), 0.1);
  }
  EXPECT_GE(session_->counters().passed_late, 8U);
  drive(14.42, 15.0);
  EXPECT_EQ(poses_.size(), before + 21 + 29);
  EXPECT_TRUE(times_increase());
}

TEST_F(Live, ThePoseIsUncertainAfterTheRobotWasUnplugged) {
  begin(0.2);
  drive(kBegin_s, 14.0);
  const PoseEstimate before = poses_.back();
  const std::size_t count = poses_.size();
  drive(14.0, 16.0, /*with_odometry=*/false);
  EXPECT_EQ(poses_.size(), count);
  session_->robot_reopened();
  drive(16.0, 16.02);
  ASSERT_EQ(poses_.size(), count + 1);
  EXPECT_NEAR(poses_.back().t_s, 16.0, 1e-9);
  EXPECT_EQ(poses_.back().reason, filter::Reason::kNoOdometry);
  EXPECT_GT(poses_.back().planar_covariance.trace(), 2.0 * before.planar_covariance.trace());
  drive(16.02, 18.0);
  EXPECT_EQ(poses_.back().state, filter::State::kTracking);
  EXPECT_LT(error_m(poses_.back()), 0.05);
  EXPECT_EQ(poses_.size(), count + 100);
  EXPECT_TRUE(times_increase());
}

TEST_F(Live, RestartsWhenTheClockWasSet) {
  constexpr double kSet_s = -1000.0;
  setup_.tracker.relocates = false;
  begin(0.2);
  drive(kBegin_s, 14.0);
  const std::size_t before = poses_.size();
  drive(14.0, 15.0, /*with_odometry=*/false);
  drive(15.0, 19.0, /*with_odometry=*/true, kSet_s);
  EXPECT_EQ(session_->counters().robot_clock_set, 1U);
  ASSERT_GT(poses_.size(), before);
  EXPECT_TRUE(std::all_of(poses_.begin() + static_cast<std::ptrdiff_t>(before), poses_.end(),
                          [](const PoseEstimate& pose) { return pose.t_s < 0.0; }));
  // One second until the new clock is accepted, then the next prior and its lag.
  EXPECT_GT(poses_[before].t_s, 16.2 + kSet_s);
  EXPECT_LT(poses_[before].t_s, 17.3 + kSet_s);
  poses_.erase(poses_.begin(), poses_.begin() + static_cast<std::ptrdiff_t>(before));
  EXPECT_TRUE(times_increase());
  EXPECT_LT(error_m(poses_.back(), kSet_s), 0.05);
}

// As when NTP sets the computer's clock.
TEST_F(Live, AClockThatStepsMovesNoPoseAndLosesNoSample) {
  for (const double step_s : {1.0, -1.0, 3600.0, -3600.0}) {
    SCOPED_TRACE(step_s);
    poses_.clear();
    settled_.clear();
    begin(0.2);
    drive(kBegin_s, 14.0);
    const std::size_t before = poses_.size();
    drive(14.0, 18.0, /*with_odometry=*/true, step_s);
    ASSERT_EQ(poses_.size(), before + 200) << "a pose for each sample";
    EXPECT_EQ(session_->counters().robot_clock_set, 1U);
    for (std::size_t i = before; i < poses_.size(); ++i) {
      EXPECT_NEAR(poses_[i].t_s, 14.0 + step_s + 0.02 * static_cast<double>(i - before), 1e-6);
      EXPECT_LT(error_m(poses_[i], step_s), 0.05);
    }
    // The way between the last pose of the old clock and the first of the new one is that of 20 ms.
    const double way_m =
        std::hypot(poses_[before].x_m - poses_[before - 1].x_m, poses_[before].y_m - poses_[before - 1].y_m);
    EXPECT_NEAR(way_m, kRadius_m * kOmega * 0.02, 0.01);
    EXPECT_EQ(poses_.back().state, filter::State::kTracking);
  }
}

TEST_F(Live, ContinuesThroughARelocation) {
  // Slip detection would also recover by itself.
  setup_.filter.slip_odds = 1e9;
  begin(0.2);
  drive(kBegin_s, 14.0);
  carried_s_ = 3.14 / kOmega;  // to the opposite side of the circle, and turned
  const std::size_t before = poses_.size();
  drive(14.0, 30.0);
  EXPECT_EQ(poses_.size(), before + 800);
  EXPECT_TRUE(times_increase());
  EXPECT_TRUE(std::any_of(poses_.begin() + static_cast<std::ptrdiff_t>(before), poses_.end(),
                          [](const PoseEstimate& pose) { return pose.state == filter::State::kConverging; }));
  EXPECT_EQ(poses_.back().state, filter::State::kTracking);
  EXPECT_LT(error_m(poses_.back()), 0.1);
}

TEST_F(Live, ContinuesWithAnotherCalibrationOverWaitingSamples) {
  const model::Calibration whole = setup_.calibration;
  setup_.calibration.anchors.pop_back();
  begin(0.2);
  drive(kBegin_s, 20.0);
  const PoseEstimate before = poses_.back();
  const filter::CoreVector core_before = localizer_->filter().core();
  localizer_->adopt(whole);
  EXPECT_EQ(localizer_->filter().core(), core_before);
  const std::size_t count = poses_.size();
  drive(20.0, 21.0);
  EXPECT_EQ(poses_.size(), count + 50);
  EXPECT_LT(std::abs(error_m(poses_[count]) - error_m(before)), 0.01);
  EXPECT_LT(poses_[count].planar_covariance.trace(), 1.3 * before.planar_covariance.trace());
  for (std::size_t i = count; i < poses_.size(); ++i) {
    EXPECT_EQ(poses_[i].state, filter::State::kTracking);
    EXPECT_LT(error_m(poses_[i]), 0.05);
  }
}

TEST_F(Circle, PredictsWithoutTheHeapAndWithinItsBound) {
  PoseEstimate last;
  std::size_t count = 0;
  Localizer localizer(setup_, [&](const PoseEstimate& pose) {
    last = pose;
    ++count;
  });
  localizer.on_odometry(odometry_at(0.0));
  localizer.on_pose_prior(prior(0.0));
  drive(localizer, 0.02, 2.0, true);
  const std::size_t before = groma::test::allocations();
  const std::size_t count_before = count;
  constexpr int kSamples = 2 * static_cast<int>(Localizer::kMaxAhead);
  for (int i = 0; i < kSamples; ++i) {
    localizer.on_odometry_ahead(odometry_at(2.0 + 1e-4 * i));
    localizer.on_sensor_ahead(model::YawRateSample{2.0 + 1e-4 * (i + 0.5), kOmega});
  }
  EXPECT_EQ(groma::test::allocations(), before);
  EXPECT_EQ(count, count_before + kSamples);
  EXPECT_EQ(last.t_s, 2.0 + 1e-4 * (kSamples - 1));
  EXPECT_LT(std::hypot(last.x_m - truth(last.t_s).x_m, last.y_m - truth(last.t_s).y_m), 0.05);
}

}  // namespace
}  // namespace groma::daemon
