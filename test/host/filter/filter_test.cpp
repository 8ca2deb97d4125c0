#include "host/filter/filter.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <numbers>
#include <variant>
#include <vector>

#include <Eigen/Eigenvalues>

#include "test/host/filter/endurance.hpp"
#include "test/host/filter/small_site.hpp"
#include "test/support/allocations.hpp"

namespace groma::filter {
namespace {

using test::Random;

std::unique_ptr<Filter> make_filter(Model model, const model::Surface& surface = testing::hills(0.2)) {
  return std::make_unique<Filter>(surface, testing::three_tags(), testing::six_anchors(),
                                  testing::config_of(model));
}

// Feeds odometry and ranges in order of time, up to end_s exclusive, and continues there on the next call.
class Feeder {
 public:
  explicit Feeder(const testing::Drive& drive) : drive_(drive) {}

  void until(double end_s, Filter& filter) {
    while (true) {
      const bool has_sample = row_ < drive_.odometry.size() && drive_.odometry[row_].t_s < end_s;
      const bool has_range = range_ < drive_.ranges.size() && drive_.ranges[range_].t_s < end_s;
      if (!has_sample && !has_range) return;
      if (has_sample && (!has_range || drive_.odometry[row_].t_s <= drive_.ranges[range_].t_s)) {
        filter.process(drive_.odometry[row_++]);
      } else {
        filter.process(drive_.ranges[range_++]);
      }
    }
  }

 private:
  const testing::Drive& drive_;
  std::size_t row_ = 0;
  std::size_t range_ = 0;
};

class EveryModel : public ::testing::TestWithParam<Model> {};
INSTANTIATE_TEST_SUITE_P(Filter, EveryModel, ::testing::ValuesIn(kModels),
                         [](const ::testing::TestParamInfo<Model>& model) {
                           std::string name(model_name(model.param));
                           std::erase(name, '-');
                           return name;
                         });

TEST(ModelNames, ConvertBothWays) {
  for (const Model model : kModels) EXPECT_EQ(model_from_name(model_name(model)), model);
  EXPECT_FALSE(model_from_name("kalman").has_value());
  EXPECT_FALSE(model_from_name("").has_value());
}

TEST(Filter, ReturnsAndCountsTheOutcomeOfEachInput) {
  const auto filter = make_filter(Model::kSchmidt);
  const model::RangeSample good{1.0, 1, 11, 15.0};
  EXPECT_EQ(filter->process(good).outcome, RangeOutcome::kNotStarted);
  EXPECT_EQ(filter->process(model::OdometrySample{0.5, 1.0, 0.0, 0.0}), OdometryOutcome::kStored);
  filter->start({.t_s = 1.0});
  EXPECT_EQ(filter->process(model::RangeSample{1.1, 9, 11, 15.0}).outcome, RangeOutcome::kUnknownTag);
  EXPECT_EQ(filter->process(model::RangeSample{1.1, 1, 99, 15.0}).outcome, RangeOutcome::kUnknownAnchor);
  for (const double range_m : {0.0, -3.0, 300e3, testing::kNan, testing::kInfinity, -testing::kInfinity}) {
    EXPECT_EQ(filter->process(model::RangeSample{1.1, 1, 11, range_m}).outcome, RangeOutcome::kBadValue)
        << range_m;
  }
  EXPECT_EQ(filter->process(model::RangeSample{testing::kNan, 1, 11, 15.0}).outcome, RangeOutcome::kBadValue);
  EXPECT_EQ(filter->process(model::RangeSample{0.9, 1, 11, 15.0}).outcome, RangeOutcome::kOutOfOrder);
  const RangeResult gated = filter->process(model::RangeSample{1.1, 1, 11, 500.0});
  EXPECT_EQ(gated.outcome, RangeOutcome::kGated);
  const double expected_m = 500.0 - gated.innovation_m;
  const RangeResult used = filter->process(model::RangeSample{1.2, 1, 11, expected_m});
  EXPECT_EQ(used.outcome, RangeOutcome::kUsed);
  EXPECT_NEAR(used.nis, used.innovation_m * used.innovation_m / used.innovation_variance_m2, 1e-12);
  EXPECT_GT(used.weight, 0.0);

  EXPECT_EQ(filter->process(model::OdometrySample{1.3, 1.0, 0.0, 0.0}), OdometryOutcome::kUsed);
  EXPECT_EQ(filter->process(model::OdometrySample{1.3, 1.0, 0.0, 0.0}), OdometryOutcome::kOutOfOrder);
  EXPECT_EQ(filter->process(model::OdometrySample{1.2, 1.0, 0.0, 0.0}), OdometryOutcome::kOutOfOrder);
  EXPECT_EQ(filter->process(model::OdometrySample{1.4, testing::kNan, 0.0, 0.0}), OdometryOutcome::kBadValue);
  EXPECT_EQ(filter->process(model::OdometrySample{testing::kInfinity, 1.0, 0.0, 0.0}),
            OdometryOutcome::kBadValue);
  filter->process(model::RangeSample{1.5, 1, 11, expected_m});
  EXPECT_EQ(filter->process(model::OdometrySample{1.45, 1.0, 0.0, 0.0}), OdometryOutcome::kUsedLate);
  EXPECT_EQ(filter->estimate().t_s, 1.5);

  const Counters& counters = filter->counters();
  EXPECT_EQ(counters.ranges[RangeOutcome::kNotStarted], 1U);
  EXPECT_EQ(counters.ranges[RangeOutcome::kUnknownTag], 1U);
  EXPECT_EQ(counters.ranges[RangeOutcome::kUnknownAnchor], 1U);
  EXPECT_EQ(counters.ranges[RangeOutcome::kBadValue], 7U);
  EXPECT_EQ(counters.ranges[RangeOutcome::kOutOfOrder], 1U);
  EXPECT_EQ(counters.ranges[RangeOutcome::kUsed] + counters.ranges[RangeOutcome::kGated], 3U);
  EXPECT_EQ(counters.odometry[OdometryOutcome::kUsed], 1U);
  EXPECT_EQ(counters.odometry[OdometryOutcome::kUsedLate], 1U);
  EXPECT_EQ(counters.odometry[OdometryOutcome::kStored], 1U);
  EXPECT_EQ(counters.odometry[OdometryOutcome::kOutOfOrder], 2U);
  EXPECT_EQ(counters.odometry[OdometryOutcome::kBadValue], 2U);
}

TEST(Filter, RefusesPairsThatTheCalibrationLacks) {
  const std::vector<model::Tag> tags = testing::three_tags();
  const model::Calibration calibration =
      model::surveyed_calibration(std::vector<model::Anchor>{{11, {-12.0, -11.0, 2.5}}},
                                  std::vector<model::Tag>{tags[0], tags[2]}, {}, 0.1);
  Filter filter(model::Surface(), tags, calibration, testing::config_of(Model::kSchmidt));
  filter.start({});
  EXPECT_EQ(filter.process(model::RangeSample{0.1, 2, 11, 16.0}).outcome, RangeOutcome::kUnknownAnchor);
  EXPECT_EQ(filter.process(model::RangeSample{0.1, 3, 11, 16.0}).outcome, RangeOutcome::kUsed);
}

TEST(Filter, ReportsTheLikelihoodRatioOfARangesPowers) {
  const auto filter = make_filter(Model::kJoint);
  filter->process(model::OdometrySample{0.0, 0.0, 0.0, 0.0});
  filter->start({.t_s = 0.0});
  model::RangeSample range{0.1, 1, 11, 15.0};
  const RangeResult unknown = filter->process(range);
  EXPECT_EQ(unknown.hint_ratio, 1.0) << "it has no powers";

  // The first path is 11 dB below the total power: by the chip's figures NLOS by 0.3/0.05.
  range.t_s = 0.5;
  range.range_m -= unknown.innovation_m;
  range.first_path_power_dbm = -90.0F;
  range.receive_power_dbm = -79.0F;
  const RangeResult hidden = filter->process(range);
  EXPECT_NEAR(hidden.hint_ratio, 6.0, 1e-12);
  // The range fitted, so its class hints less at NLOS afterwards.
  range.t_s = 1.0;
  EXPECT_LT(filter->process(range).hint_ratio, hidden.hint_ratio);
  // Only 2 dB below: 0.4/0.8.
  range.receive_power_dbm = -88.0F;
  EXPECT_NEAR(filter->process(range).hint_ratio, 0.5, 0.1);

  Config config = testing::config_of(Model::kJoint);
  config.gate.hint_most = 1.0;
  Filter unhinted(testing::hills(0.2), testing::three_tags(), testing::six_anchors(), config);
  unhinted.start({.t_s = 0.0});
  EXPECT_EQ(unhinted.process(range).hint_ratio, 1.0) << "powers are not used";
}

TEST(Filter, ARefusedInputChangesNothing) {
  const auto filter = make_filter(Model::kJoint);
  filter->process(model::OdometrySample{0.0, 1.0, 0.0, 0.1});
  filter->start({.t_s = 0.0});
  const CoreVector core = filter->core();
  const CoreMatrix covariance = filter->covariance().core();
  filter->process(model::RangeSample{0.5, 1, 11, testing::kNan});
  filter->process(model::RangeSample{0.5, 7, 11, 10.0});
  filter->process(model::RangeSample{-0.5, 1, 11, 10.0});
  filter->process(model::OdometrySample{0.5, 1.0, testing::kNan, 0.1});
  EXPECT_FALSE(filter->advance_to(testing::kNan));
  EXPECT_FALSE(filter->advance_to(-1.0));
  EXPECT_FALSE(filter->advance_to(0.0));
  EXPECT_EQ(filter->core(), core);
  EXPECT_EQ(filter->covariance().core(), covariance);
  EXPECT_EQ(filter->estimate().t_s, 0.0);
}

TEST(Filter, KeepsTheHeadingWithinHalfATurnOnACircle) {
  const auto filter = make_filter(Model::kSchmidt);
  filter->start({.t_s = 0.0});
  for (int i = 1; i <= 200; ++i) {
    filter->process(model::OdometrySample{0.1 * i, 0.0, 0.0, 1.0});
    EXPECT_LE(std::abs(filter->estimate().pose.theta_rad), std::numbers::pi) << i;
  }
}

// Heading variance that a quarter turn adds, at a rate of samples.
double turn_variance_rad2(double sigma_curve, double interval_s) {
  Config config = testing::config_of(Model::kSchmidt);
  config.odometry.sigma_curve = sigma_curve;
  Filter filter(testing::hills(0.0), testing::three_tags(), testing::six_anchors(), config);
  filter.start({.t_s = 0.0});
  constexpr double kOmega_radps = 0.35;
  constexpr double kDuration_s = 4.5;
  for (int i = 0; i * interval_s < kDuration_s; ++i)
    filter.process(model::OdometrySample{interval_s * i, 1.0, 0.0, kOmega_radps});
  return filter.estimate().covariance(2, 2);
}

TEST(Filter, AWrongWheelbaseAddsToTheHeadingInACurveAtAnyRate) {
  constexpr double kSigma = 0.03;
  const double expected_rad = kSigma * 0.35 * 4.5;
  for (const double interval_s : {0.02, 0.1}) {
    const double added_rad2 = turn_variance_rad2(kSigma, interval_s) - turn_variance_rad2(0.0, interval_s);
    EXPECT_NEAR(std::sqrt(added_rad2), expected_rad, 0.1 * expected_rad) << interval_s;
  }
}

TEST(Filter, SeveralStepsWithinAnOdometrySampleEqualOneStep) {
  const model::Surface flat;
  const auto once = make_filter(Model::kSchmidt, flat);
  const auto often = make_filter(Model::kSchmidt, flat);
  for (const auto& filter : {once.get(), often.get()}) {
    filter->process(model::OdometrySample{0.0, 1.3, 0.2, 0.4});
    filter->start({.t_s = 0.0, .pose = {1.0, 2.0, 0.3}});
  }
  once->advance_to(0.04);
  for (int i = 1; i <= 8; ++i) often->advance_to(0.005 * i);
  EXPECT_LT((once->core() - often->core()).cwiseAbs().maxCoeff(), 1e-12);
  // The covariances agree up to rounding.
  EXPECT_LT((once->covariance().core() - often->covariance().core()).cwiseAbs().maxCoeff(), 1e-9);
  // The odometry noise is one draw held over 0.04 s, not eight independent draws.
  EXPECT_NEAR(often->estimate().covariance(0, 0) - 0.01,
              std::pow(0.04 * 0.03, 2) + std::pow(0.04 * 1.3 * 0.01, 2) + 0.0025 * std::pow(0.04 * 0.62, 2),
              2e-6);
}

TEST(Filter, DeadReckoningIsConsistentOverManyDrives) {
  const model::Surface surface = testing::hills(0.2);
  const model::PlanarPose start{1.0, -2.0, 0.4};
  Random random(61);
  constexpr int kDrives = 400;
  double sum = 0.0;
  Eigen::Matrix3d scatter = Eigen::Matrix3d::Zero();
  Eigen::Matrix3d stated = Eigen::Matrix3d::Zero();
  for (int i = 0; i < kDrives; ++i) {
    const testing::Drive drive =
        testing::drive(surface, testing::six_anchors(), start, {.duration_s = 6.0}, random);
    const auto filter = make_filter(Model::kOdometry, surface);
    filter->process(drive.odometry.front());
    filter->start({.t_s = 0.0,
                   .pose = {start.x_m + 0.1 * random.gaussian(), start.y_m + 0.1 * random.gaussian(),
                            start.theta_rad + 0.05 * random.gaussian()}});
    for (std::size_t row = 1; row < drive.odometry.size(); ++row) filter->process(drive.odometry[row]);
    const Estimate estimate = filter->estimate();
    const model::PlanarPose& truth = drive.truth.back();
    sum += testing::squared_error(estimate, truth);
    const Eigen::Vector3d e(estimate.pose.x_m - truth.x_m, estimate.pose.y_m - truth.y_m,
                            model::wrap_angle(estimate.pose.theta_rad - truth.theta_rad));
    scatter += e * e.transpose() / kDrives;
    stated += estimate.covariance / kDrives;
  }
  // Chi-square of 3 * 400 degrees of freedom: 4 sigmas.
  EXPECT_NEAR(sum / (3.0 * kDrives), 1.0, 4.0 * std::sqrt(2.0 / (3.0 * kDrives)));
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(scatter(i, i) / stated(i, i), 1.0, 4.0 * std::sqrt(2.0 / kDrives));
}

// With the noise of wheels, which dominates, and without, so that scale and bias do. The noise is as
// configured: its estimate from the 60 samples of a drive is itself uncertain.
TEST(Filter, VelocityIsConsistentOverManyDrives) {
  const model::Surface surface = testing::hills(0.2);
  constexpr int kDrives = 200;
  for (const double noise : {1.0, 0.02}) {
    Random random(66);
    Eigen::Matrix3d scatter = Eigen::Matrix3d::Zero();
    Eigen::Matrix3d stated = Eigen::Matrix3d::Zero();
    double sum = 0.0;
    Config config = testing::config_of(Model::kSchmidt);
    config.odometry = {0.03 * noise, 0.03 * noise, 0.01 * noise};
    config.tunes_noise = false;
    for (int i = 0; i < kDrives; ++i) {
      const testing::Drive drive =
          testing::drive(surface, testing::six_anchors(), {},
                         {.duration_s = 3.0, .range_s = 0.1, .noise = config.odometry}, random);
      const auto filter =
          std::make_unique<Filter>(surface, testing::three_tags(), testing::six_anchors(), config);
      EXPECT_FALSE(filter->estimate().velocity.allFinite()) << "no odometry yet";
      filter->process(drive.odometry.front());
      filter->start(
          {.t_s = 0.0, .pose = {0.1 * random.gaussian(), 0.1 * random.gaussian(), 0.05 * random.gaussian()}});
      Feeder(drive).until(3.0, *filter);
      const Estimate estimate = filter->estimate();
      const Eigen::Vector3d e = estimate.velocity - testing::true_velocity(drive.odometry.back().t_s);
      scatter += e * e.transpose() / kDrives;
      stated += estimate.velocity_covariance / kDrives;
      sum += e.dot(estimate.velocity_covariance.inverse() * e);
    }
    EXPECT_NEAR(sum / (3.0 * kDrives), 1.0, 4.0 * std::sqrt(2.0 / (3.0 * kDrives))) << noise;
    for (int i = 0; i < 3; ++i)
      EXPECT_NEAR(scatter(i, i) / stated(i, i), 1.0, 4.0 * std::sqrt(2.0 / kDrives)) << noise;
  }
}

class Consistency : public ::testing::TestWithParam<Model> {};
INSTANTIATE_TEST_SUITE_P(Filter, Consistency,
                         ::testing::Values(Model::kSchmidt, Model::kAnchorStates, Model::kJoint),
                         [](const ::testing::TestParamInfo<Model>& model) {
                           std::string name(model_name(model.param));
                           std::erase(name, '-');
                           return name;
                         });

// Mean NEES over many sites, one instant each, and the number within the 95 % bound. All ranges are used.
struct Nees {
  double mean = 0.0;
  int inside = 0;
};

Nees nees_over_sites(int sites, const model::Calibration& calibration, const model::Calibration& given,
                     const Config& config, Random& random) {
  const model::Surface surface = testing::hills(0.2);
  const model::PlanarPose start{1.0, -2.0, 0.4};
  double sum = 0.0;
  int inside = 0;
  double nis = 0.0;
  for (int i = 0; i < sites; ++i) {
    const testing::Drive drive =
        testing::drive(surface, calibration, start, {.duration_s = 15.0, .range_s = 0.02}, random);
    const auto filter = std::make_unique<Filter>(surface, testing::three_tags(), given, config);
    filter->process(drive.odometry.front());
    filter->start({.t_s = 0.0,
                   .pose = {start.x_m + 0.1 * random.gaussian(), start.y_m + 0.1 * random.gaussian(),
                            start.theta_rad + 0.05 * random.gaussian()}});
    Feeder feeder(drive);
    // Only one instant, because errors are nearly constant within a site.
    const std::size_t instant = 40 + static_cast<std::size_t>(random.uniform(0.0, 259.0));
    feeder.until(drive.odometry[instant].t_s, *filter);
    const RangeResult last = filter->process(model::RangeSample{drive.odometry[instant].t_s, 1, 11, 1.0});
    EXPECT_EQ(last.outcome, RangeOutcome::kGated);
    const double error = testing::squared_error(filter->estimate(), drive.truth[instant]);
    sum += error;
    inside += error <= 7.815 ? 1 : 0;
    nis += static_cast<double>(filter->counters().ranges[RangeOutcome::kGated]);
  }
  EXPECT_LE(nis, 5.0 * sites);
  return {sum / (3.0 * sites), inside};
}

TEST_P(Consistency, HoldsOverManySites) {
  constexpr int kSites = 120;
  Random random(62);
  const model::Calibration calibration = testing::six_anchors();
  const Nees nees = nees_over_sites(kSites, calibration, calibration, testing::config_of(GetParam()), random);
  // Chi-square of 360 degrees of freedom, 4 sigmas; binomial for the share.
  EXPECT_NEAR(nees.mean, 1.0, 4.0 * std::sqrt(2.0 / (3.0 * kSites)));
  EXPECT_GE(nees.inside, 105);
}

TEST_P(Consistency, HoldsWithASlowRangeBiasOverManySites) {
  constexpr int kSites = 120;
  model::Calibration calibration = testing::six_anchors(0.3);
  calibration.range_noise = {.white_sigma_m = 0.05, .bias_sigma_m = 0.15, .bias_length_m = 4.0};
  Config config = testing::config_of(GetParam());
  config.range_bias_growth = 1.0;
  // Keep the configured noise.
  config.tunes_noise = false;
  Random random(67);
  const Nees nees = nees_over_sites(kSites, calibration, calibration, config, random);
  EXPECT_NEAR(nees.mean, 1.0, 4.0 * std::sqrt(2.0 / (3.0 * kSites)));
  EXPECT_GE(nees.inside, 105);
  // Modelled as white noise of that size, the slow range bias seems to average out: overconfident.
  model::Calibration white = calibration;
  white.range_noise = {.white_sigma_m = std::hypot(0.05, 0.15), .bias_sigma_m = 0.0, .bias_length_m = 1.0};
  Random again(67);
  EXPECT_GT(nees_over_sites(kSites, calibration, white, config, again).mean, 1.5);
}

// Variance of the position after 400 ranges without error, in 20 s, in a circle at this speed.
double position_variance_m2(double speed_mps) {
  const model::Surface flat;
  model::Calibration calibration = testing::six_anchors(0.01);
  calibration.range_noise = {.white_sigma_m = 0.05, .bias_sigma_m = 0.1, .bias_length_m = 0.3};
  Config config = testing::config_of(Model::kSchmidt);
  config.tunes_noise = false;
  const std::vector<model::Tag> tags = testing::three_tags();
  const auto filter = std::make_unique<Filter>(flat, tags, calibration, config);
  const Eigen::Vector3d velocity(speed_mps, 0.0, 0.5 * speed_mps);
  model::PlanarPose at{1.0, -2.0, 0.4};
  for (int i = 0; i < 400; ++i) {
    const double t_s = 0.05 * i;
    filter->process(model::OdometrySample{t_s, velocity.x(), velocity.y(), velocity.z()});
    if (i == 0) filter->start({.t_s = 0.0, .pose = at, .position_sigma_m = 0.3, .heading_sigma_rad = 0.1});
    const model::AnchorCalibration& anchor = calibration.anchors[static_cast<std::size_t>(i) % 6];
    const int slot = i / 6 % 3;
    const model::Tag& tag = tags[static_cast<std::size_t>(slot)];
    const auto prediction =
        model::predict_range(model::pose_on_surface(flat, at).pose, tag.lever_arm_m, anchor.position_m,
                             model::terms_of(model::values_of(anchor), slot, 3));
    filter->process(model::RangeSample{t_s, tag.id, anchor.id, prediction.range_m});
    at = testing::integrate(flat, at, velocity, 0.05, 2);
  }
  return filter->estimate().covariance.topLeftCorner<2, 2>().trace();
}

TEST(Filter, ARobotThatStandsDoesNotAverageTheSlowRangeBiasOut) {
  EXPECT_GT(position_variance_m2(0.0), 2.0 * position_variance_m2(1.0));
}

TEST(Filter, WithoutCrossCovariancesItIsOverconfident) {
  // The inflated model on the same sites, as a contrast to the consider filter.
  const model::Surface surface = testing::hills(0.2);
  const model::PlanarPose start{1.0, -2.0, 0.4};
  Random random(63);
  double sum = 0.0;
  for (int i = 0; i < 20; ++i) {
    const testing::Drive drive =
        testing::drive(surface, testing::six_anchors(), start, {.duration_s = 15.0, .range_s = 0.02}, random);
    const auto filter = make_filter(Model::kInflated, surface);
    filter->process(drive.odometry.front());
    filter->start({.t_s = 0.0, .pose = start});
    Feeder(drive).until(drive.odometry.back().t_s, *filter);
    filter->advance_to(drive.odometry.back().t_s);
    sum += testing::squared_error(filter->estimate(), drive.truth.back());
  }
  EXPECT_GT(sum / 60.0, 2.0);
}

TEST(Filter, RecoversAfterItWasCarriedAway) {
  const model::Surface surface = testing::hills(0.2);
  const model::PlanarPose start{1.0, -2.0, 0.4};
  Random random(64);
  const testing::Drive drive = testing::drive(surface, testing::six_anchors(0.3), start,
                                              {.duration_s = 30.0, .range_s = 0.005}, random);
  for (const Model model : {Model::kSchmidt, Model::kInflated}) {
    const auto filter = std::make_unique<Filter>(surface, testing::three_tags(), testing::six_anchors(0.3),
                                                 testing::config_of(model));
    filter->process(drive.odometry.front());
    filter->start({.t_s = 0.0, .pose = start});
    Feeder feeder(drive);
    feeder.until(5.0, *filter);
    // 3 m off, with a small covariance.
    const Estimate estimate = filter->estimate();
    filter->start({.t_s = estimate.t_s,
                   .pose = {estimate.pose.x_m + 2.5, estimate.pose.y_m - 1.7, estimate.pose.theta_rad + 0.2},
                   .position_sigma_m = 0.05,
                   .heading_sigma_rad = 0.02});
    feeder.until(7.0, *filter);
    EXPECT_GE(filter->counters().divergences, 1U);
    feeder.until(20.0, *filter);
    const std::size_t row = 399;
    EXPECT_NEAR(filter->estimate().t_s, drive.odometry[row].t_s, 0.06);
    EXPECT_LT(std::hypot(filter->estimate().pose.x_m - drive.truth[row].x_m,
                         filter->estimate().pose.y_m - drive.truth[row].y_m),
              0.3)
        << model_name(model);
  }
}

TEST(Filter, TrustsOverdueOdometryLessAndLess) {
  const auto filter = make_filter(Model::kOdometry, model::Surface());
  filter->process(model::OdometrySample{0.0, 1.0, 0.0, 0.0});
  filter->start({.t_s = 0.0, .position_sigma_m = 0.01});
  filter->advance_to(0.5);
  EXPECT_NEAR(filter->estimate().pose.x_m, 0.5, 1e-12);
  EXPECT_LT(filter->estimate().covariance(0, 0), std::pow(0.03, 2));
  filter->advance_to(3.5);
  // A velocity random walk of 1 m/s per sqrt(s) over 3 s: position variance 3^3 / 3.
  EXPECT_NEAR(filter->estimate().covariance(0, 0), 9.0, 0.3);
  // A jump in time takes bounded work and gives finite numbers.
  filter->advance_to(1e9);
  EXPECT_TRUE(filter->core().allFinite());
  EXPECT_TRUE(filter->covariance().core().allFinite());
}

// A drive whose odometry is zero for three seconds and later jumps once; with a gyro from `gyro_s` on.
std::vector<MotionInput> motion_of(const testing::Drive& drive, double gyro_s) {
  std::vector<MotionInput> inputs;
  for (model::OdometrySample row : drive.odometry) {
    if (row.t_s > 3.0 && row.t_s < 6.0) row.vx_mps = row.vy_mps = row.omega_radps = 0.0;
    if (std::abs(row.t_s - 7.0) < 0.01) row.vx_mps += 5.0;
    inputs.emplace_back(row);
    if (row.t_s >= gyro_s) inputs.emplace_back(model::YawRateSample{row.t_s + 0.01, row.omega_radps + 0.002});
  }
  return inputs;
}

double instant_of(const MotionInput& input) {
  return std::visit([](const auto& of) { return of.t_s; }, input);
}

// The reference processes the inputs over which the filter only predicts.
TEST_P(EveryModel, PredictionEqualsProcessingTheSameInputs) {
  constexpr double kAhead_s = 0.2;
  std::vector<model::Chart> charts = testing::hills(0.2).charts();
  charts.front().mismatch = {.sigma_m = 0.02, .slope_sigma = 0.01, .length_m = 3.0};
  const model::Surface surface(std::move(charts));
  Random random(21);
  const testing::Drive drive =
      testing::drive(surface, testing::six_anchors(), {}, {.duration_s = 10.0, .range_s = 0.01}, random);
  const std::vector<MotionInput> motion = motion_of(drive, 7.5);
  Config config = testing::config_of(GetParam());
  config.range_delay_sigma_s = 0.02;
  config.odometry_delay_sigma_s = 0.02;  // so that the present pose differs from the core's
  for (double horizon_s = 0.5; horizon_s < 9.7; horizon_s += 0.37) {
    const auto made = [&] {
      auto filter = std::make_unique<Filter>(surface, testing::three_tags(), testing::six_anchors(), config);
      filter->start({});
      return filter;
    };
    const std::unique_ptr<Filter> filter = made();
    const std::unique_ptr<Filter> reference = made();
    std::vector<MotionInput> ahead;
    std::size_t range = 0;
    for (const MotionInput& input : motion) {
      if (instant_of(input) > horizon_s + kAhead_s) break;
      const double until_s = std::min(instant_of(input), horizon_s);
      for (; range < drive.ranges.size() && drive.ranges[range].t_s < until_s; ++range) {
        // No ranges while odometry is zero, because the simulated robot drives on. The first ones afterwards
        // make the gate suspect divergence.
        if (drive.ranges[range].t_s > 3.0 && drive.ranges[range].t_s < 6.0) continue;
        filter->process(drive.ranges[range]);
        reference->process(drive.ranges[range]);
      }
      std::visit([&](const auto& of) { reference->process(of); }, input);
      if (instant_of(input) > horizon_s) {
        ahead.push_back(input);
      } else {
        std::visit([&](const auto& of) { filter->process(of); }, input);
      }
    }
    ASSERT_GE(ahead.size(), 3U);
    const Eigen::MatrixXd before = testing::whole(*filter);
    const Estimate predicted = testing::predict(*filter, ahead);
    const Estimate expected = reference->estimate();
    EXPECT_EQ(predicted.t_s, expected.t_s);
    EXPECT_EQ(predicted.pose.x_m, expected.pose.x_m);
    EXPECT_EQ(predicted.pose.y_m, expected.pose.y_m);
    EXPECT_EQ(predicted.pose.theta_rad, expected.pose.theta_rad);
    EXPECT_EQ(predicted.covariance, expected.covariance) << horizon_s;
    EXPECT_EQ(predicted.yaw_rate_bias_radps, expected.yaw_rate_bias_radps);
    EXPECT_LT((predicted.covariance_with_ground() - expected.covariance_with_ground()).cwiseAbs().maxCoeff(),
              1e-15);
    EXPECT_EQ(testing::whole(*filter), before);
    EXPECT_LE(filter->estimate().t_s, horizon_s);
  }
}

TEST(Filter, PredictionSkipsInputsThatItWouldRefuse) {
  const auto filter = make_filter(Model::kSchmidt);
  filter->process(model::OdometrySample{0.0, 1.0, 0.0, 0.1});
  filter->start({});
  const std::vector<MotionInput> good{model::OdometrySample{0.05, 1.0, 0.0, 0.1},
                                      model::YawRateSample{0.06, 0.1},
                                      model::OdometrySample{0.1, 1.1, 0.0, 0.1}};
  const std::vector<MotionInput> all{model::OdometrySample{-1.0, 9.0, 0.0, 0.0},
                                     model::YawRateSample{-0.5, 9.0},
                                     good[0],
                                     model::OdometrySample{0.05, 9.0, 0.0, 0.0},
                                     model::OdometrySample{0.06, testing::kNan, 0.0, 0.0},
                                     good[1],
                                     model::YawRateSample{0.06, testing::kNan},
                                     model::YawRateSample{testing::kNan, 0.0},
                                     model::YawRateSample{std::numeric_limits<double>::infinity(), 0.1},
                                     model::YawRateSample{0.06, 90.0},
                                     good[2]};
  const Estimate expected = testing::predict(*filter, good);
  const Estimate predicted = testing::predict(*filter, all);
  EXPECT_EQ(predicted.t_s, 0.1);
  EXPECT_NEAR(predicted.pose.x_m, expected.pose.x_m, 1e-12);
  EXPECT_NEAR(predicted.pose.theta_rad, expected.pose.theta_rad, 1e-12);
  EXPECT_LT((predicted.covariance - expected.covariance).cwiseAbs().maxCoeff(), 1e-12);
  EXPECT_EQ(testing::predict(*filter, {}).covariance, filter->estimate().covariance);
}

TEST_P(EveryModel, ResumesAnotherFilter) {
  Random random(23);
  const testing::Drive drive = testing::drive(testing::hills(0.2), testing::six_anchors(), {},
                                              {.duration_s = 20.0, .range_s = 0.01}, random);
  const auto before = make_filter(GetParam());
  before->start({});
  Feeder feeder(drive);
  feeder.until(15.0, *before);
  model::Calibration other = testing::six_anchors();
  other.anchors.pop_back();
  Filter after(testing::hills(0.2), testing::three_tags(), other, testing::config_of(GetParam()));
  after.resume(*before);
  EXPECT_TRUE(after.started());
  EXPECT_EQ(after.anchors(), 5U);
  EXPECT_EQ(after.core(), before->core());
  EXPECT_EQ(after.covariance().core(), before->covariance().core());
  EXPECT_EQ(after.covariance().cross(), Eigen::MatrixXd::Zero(after.parameters().size(), kCoreSize));
  EXPECT_EQ(after.estimate().t_s, before->estimate().t_s);
  // Predictions by odometry only are equal.
  const std::vector<MotionInput> row{model::OdometrySample{15.05, 1.0, 0.0, 0.1}};
  EXPECT_EQ(testing::predict(after, row).covariance, testing::predict(*before, row).covariance);
  const double end_s = drive.odometry.back().t_s;
  feeder.until(end_s, after);
  after.advance_to(end_s);
  if (GetParam() != Model::kSchmidt && GetParam() != Model::kJoint) return;
  EXPECT_LT(testing::squared_error(after.estimate(), drive.truth.back()), 16.27);  // 99.9 % of chi-square
}

TEST_P(EveryModel, NeverAllocatesAfterConstruction) {
  const model::Surface surface = testing::hills(0.2);
  Random random(65);
  const testing::Drive drive = testing::drive(surface, testing::six_anchors(), {1.0, -2.0, 0.4},
                                              {.duration_s = 2.0, .range_s = 0.01}, random);
  const auto filter = make_filter(GetParam(), surface);
  Feeder feeder(drive);
  const std::size_t before = test::allocations();
  filter->process(drive.odometry.front());
  filter->start({.t_s = 0.0, .pose = {1.0, -2.0, 0.4}});
  feeder.until(2.0, *filter);
  filter->process(model::RangeSample{2.0, 1, 11, 1e9});
  const std::array<MotionInput, 2> ahead{model::OdometrySample{2.05, 1.0, 0.0, 0.1},
                                         model::YawRateSample{2.06, 0.1}};
  static_cast<void>(filter->estimate());
  static_cast<void>(testing::predict(*filter, ahead));
  EXPECT_EQ(test::allocations(), before);
  EXPECT_GT(
      filter->counters().ranges[RangeOutcome::kUsed] + filter->counters().ranges[RangeOutcome::kNotModelled],
      150U);
}

class Enduring : public ::testing::TestWithParam<Model> {};
INSTANTIATE_TEST_SUITE_P(Filter, Enduring, ::testing::Values(Model::kSchmidt, Model::kJoint),
                         [](const ::testing::TestParamInfo<Model>& model) {
                           return std::string(model_name(model.param));
                         });

// The long tests do ten million updates.
TEST_P(Enduring, StaysPositiveInAllConditions) {
  for (const double white_sigma_m : {1e-4, 0.1})
    EXPECT_GT(testing::endure(GetParam(), 200'000, white_sigma_m, 93), -1e-12) << white_sigma_m;
}

TEST_P(EveryModel, StaysSymmetricAndPositiveOverALongRun) {
  const model::Surface surface = testing::hills(0.2);
  Random random(66);
  const testing::Drive drive = testing::drive(surface, testing::six_anchors(), {1.0, -2.0, 0.4},
                                              {.duration_s = 200.0, .range_s = 0.005}, random);
  const auto filter = make_filter(GetParam(), surface);
  filter->process(drive.odometry.front());
  filter->start({.t_s = 0.0, .pose = {1.0, -2.0, 0.4}});
  Feeder(drive).until(200.0, *filter);
  Eigen::MatrixXd p = testing::whole(*filter);
  EXPECT_LT((p - p.transpose()).cwiseAbs().maxCoeff(), 1e-13);
  // The smallest eigenvalue of the correlation matrix. The delay, the slow range biases and the ground's
  // deviation have zero variance here.
  Eigen::VectorXd scale = p.diagonal().cwiseSqrt();
  EXPECT_EQ(scale(kDelay), 0.0);
  EXPECT_EQ((scale.array() == 0.0).count(), 1 + static_cast<Eigen::Index>(filter->anchors()) + kGroundSize);
  for (Eigen::Index i = 0; i < scale.size(); ++i) {
    if (scale(i) != 0.0) continue;
    scale(i) = 1.0;
    p(i, i) = 1.0;
  }
  const Eigen::MatrixXd correlation =
      scale.cwiseInverse().asDiagonal() * p * scale.cwiseInverse().asDiagonal();
  EXPECT_GT(Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(correlation).eigenvalues().minCoeff(), -1e-12);
  const Eigen::Matrix3d pose = filter->estimate().covariance;
  EXPECT_GT(Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(pose).eigenvalues().minCoeff(), 0.0);
}

}  // namespace
}  // namespace groma::filter
