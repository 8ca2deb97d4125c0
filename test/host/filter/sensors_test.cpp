// Gyro, GNSS, poses of another localization, and zero-velocity updates.
#include "host/filter/sensors.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <memory>
#include <numbers>
#include <string>
#include <vector>

#include "host/filter/filter.hpp"
#include "host/filter/ordered_filter.hpp"
#include "host/filter/tracker.hpp"
#include "test/host/filter/small_site.hpp"
#include "test/support/allocations.hpp"
#include "test/support/numerical_jacobian.hpp"

namespace groma::filter {
namespace {

using test::numerical_jacobian;
using test::Random;

constexpr std::size_t kGyroAt = model::kSensorOf<model::YawRateSample>;
constexpr std::size_t kPositionAt = model::kSensorOf<model::PositionSample>;
constexpr std::size_t kPoseAt = model::kSensorOf<model::PoseSample>;
constexpr std::size_t kStandingAt = model::kSensorOf<model::ZeroVelocitySample>;

const Eigen::Vector3d kLeverArm(0.4, -0.3, 1.5);

CoreVector any_core(Random& random) {
  CoreVector core;
  core << random.uniform(-9.0, 9.0), random.uniform(-9.0, 9.0), random.uniform(-3.0, 3.0),
      0.02 * random.gaussian(), 0.01 * random.gaussian(), 0.02 * random.gaussian(), 0.1 * random.gaussian(),
      0.1 * random.gaussian(), 0.05 * random.gaussian();
  return core;
}

TEST(Sensors, TheDescriptionSetsEachGyroSigma) {
  const SensorConfig config({.gyro_sigma_radps = 0.003, .gyro_bias_sigma_radps = 0.02});
  EXPECT_EQ(config.gyro_sigma_radps, 0.003);
  EXPECT_EQ(config.gyro_bias_radps, 0.02);
  const SensorConfig defaults({.gyro_sigma_radps = 0.003});
  EXPECT_EQ(defaults.gyro_bias_radps, SensorConfig{}.gyro_bias_radps);
}

// Compares the Jacobian of the prediction (measured value minus innovation) with a numerical one.
template <class Measure>
void expect_jacobian(const Measure& measure, const CoreVector& core, double tolerance) {
  const auto exact = measure(core).d_core.eval();
  Eigen::MatrixXd numerical = numerical_jacobian(
      [&](const Eigen::VectorXd& x) { return Eigen::VectorXd(-measure(CoreVector(x)).innovation); }, core,
      1e-6);
  // The derivative w.r.t. the delay is first order only.
  EXPECT_LT((exact.col(kDelay) - numerical.col(kDelay)).cwiseAbs().maxCoeff(), 2e-3);
  numerical.col(kDelay) = exact.col(kDelay);
  EXPECT_LT((exact - numerical).cwiseAbs().maxCoeff(), tolerance);
}

TEST(Sensors, JacobiansEqualNumericalOnes) {
  const model::Surface surface = testing::hills(0.5);
  const LinkDelays delays{.range_s = 0.01, .range_sigma_s = 0.01, .odometry_sigma_s = 0.015};
  SensorConfig config;
  config.position_lever_arm_m = kLeverArm;
  Random random(41);
  for (int i = 0; i < 20; ++i) {
    const CoreVector core = any_core(random);
    const model::OdometrySample row{0.0, 2.0 * random.gaussian(), random.gaussian(), random.gaussian()};
    const auto measured = [&](const auto& sample) {
      return [&, sample](const CoreVector& at) {
        return measure(SensorView{surface, config, at, row, present_pose(surface, at, row, delays)}, sample);
      };
    };
    const auto position =
        measured(model::PositionSample{.x_m = 1.0, .y_m = 2.0, .covariance_m2 = {0.04, 0.01, 0.09}});
    const auto pose = measured(model::PoseSample{
        .yaw_rad = core(kTheta), .covariance = model::PoseCovariance{0.04, 0.01, 0.0, 0.09, 0.0, 0.01}});
    const auto standing = measured(model::ZeroVelocitySample{});
    expect_jacobian(position, core, 3e-7);
    expect_jacobian(pose, core, 3e-7);
    expect_jacobian(standing, core, 1e-8);
  }
}

TEST(Sensors, AHeadingAcrossHalfATurnIsASmallInnovation) {
  const model::Surface flat;
  const SensorConfig config;
  const model::OdometrySample row{};
  CoreVector core = CoreVector::Zero();
  core(kTheta) = 3.1;
  const model::PoseSample pose{.yaw_rad = -3.1,
                               .covariance = model::PoseCovariance{0.01, 0.0, 0.0, 0.01, 0.0, 0.01}};
  const SensorView view{flat, config, core, row, present_pose(flat, core, row, {})};
  EXPECT_NEAR(measure(view, pose).innovation(2), 2.0 * std::numbers::pi - 6.2, 1e-12);
}

TEST(Sensors, AttitudeGivesTheHeadingOnTheSurface) {
  const model::Surface surface = testing::hills(0.5);
  const model::SurfacePose there = model::pose_on_surface(surface, {3.0, -2.0, 0.7});
  const Eigen::Matrix3d& r = there.pose.rotation;
  const model::PoseSample sample{.x_m = 3.0,
                                 .y_m = -2.0,
                                 .yaw_rad = std::atan2(r(1, 0), r(0, 0)),
                                 .roll_rad = std::atan2(r(2, 1), r(2, 2)),
                                 .pitch_rad = -std::asin(r(2, 0))};
  EXPECT_NEAR(place_on(surface, sample).theta_rad, 0.7, 1e-12);
  EXPECT_GT(std::abs(sample.yaw_rad - 0.7), 1e-4);
}

Config sensor_config(Model model = Model::kSchmidt) {
  Config config;
  config.model = model;
  config.odometry = {0.03, 0.03, 0.01};
  config.sensors.position_lever_arm_m = kLeverArm;
  return config;
}

std::unique_ptr<Filter> filter_of(const Config& config) {
  return std::make_unique<Filter>(testing::hills(0.2), testing::three_tags(), testing::six_anchors(), config);
}

// A filter after a drive of 3 s, with all states correlated.
std::unique_ptr<Filter> driven(const Config& config) {
  Random random(6);
  const testing::Drive drive = testing::drive(testing::hills(0.2), testing::six_anchors(), {},
                                              {.duration_s = 3.0, .range_s = 0.01}, random);
  auto filter = filter_of(config);
  filter->process(drive.odometry.front());
  filter->start({});
  auto range = drive.ranges.begin();
  for (const model::OdometrySample& row : drive.odometry) {
    for (; range != drive.ranges.end() && range->t_s < row.t_s; ++range) filter->process(*range);
    filter->process(row);
  }
  return filter;
}

class SensorModels : public ::testing::TestWithParam<Model> {
 protected:
  // Compares core and parameters with a dense consider update in Joseph form.
  template <int kSize>
  void expect_update(const Filter& before, const CoreMeasurement<kSize>& measurement, const Filter& after) {
    const Eigen::MatrixXd p = testing::whole(before);
    Eigen::VectorXd estimated = Eigen::VectorXd::Zero(p.rows());
    estimated.head<kCoreSize>().setOnes();
    if (GetParam() == Model::kJoint) {
      estimated.setOnes();
      for (int i = 0; i < before.parameters().anchor_count(); ++i)
        estimated(kCoreSize + before.parameters().range_bias(i)) = 0.0;
    }
    Eigen::MatrixXd h = Eigen::MatrixXd::Zero(kSize, p.rows());
    h.leftCols<kCoreSize>() = measurement.d_core;
    const Eigen::MatrixXd s = h * p * h.transpose() + measurement.noise;
    const Eigen::MatrixXd gain = estimated.asDiagonal() * p * h.transpose() * s.inverse();
    const Eigen::MatrixXd rest = Eigen::MatrixXd::Identity(p.rows(), p.rows()) - gain * h;
    const Eigen::MatrixXd expected =
        rest * p * rest.transpose() + gain * measurement.noise * gain.transpose();
    const Eigen::VectorXd sigmas = p.diagonal().cwiseSqrt().cwiseMax(1e-6);
    const Eigen::MatrixXd off = sigmas.cwiseInverse().asDiagonal() * (testing::whole(after) - expected) *
                                sigmas.cwiseInverse().asDiagonal();
    EXPECT_LT(off.cwiseAbs().maxCoeff(), 1e-9);
    Eigen::VectorXd change(p.rows());
    change << after.core() - before.core(), after.parameters().values() - before.parameters().values();
    EXPECT_LT((change - gain * measurement.innovation).cwiseQuotient(sigmas).cwiseAbs().maxCoeff(), 1e-9);
  }
};
INSTANTIATE_TEST_SUITE_P(Sensors, SensorModels, ::testing::Values(Model::kSchmidt, Model::kJoint),
                         [](const auto& model) { return std::string(model_name(model.param)); });

TEST_P(SensorModels, UpdateEqualsADenseOne) {
  const Config config = sensor_config(GetParam());
  const auto before = driven(config);
  ASSERT_GT(before->covariance().cross().cwiseAbs().maxCoeff(), 1e-5);
  const Estimate now = before->estimate();
  const model::Surface surface = testing::hills(0.2);
  const model::OdometrySample& row = before->snapshot().odometry;
  const PresentPose present = present_pose(surface, before->core(), row, {});

  const model::PositionSample position{.t_s = now.t_s,
                                       .x_m = now.pose.x_m + 0.5,
                                       .y_m = now.pose.y_m + 0.1,
                                       .covariance_m2 = {0.09, 0.03, 0.04}};
  auto after = driven(config);
  ASSERT_EQ(after->process(position).outcome, SensorOutcome::kUsed);
  expect_update(*before, measure({surface, config.sensors, before->core(), row, present}, position), *after);

  const model::PoseSample pose{.t_s = now.t_s,
                               .x_m = now.pose.x_m + 0.1,
                               .y_m = now.pose.y_m - 0.1,
                               .yaw_rad = now.pose.theta_rad + 0.03,
                               .covariance = model::PoseCovariance{0.01, 0.003, 0.001, 0.02, 0.0, 0.001}};
  after = driven(config);
  ASSERT_EQ(after->process(pose).outcome, SensorOutcome::kUsed);
  expect_update(*before, measure({surface, config.sensors, before->core(), row, present}, pose), *after);

  Config slow = config;
  slow.sensors.standing_sigma_mps = 1.0;
  slow.sensors.standing_sigma_radps = 0.5;
  const auto standing_before = driven(slow);
  after = driven(slow);
  ASSERT_EQ(after->process(model::ZeroVelocitySample{now.t_s}).outcome, SensorOutcome::kUsed);
  expect_update(
      *standing_before,
      measure({surface, slow.sensors, standing_before->core(), row, present}, model::ZeroVelocitySample{}),
      *after);
}

// Mean of e' P^-1 e / 3 at the end of drives whose errors are drawn from their sigmas, with odometry, perhaps
// a gyro, and one other sensor, without ranges.
template <class Sense>
double mean_nees(int drives, bool gyro, const Sense& sense) {
  const model::Surface surface = testing::hills(0.2);
  const Config config = sensor_config();
  double sum = 0.0;
  for (int seed = 0; seed < drives; ++seed) {
    Random random(900 + static_cast<std::uint64_t>(seed));
    const model::PlanarPose begin{0.1 * random.gaussian(), 0.1 * random.gaussian(), 0.05 * random.gaussian()};
    const testing::Drive drive =
        testing::drive(surface, testing::six_anchors(), begin, {.duration_s = 20.0}, random);
    const double gyro_bias = config.sensors.gyro_bias_radps * random.gaussian();
    const auto filter = filter_of(config);
    filter->process(drive.odometry.front());
    filter->start({});
    for (std::size_t i = 0; i < drive.odometry.size(); ++i) {
      const model::OdometrySample& row = drive.odometry[i];
      filter->process(row);
      if (gyro) {
        filter->process(
            model::YawRateSample{row.t_s, testing::true_velocity(row.t_s).z() + gyro_bias +
                                              config.sensors.gyro_sigma_radps * random.gaussian()});
      }
      if (i % 5 == 0) sense(*filter, row.t_s, drive.truth[i], random);
    }
    sum += testing::squared_error(filter->estimate(), drive.truth.back()) / 3.0;
  }
  return sum / drives;
}

constexpr auto kNothing = [](Filter&, double, const model::PlanarPose&, Random&) {};

// The mean of 100 has a sigma of 0.08.
TEST(Sensors, AGyroKeepsTheFilterConsistentOverManyDrives) {
  const double nees = mean_nees(100, true, kNothing);
  EXPECT_GT(nees, 0.75);
  EXPECT_LT(nees, 1.25);
}

TEST(Sensors, PositionsKeepTheFilterConsistentOverManyDrives) {
  const model::Surface surface = testing::hills(0.2);
  const double nees =
      mean_nees(100, true, [&](Filter& filter, double t_s, const model::PlanarPose& truth, Random& random) {
        const Eigen::Vector3d antenna = model::pose_on_surface(surface, truth).pose.rotation * kLeverArm;
        Eigen::Matrix2d covariance;
        covariance << 0.04, 0.03, 0.03, 0.09;
        const Eigen::VectorXd error = random.gaussians(Eigen::MatrixXd(covariance));
        filter.process(model::PositionSample{.t_s = t_s,
                                             .x_m = truth.x_m + antenna.x() + error(0),
                                             .y_m = truth.y_m + antenna.y() + error(1),
                                             .covariance_m2 = {0.04, 0.03, 0.09}});
      });
  EXPECT_GT(nees, 0.75);
  EXPECT_LT(nees, 1.25);
}

TEST(Sensors, PosesKeepTheFilterConsistentOverManyDrives) {
  const double nees =
      mean_nees(100, false, [&](Filter& filter, double t_s, const model::PlanarPose& truth, Random& random) {
        Eigen::Matrix3d covariance;
        covariance << 0.04, 0.03, 0.002, 0.03, 0.09, 0.0, 0.002, 0.0, 0.001;
        const Eigen::VectorXd error = random.gaussians(Eigen::MatrixXd(covariance));
        filter.process(
            model::PoseSample{.t_s = t_s,
                              .x_m = truth.x_m + error(0),
                              .y_m = truth.y_m + error(1),
                              .yaw_rad = truth.theta_rad + error(2),
                              .covariance = model::PoseCovariance{0.04, 0.03, 0.002, 0.09, 0.0, 0.001}});
      });
  EXPECT_GT(nees, 0.75);
  EXPECT_LT(nees, 1.25);
}

TEST(Sensors, AStationaryRobotEstimatesTheYawRateBias) {
  const auto filter = filter_of(sensor_config());
  Random random(3);
  filter->process(model::OdometrySample{});
  filter->start({});
  for (int i = 1; i <= 600; ++i) {
    const double t_s = 0.05 * i;
    filter->process(model::OdometrySample{t_s, 0.03 * random.gaussian(), 0.03 * random.gaussian(),
                                          0.004 + 0.01 * random.gaussian()});
    filter->process(model::ZeroVelocitySample{t_s});
  }
  const Estimate estimate = filter->estimate();
  EXPECT_EQ(filter->counters().sensors[kStandingAt][SensorOutcome::kUsed], 600U);
  EXPECT_NEAR(estimate.yaw_rate_bias_radps, 0.004, 0.0012);
  EXPECT_LT(std::hypot(estimate.pose.x_m, estimate.pose.y_m), 0.02);
  EXPECT_LT(std::abs(estimate.pose.theta_rad), 0.01);
}

TEST(Sensors, AGyroGivesTheHeadingWhileWheelsSlip) {
  const auto filter = filter_of(sensor_config());
  filter->process(model::OdometrySample{});
  filter->start({.heading_sigma_rad = 0.01});
  for (int i = 1; i <= 500; ++i) {
    const double t_s = 0.01 * i;
    filter->process(model::YawRateSample{t_s, 0.3});
    if (i % 5 == 0) filter->process(model::OdometrySample{t_s, 0.0, 0.0, 1.5});
  }
  EXPECT_NEAR(filter->estimate().pose.theta_rad, 0.3 * 4.99, 0.01);
  // Without gyro samples odometry's yaw rate is used again.
  const double before = filter->estimate().pose.theta_rad;
  for (int i = 1; i <= 20; ++i) filter->process(model::OdometrySample{5.0 + 0.05 * i, 0.0, 0.0, 0.1});
  EXPECT_NEAR(filter->estimate().pose.theta_rad - before, 0.25 * 0.3 + 0.75 * 0.1, 0.03);
}

TEST(Sensors, ImplausibleValuesAreRefusedWithTheirReason) {
  const auto filter = filter_of(sensor_config());
  filter->process(model::OdometrySample{});
  EXPECT_EQ(filter->process(model::YawRateSample{0.0, 0.1}).outcome, SensorOutcome::kNotStarted);
  filter->start({});
  const double nan = std::numeric_limits<double>::quiet_NaN();
  filter->process(model::YawRateSample{0.0, nan});
  filter->process(model::YawRateSample{0.01, 0.1});
  EXPECT_EQ(filter->process(model::YawRateSample{0.02, 5.0}).outcome, SensorOutcome::kJumped);
  EXPECT_EQ(filter->process(model::YawRateSample{0.01, 0.1}).outcome, SensorOutcome::kOutOfOrder);
  const auto& gyro = filter->counters().sensors[kGyroAt];
  EXPECT_EQ(gyro[SensorOutcome::kUsed], 1U);
  EXPECT_EQ(gyro[SensorOutcome::kJumped], 1U);
  EXPECT_EQ(gyro[SensorOutcome::kBadValue], 1U);
  EXPECT_EQ(gyro[SensorOutcome::kOutOfOrder], 1U);
  EXPECT_EQ(gyro[SensorOutcome::kNotStarted], 1U);

  filter->process(model::PositionSample{.t_s = 0.02, .covariance_m2 = {0.01, 0.02, 0.01}});
  const CoreVector before = filter->core();
  EXPECT_EQ(
      filter->process(model::PositionSample{.t_s = 0.02, .x_m = 30.0, .covariance_m2 = {0.01, 0.0, 0.01}})
          .outcome,
      SensorOutcome::kGated);
  EXPECT_EQ(filter->core(), before);
  EXPECT_EQ(filter->counters().sensors[kPositionAt][SensorOutcome::kBadValue], 1U);
  EXPECT_EQ(filter->counters().sensors[kPositionAt][SensorOutcome::kGated], 1U);

  EXPECT_EQ(filter->process(model::PoseSample{.t_s = 0.02}).outcome, SensorOutcome::kBadValue);
  EXPECT_EQ(filter->counters().sensors[kPoseAt][SensorOutcome::kBadValue], 1U);
}

TEST(Sensors, ASensorRefusedForLongIsUsedAgain) {
  const auto filter = filter_of(sensor_config());
  filter->process(model::OdometrySample{});
  filter->start({});
  std::size_t first = 0;
  for (int i = 0; i < 300; ++i) {
    const double t_s = 0.05 * i;
    filter->process(model::OdometrySample{t_s + 1e-3, 0.0, 0.0, 0.0});
    const SensorResult result = filter->process(
        model::PoseSample{.t_s = t_s + 1e-3,
                          .x_m = 3.0,
                          .covariance = model::PoseCovariance{0.01, 0.0, 0.0, 0.01, 0.0, 0.0025}});
    if (first == 0 && result.outcome == SensorOutcome::kUsed) first = static_cast<std::size_t>(i);
  }
  EXPECT_NEAR(static_cast<double>(first) * 0.05, 2.0, 0.1);
  EXPECT_NEAR(filter->estimate().pose.x_m, 3.0, 0.05);
}

TEST(Sensors, OutOfOrderEqualsInOrder) {
  const Config config = sensor_config();
  const auto reference = filter_of(config);
  OrderedFilter filter(testing::hills(0.2), testing::three_tags(), testing::six_anchors(), config);
  reference->start({});
  filter.start({});
  Random random(8);
  for (int step = 0; step < 40; ++step) {
    const double t_s = 0.1 * step;
    const model::OdometrySample row{t_s, 0.5, 0.0, 0.1};
    const model::YawRateSample rate{t_s + 0.01, 0.1 + 0.005 * random.gaussian()};
    const model::ZeroVelocitySample standing{t_s + 0.02};
    const model::PositionSample position{
        .t_s = t_s + 0.03, .x_m = 0.05 * step + 0.3 * random.gaussian(), .covariance_m2 = {0.1, 0.0, 0.1}};
    const model::PoseSample pose{.t_s = t_s + 0.04,
                                 .x_m = 0.05 * step,
                                 .yaw_rad = 0.01 * step,
                                 .covariance = model::PoseCovariance{0.1, 0.0, 0.0, 0.1, 0.0, 0.1}};
    reference->process(row);
    reference->process(rate);
    reference->process(standing);
    reference->process(position);
    reference->process(pose);
    filter.process(pose);
    filter.process(standing);
    filter.process(rate);
    filter.process(position);
    filter.process(row);
  }
  EXPECT_EQ(filter.filter().core(), reference->core());
  EXPECT_EQ(testing::whole(filter.filter()), testing::whole(*reference));
  for (std::size_t i = 0; i < model::kSensors; ++i) {
    EXPECT_EQ(filter.counters().sensors[i][SensorOutcome::kUsed],
              reference->counters().sensors[i][SensorOutcome::kUsed])
        << i;
    EXPECT_GT(filter.counters().sensors[i][SensorOutcome::kUsed] +
                  filter.counters().sensors[i][SensorOutcome::kGated],
              35U)
        << i;
  }
  EXPECT_EQ(filter.process(model::ZeroVelocitySample{1.0}).outcome, SensorOutcome::kOutOfOrder);
  EXPECT_EQ(filter.counters().sensors[kStandingAt][SensorOutcome::kOutOfOrder], 1U);
  EXPECT_EQ(filter.process(model::YawRateSample{5.0, std::nan("")}).outcome, SensorOutcome::kBadValue);
}

TEST(Sensors, AllocateNothing) {
  const auto filter = driven(sensor_config(Model::kJoint));
  const Estimate now = filter->estimate();
  const std::size_t before = test::allocations();
  filter->process(model::YawRateSample{now.t_s + 0.01, 0.2});
  filter->process(model::ZeroVelocitySample{now.t_s + 0.01});
  filter->process(model::PositionSample{
      .t_s = now.t_s + 0.01, .x_m = now.pose.x_m, .y_m = now.pose.y_m, .covariance_m2 = {0.1, 0.0, 0.1}});
  filter->process(model::PoseSample{.t_s = now.t_s + 0.01,
                                    .x_m = now.pose.x_m,
                                    .y_m = now.pose.y_m,
                                    .covariance = model::PoseCovariance{0.1, 0.0, 0.0, 0.1, 0.0, 0.1}});
  EXPECT_EQ(test::allocations(), before);
}

TEST(Sensors, AnAbsolutePoseInitializesTheTracker) {
  Tracker tracker(testing::hills(0.2), testing::three_tags(), testing::six_anchors(), sensor_config());
  tracker.process(model::OdometrySample{});
  const SensorResult begun = tracker.process(model::PoseSample{
      .t_s = 0.01, .x_m = 2.0, .covariance = model::PoseCovariance{0.01, 0.0, 0.0, 0.04, 0.0, 0.0025}});
  EXPECT_EQ(begun.outcome, SensorOutcome::kUsed);
  ASSERT_TRUE(tracker.started());
  EXPECT_NEAR(tracker.estimate().covariance(0, 0), 0.04, 1e-12);
}

}  // namespace
}  // namespace groma::filter
