// Errors beyond the noise models: link delays, faulty odometry, and pairs that answer again after NLOS.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <string>
#include <vector>

#include <Eigen/Cholesky>

#include "host/filter/dead_reckoning.hpp"
#include "host/filter/filter.hpp"
#include "host/filter/gate.hpp"
#include "host/filter/odometry_gate.hpp"
#include "host/filter/range_measurement.hpp"
#include "host/filter/self_tuning.hpp"
#include "test/host/filter/small_site.hpp"

namespace groma::filter {
namespace {

using test::Random;

TEST(LinkDelays, SeparateTheDifferenceAsGaussiansDo) {
  const LinkDelays delays{.range_s = 0.02, .range_sigma_s = 0.004, .odometry_sigma_s = 0.015};
  // Posterior of (range delay, odometry delay) given their difference.
  const Eigen::Matrix2d prior = Eigen::Vector2d(0.004 * 0.004, 0.015 * 0.015).asDiagonal();
  const Eigen::RowVector2d h(1.0, -1.0);
  const double s = h * prior * h.transpose();
  const Eigen::Vector2d gain = prior * h.transpose() / s;
  const Eigen::Matrix2d posterior = prior - gain * h * prior;
  const double difference_s = -0.012;
  const Eigen::Vector2d mean = Eigen::Vector2d(0.02, 0.0) + gain * (difference_s - 0.02);
  EXPECT_NEAR(delays.difference_variance_s2(), s, 1e-15);
  EXPECT_NEAR(delays.odometry_s(difference_s), mean(1), 1e-15);
  EXPECT_NEAR(delays.odometry_s(difference_s) + difference_s, mean(0), 1e-15);
  EXPECT_NEAR(delays.odometry_variance_s2(), posterior(1, 1), 1e-15);
  EXPECT_EQ((LinkDelays{.range_s = 0.02}).odometry_s(0.01), 0.0);
}

// What the odometry delay leaves unknown is an error along the motion.
TEST(LinkDelays, TheirUncertaintyIsInThePresentPose) {
  const LinkDelays delays{.range_s = 0.02, .range_sigma_s = 0.004, .odometry_sigma_s = 0.015};
  CoreVector core = CoreVector::Zero();
  core(kTheta) = 0.3;
  core(kDelay) = delays.range_s;
  const PresentPose present = present_pose(model::Surface(), core, {0.0, 2.0, 0.5, 0.4}, delays);
  const double variance_s2 = 1.0 / (1.0 / (0.004 * 0.004) + 1.0 / (0.015 * 0.015));
  const Eigen::Vector3d rate(2.0 * std::cos(0.3) - 0.5 * std::sin(0.3),
                             2.0 * std::sin(0.3) + 0.5 * std::cos(0.3), 0.4);
  EXPECT_LT((present.noise - variance_s2 * rate * rate.transpose()).cwiseAbs().maxCoeff(), 1e-15);
}

struct Errors {
  double mean_m = 0.0;
  double max_m = 0.0;
  double nees = 0.0;
  std::unique_ptr<Filter> filter;
};

// Runs the filter from the true start; errors from from_s on.
Errors replay(const model::Surface& surface, const model::Calibration& calibration, const Config& config,
              const testing::Drive& drive, double from_s = 0.0) {
  Errors out;
  out.filter = std::make_unique<Filter>(surface, testing::three_tags(), calibration, config);
  std::size_t next = 0;
  double count = 0.0;
  for (std::size_t i = 0; i < drive.odometry.size(); ++i) {
    for (; next < drive.ranges.size() && drive.ranges[next].t_s < drive.odometry[i].t_s; ++next)
      out.filter->process(drive.ranges[next]);
    out.filter->process(drive.odometry[i]);
    if (i == 0) out.filter->start({.t_s = drive.odometry[0].t_s, .pose = drive.truth[0]});
    if (drive.odometry[i].t_s < from_s) continue;
    const Estimate estimate = out.filter->estimate();
    const double error_m =
        std::hypot(estimate.pose.x_m - drive.truth[i].x_m, estimate.pose.y_m - drive.truth[i].y_m);
    out.mean_m += error_m;
    out.max_m = std::max(out.max_m, error_m);
    out.nees += testing::squared_error(estimate, drive.truth[i]) / 3.0;
    count += 1.0;
  }
  out.mean_m /= count;
  out.nees /= count;
  return out;
}

Config matching_config() {
  Config config;
  config.odometry = {0.03, 0.03, 0.01};
  return config;
}

TEST(LateLinks, DelaysOfOdometryAndRangesAreEstimatedSeparately) {
  const model::Surface flat;
  model::Calibration calibration = testing::six_anchors(0.1);
  calibration.range_delay_s = 0.06;
  calibration.range_delay_sigma_s = 0.002;
  Random random(5);
  testing::Drive drive =
      testing::drive(flat, calibration, {0.0, 0.0, 0.2}, {.duration_s = 120.0, .range_s = 0.02}, random);
  // Odometry is late by two samples, ranges by their delay; the truth is on time.
  for (model::RangeSample& range : drive.ranges) range.t_s += calibration.range_delay_s;
  for (std::size_t i = drive.odometry.size(); i-- > 2;) {
    const double t_s = drive.odometry[i].t_s;
    drive.odometry[i] = drive.odometry[i - 2];
    drive.odometry[i].t_s = t_s;
  }
  Config exact = matching_config();
  Config open = exact;
  open.odometry_delay_sigma_s = 0.05;
  const Errors without = replay(flat, calibration, exact, drive, 30.0);
  const Errors with = replay(flat, calibration, open, drive, 30.0);
  EXPECT_NEAR(with.filter->estimate().odometry_delay_s, 0.1, 0.02);
  EXPECT_NEAR(with.filter->estimate().range_delay_s, 0.06, 0.01);
  EXPECT_LT(with.mean_m, 0.7 * without.mean_m);
  EXPECT_LT(with.nees, 2.0);
}

TEST(OdometryWatch, InflatesImpossibleAccelerations) {
  const Config config;
  const model::OdometryNoise noise{0.03, 0.03, 0.01};
  OdometryWatch watch(config.max_acceleration_mps2);
  const model::OdometrySample before{1.0, 2.0, 0.0, 0.1};
  const OdometryInflation none = watch.judge(before, {1.05, 2.3, 0.05, 0.4}, noise);
  EXPECT_EQ(none.velocity_m2ps2, 0.0);
  EXPECT_EQ(none.position_m2, 0.0);
  EXPECT_EQ(none.turn_rad2ps2, 0.0);
  const OdometryInflation jump = watch.judge(before, {1.05, 2.0, 2.0, 0.1}, noise);
  const double excess_mps = 2.0 - config.max_acceleration_mps2 * 0.05 - 6.0 * 0.03;
  EXPECT_NEAR(jump.position_m2, std::pow(0.5 * excess_mps, 2), 1e-12);
  EXPECT_NEAR(jump.velocity_m2ps2, excess_mps * excess_mps * 10.0, 1e-9);
  EXPECT_GT(jump.turn_rad2ps2, 0.0);
  EXPECT_EQ(watch.jumps(), 1U);
  // The inflation decays.
  const OdometryInflation later = watch.judge({1.05, 2.0, 2.0, 0.1}, {3.05, 2.0, 2.0, 0.1}, noise);
  EXPECT_LT(later.velocity_m2ps2, 0.01 * jump.velocity_m2ps2);
  EXPECT_EQ(later.position_m2, 0.0);
}

TEST(OdometryWatch, ADetectedSlipIsInTheCovariance) {
  const model::Surface flat;
  const model::Calibration calibration = testing::six_anchors(0.1);
  Random random(6);
  testing::Drive drive =
      testing::drive(flat, calibration, {0.0, 0.0, 0.2}, {.duration_s = 30.0, .range_s = 0.1}, random);
  // The wheels slip for a second without ranges meanwhile.
  for (model::OdometrySample& row : drive.odometry) {
    if (row.t_s >= 20.0 && row.t_s < 21.0) row.vx_mps += 3.0;
  }
  std::erase_if(drive.ranges, [](const auto& range) { return range.t_s > 20.0 && range.t_s < 22.0; });
  Config blind = matching_config();
  blind.max_acceleration_mps2 = 1e9;
  const Errors without = replay(flat, calibration, blind, drive, 19.0);
  const Errors with = replay(flat, calibration, matching_config(), drive, 19.0);
  EXPECT_GT(without.nees, 20.0);
  EXPECT_LT(with.nees, 4.0);
  EXPECT_LT(with.mean_m, without.mean_m);
}

TEST(OdometryTuning, FindsTheWhiteSigmaOfADrivingRobot) {
  constexpr model::OdometryNoise kTrue{0.03, 0.03, 0.01};
  for (const double factor : {0.12, 1.0 / 3.0, 1.0, 3.0, 8.0}) {
    OdometryTuning tuning(
        {kTrue.sigma_vx_mps * factor, kTrue.sigma_vy_mps * factor, kTrue.sigma_omega_radps * factor});
    Random random(10);
    double velocity_mps = 0.0;
    double turn_radps = 0.0;
    for (int i = 0; i < 6000; ++i) {
      const double t_s = 0.05 * i;
      const Eigen::Vector3d velocity = testing::true_velocity(t_s);
      // vy is not measured, as on most robots.
      tuning.observe({t_s, velocity.x() + kTrue.sigma_vx_mps * random.gaussian(), 0.0,
                      velocity.z() + kTrue.sigma_omega_radps * random.gaussian()});
      if (i < 3000) continue;
      velocity_mps += tuning.noise().sigma_vx_mps / 3000.0;
      turn_radps += tuning.noise().sigma_omega_radps / 3000.0;
    }
    EXPECT_NEAR(velocity_mps, kTrue.sigma_vx_mps, 0.1 * kTrue.sigma_vx_mps) << factor;
    EXPECT_NEAR(turn_radps, kTrue.sigma_omega_radps, 0.1 * kTrue.sigma_omega_radps) << factor;
    EXPECT_EQ(tuning.noise().sigma_vy_mps, tuning.noise().sigma_vx_mps);
  }
}

TEST(OdometryTuning, StaysWithinItsBoundsAndIgnoresSamplesFarApart) {
  OdometryTuning tuning({0.03, 0.03, 0.01});
  Random random(11);
  for (int i = 0; i < 2000; ++i) {
    const double t_s = 0.5 * i;
    tuning.observe({t_s, random.gaussian(), random.gaussian(), random.gaussian()});
  }
  EXPECT_EQ(tuning.noise().sigma_vx_mps, 0.03);
  tuning.reset();
  for (int i = 0; i < 2000; ++i) {
    const double t_s = 1001.0 + 0.05 * i;
    tuning.observe({t_s, random.gaussian(), random.gaussian(), 1e-5 * random.gaussian()});
  }
  EXPECT_NEAR(tuning.noise().sigma_vx_mps, 0.3, 0.003);
  EXPECT_NEAR(tuning.noise().sigma_omega_radps, 0.001, 1e-5);
}

// Eight drives each with the right sigma and with one wrong by a factor of three in both directions, which
// `wrong` applies to the configuration.
template <class Wrong>
void expect_little_cost(double range_s, double most_nees, const Wrong& wrong) {
  const model::Surface flat;
  const model::Calibration site = testing::six_anchors(0.2);
  std::vector<double> errors_m;
  for (const double factor : {1.0, 1.0 / 3.0, 3.0}) {
    double mean_m = 0.0;
    double nees = 0.0;
    for (unsigned seed = 1; seed <= 8; ++seed) {
      Random random(seed);
      const testing::Drive drive =
          testing::drive(flat, site, {0.0, 0.0, 0.2}, {.duration_s = 60.0, .range_s = range_s}, random);
      Config config = matching_config();
      wrong(config, factor);
      const Errors errors = replay(flat, site, config, drive);
      mean_m += errors.mean_m / 8.0;
      nees += errors.nees / 8.0;
    }
    errors_m.push_back(mean_m);
    EXPECT_LT(nees, most_nees) << factor;
  }
  EXPECT_LT(errors_m[1], 1.1 * errors_m[0]);
  EXPECT_LT(errors_m[2], 1.1 * errors_m[0]);
}

TEST(OdometryTuning, ASigmaThatIsWrongByThreeCostsLittleOverManyDrives) {
  expect_little_cost(0.05, 2.0, [](Config& config, double factor) {
    config.odometry = {0.03 * factor, 0.03 * factor, 0.01 * factor};
  });
}

TEST(RangeTuning, FindsTheWhiteSigmaDespiteSlowBiasAndNlos) {
  constexpr double kSigma_m = 0.1;
  for (const double nominal_m : {0.03, 0.1, 0.3}) {
    RangeTuning tuning(nominal_m);
    Random random(9);
    double mean_m = 0.0;
    for (int i = 0; i < 20000; ++i) {
      const double t_s = 0.01 * i;
      const double lasts_m = 0.1 * std::sin(0.3 * t_s);
      const double excess_m = random.uniform() < 0.15 ? 2.0 * random.uniform() : 0.0;
      tuning.observe(i % 6, 0, t_s, lasts_m + excess_m + kSigma_m * random.gaussian(),
                     std::pow(tuning.white_sigma_m(), 2) + 0.005);
      if (i >= 10000) mean_m += tuning.white_sigma_m() / 10000.0;
    }
    EXPECT_NEAR(mean_m, kSigma_m, 0.1 * kSigma_m) << nominal_m;
  }
}

TEST(RangeTuning, DoesNotCompareRangesOfTwoAnchorsInASlot) {
  constexpr double kNominal_m = 0.1;
  RangeTuning tuning(kNominal_m);
  for (int i = 0; i < 100; ++i) {
    tuning.observe(0, 0, 0.1 * i, i % 2 == 0 ? -1.0 : 0.1, 0.01);
    tuning.renew(0);
  }
  EXPECT_EQ(tuning.white_sigma_m(), kNominal_m);
}

TEST(RangeTuning, ASigmaThatIsWrongByThreeCostsLittleOverManyDrives) {
  expect_little_cost(0.01, 2.5, [](Config& config, double factor) { config.range_sigma_m *= factor; });
}

// Feeds a pair with LOS ranges.
void feed(Gate& gate, double from_s, double to_s, double every_s, Random& random) {
  for (double t_s = from_s; t_s < to_s; t_s += every_s)
    static_cast<void>(gate.weigh(0, 0, t_s, 0.1 * random.gaussian(), 0.01));
}

TEST(RangeTuning, LeavesTheComparisonModelsAtTheirNominalNoise) {
  // A third of the nominal noise, and biases that these models lack: an adapted sigma would gate all ranges.
  const model::Surface surface = testing::hills(0.2);
  const model::Calibration calibration = testing::six_anchors();
  Random random(75);
  const testing::Drive drive =
      testing::drive(surface, calibration, {1.0, -2.0, 0.4},
                     {.duration_s = 60.0, .range_s = 0.01, .range_sigma_m = 0.03}, random);
  for (const Model model : {Model::kOriginal, Model::kInflated}) {
    Config config;
    config.model = model;
    config.odometry = {0.03, 0.03, 0.01};
    const Errors errors = replay(surface, calibration, config, drive);
    EXPECT_EQ(errors.filter->snapshot().tuning.white_sigma_m(), config.range_sigma_m);
    EXPECT_LT(errors.max_m, 1.0) << model_name(model);
  }
  Config config;
  config.odometry = {0.03, 0.03, 0.01};
  EXPECT_NEAR(replay(surface, calibration, config, drive).filter->snapshot().tuning.white_sigma_m(), 0.03,
              0.01);
}

// With hardly any other uncertainty, the variance of an innovation without the pose's part is the noise.
TEST(RangeTuning, TheFilterWeighsRangesByTheEstimatedSigma) {
  const model::Surface flat;
  const model::Calibration calibration = testing::six_anchors(0.01);
  Random random(76);
  const testing::Drive drive = testing::drive(
      flat, calibration, {1.0, -2.0, 0.4},
      {.duration_s = 30.0, .range_s = 0.005, .range_sigma_m = 0.03, .lever_arm_sigma_m = 0.0}, random);
  Config config = matching_config();
  config.lever_arm_sigma_m = 0.0;
  const Errors errors = replay(flat, calibration, config, drive);
  const RangeResult result =
      errors.filter->process(model::RangeSample{errors.filter->estimate().t_s, 1, 11, 15.0});
  EXPECT_NEAR(std::sqrt(result.map_variance_m2), 0.03, 0.01);
}

TEST(Reception, ASilentPairRegainsTrustGradually) {
  Gate gate{GateConfig{}};
  Random random(7);
  feed(gate, 0.0, 20.0, 0.05, random);
  EXPECT_EQ(gate.regained_variance_m2(0, 0), 0.0);
  const double heard = gate.weigh(0, 0, 20.0, 0.25, 0.01);
  const double back = gate.weigh(0, 0, 26.0, 0.25, 0.01);
  EXPECT_LT(back, heard);
  EXPECT_GT(gate.regained_variance_m2(0, 0), 1.0);
  EXPECT_GT(gate.nlos(0, 0), 0.3);
  feed(gate, 26.05, 31.0, 0.05, random);
  EXPECT_EQ(gate.regained_variance_m2(0, 0), 0.0);
  EXPECT_LT(gate.nlos(0, 0), 0.15);
  EXPECT_GT(gate.weigh(0, 0, 31.0, 0.0, 0.01), 0.9);
}

// The undetectable error of a range depends on the pose's covariance.
TEST(Reception, RegainedVarianceDependsOnHowWellThePoseIsKnown) {
  const auto regained_m2 = [](double innovation_m, double variance_m2) {
    Gate gate{GateConfig{}};
    for (double t_s = 0.0; t_s < 20.0; t_s += 0.05) static_cast<void>(gate.weigh(0, 0, t_s, 0.0, 0.01));
    static_cast<void>(gate.weigh(0, 0, 26.0, innovation_m, variance_m2));
    return gate.regained_variance_m2(0, 0);
  };
  EXPECT_LT(regained_m2(0.0, 0.01), 0.05);
  EXPECT_GT(regained_m2(0.0, 4.0), 10.0);
  // Too long is likelier than too short, but after a silence both occur.
  EXPECT_GT(regained_m2(2.0, 1.0), 2.0 * regained_m2(-2.0, 1.0));
  EXPECT_GT(regained_m2(-3.0, 1.0), 30.0);
}

// The gain of a range after a silence, from the dense covariance of core and parameters.
TEST(Reception, ARegainedPairCorrectsThePoseLess) {
  const model::Surface flat;
  const model::Calibration calibration = testing::six_anchors(0.1);
  Random random(12);
  testing::Drive drive = testing::drive(flat, calibration, {0.0, 0.0, 0.2},
                                        {.duration_s = 16.0, .range_s = 0.05 / 18.0}, random);
  std::erase_if(drive.ranges, [](const model::RangeSample& range) { return range.t_s > 10.0; });
  const Errors errors = replay(flat, calibration, matching_config(), drive);
  Filter& filter = *errors.filter;
  const int slot = filter.site().anchor_index(11);
  const int tag = filter.site().tag_slot(1);
  const RangeMeasurement predicted = measure_range(flat, filter.core(), filter.snapshot().odometry,
                                                   filter.parameters().pair(filter.site(), slot, tag));
  const Eigen::MatrixXd p = testing::whole(filter);
  Eigen::VectorXd h = Eigen::VectorXd::Zero(p.rows());
  h.head<kCoreSize>() = predicted.d_core;
  const PairIndices index = filter.parameters().pair_indices(slot, tag);
  for (std::size_t i = 0; i < index.size(); ++i)
    h(kCoreSize + index[i]) = predicted.d_parameters(static_cast<Eigen::Index>(i));
  const RangeResult result =
      filter.process(model::RangeSample{filter.estimate().t_s, 1, 11, predicted.range_m + 0.3});
  ASSERT_GT(result.weight, 0.0);
  EXPECT_LT(result.weight, 0.9);
  const double regained_m2 = filter.snapshot().gate.regained_variance_m2(slot, tag);
  EXPECT_GT(regained_m2, result.innovation_variance_m2);
  const Eigen::Vector3d expected =
      (p * h).head<3>() * 0.3 / (result.innovation_variance_m2 / result.weight + regained_m2);
  EXPECT_LT((result.correction - expected).norm(), 1e-6 * expected.norm());
}

// If several tags receive an anchor again, their errors are common.
TEST(Reception, SeveralTagsOfASilentAnchorCountAsOne) {
  const auto regained_m2 = [](int tags) {
    Gate gate{GateConfig{}};
    for (double t_s = 0.0; t_s < 20.0; t_s += 0.05) {
      for (int tag = 0; tag < tags; ++tag) static_cast<void>(gate.weigh(0, tag, t_s, 0.0, 0.01));
    }
    for (int tag = 0; tag < tags; ++tag) static_cast<void>(gate.weigh(0, tag, 40.0, 2.0, 1.0));
    // Another anchor's silence does not matter.
    static_cast<void>(gate.weigh(1, 0, 40.0, 2.0, 1.0));
    return gate.regained_variance_m2(0, tags - 1);
  };
  EXPECT_GT(regained_m2(1), 1.0);
  EXPECT_NEAR(regained_m2(2), 2.0 * regained_m2(1), 0.1 * regained_m2(1));
  EXPECT_NEAR(regained_m2(3), 3.0 * regained_m2(1), 0.1 * regained_m2(1));
}

// A drive in which each pair is polled each 50 ms; `change` may alter a range and returns whether it is kept.
template <typename Change>
testing::Drive polled(const model::Surface& surface, const model::Calibration& calibration,
                      const model::OdometryNoise& noise, Random& random, const Change& change) {
  testing::Drive out = testing::drive(
      surface, calibration, {0.0, 0.0, 0.2},
      {.duration_s = 30.0, .range_s = 0.05 / 18.0, .range_sigma_m = 0.05, .noise = noise}, random);
  std::erase_if(out.ranges, [&](model::RangeSample& range) { return !change(range); });
  return out;
}

Config without_silence(Config config) {
  config.gate.regained_share = 0.0;
  config.gate.regained_garbage = 0.0;
  return config;
}

TEST(Reception, HalfOfTheRepliesAreNearlyAsGoodAsAllIfLos) {
  const model::Surface flat;
  const model::Calibration calibration = testing::six_anchors(0.1);
  const Config config = matching_config();
  double mean_m = 0.0;
  double blind_m = 0.0;
  for (const unsigned seed : {1U, 2U, 3U, 4U}) {
    Random random(seed);
    const testing::Drive drive =
        polled(flat, calibration, config.odometry, random,
               [&](const model::RangeSample& range) { return range.t_s < 5.0 || random.uniform() < 0.45; });
    mean_m += replay(flat, calibration, config, drive, 10.0).mean_m;
    blind_m += replay(flat, calibration, without_silence(config), drive, 10.0).mean_m;
  }
  EXPECT_LT(mean_m, 1.15 * blind_m);
}

TEST(Reception, AnchorsThatComeBackAfterNlosAreConsistent) {
  const model::Surface flat;
  const model::Calibration calibration = testing::six_anchors(0.1);
  Config config = matching_config();
  config.odometry = {1.0, 1.0, 0.03};
  double nees = 0.0;
  double blind_nees = 0.0;
  constexpr int kRuns = 8;
  for (unsigned seed = 1; seed <= kRuns; ++seed) {
    Random random(seed);
    const double excess_m[] = {-3.0 * std::log(1.0 - random.uniform()),
                               -3.0 * std::log(1.0 - random.uniform())};
    // No ranges for 8 s; then for 2 s one reply in five from two anchors only, too long.
    testing::Drive drive = polled(flat, calibration, config.odometry, random, [&](model::RangeSample& range) {
      if (range.t_s < 10.0 || range.t_s > 20.0) return true;
      if (range.t_s < 18.0 || range.anchor_id > 12) return false;
      range.range_m += excess_m[range.anchor_id - 11];
      return random.uniform() < 0.2;
    });
    std::erase_if(drive.ranges, [](const model::RangeSample& range) { return range.t_s > 22.0; });
    drive.odometry.resize(440);
    nees += replay(flat, calibration, config, drive, 18.0).nees / kRuns;
    blind_nees += replay(flat, calibration, without_silence(config), drive, 18.0).nees / kRuns;
  }
  EXPECT_LT(nees, 1.5);
  EXPECT_LT(nees, 0.3 * blind_nees);
}

TEST(Reception, SilenceIsNoEvidenceIfPollsAreRare) {
  Gate gate{GateConfig{}};
  Random random(8);
  feed(gate, 0.0, 100.0, 1.0, random);
  static_cast<void>(gate.weigh(0, 0, 120.0, 0.0, 0.01));
  EXPECT_EQ(gate.regained_variance_m2(0, 0), 0.0);
}

// Relation of the received powers to LOS and NLOS.
enum class PowerContent { kNothing, kTruth, kOpposite, kNoise };

// Six anchors, each NLOS for a third of the time with an excess of 0.15 to 0.75 m.
Errors with_nlos(Model model, PowerContent powers, std::uint64_t seed) {
  const model::Surface flat;
  const model::Calibration calibration = testing::six_anchors(0.3);
  Random random(seed);
  testing::Drive drive =
      testing::drive(flat, calibration, {1.0, -2.0, 0.4}, {.duration_s = 120.0, .range_s = 0.005}, random);
  for (model::RangeSample& range : drive.ranges) {
    const int wall = static_cast<int>(range.t_s / 4.0) + 5 * range.anchor_id;
    const bool nlos = wall * 7 % 3 == 0;
    if (nlos) range.range_m += 0.15 + 0.1 * (wall * 11 % 7);
    const bool weak = powers == PowerContent::kTruth      ? nlos
                      : powers == PowerContent::kOpposite ? !nlos
                                                          : random.next() % 2 == 0;
    if (powers == PowerContent::kNothing) continue;
    const double strength_dbm = (weak ? -68.0 : -59.0) + random.gaussian();
    range.first_path_power_dbm = static_cast<float>(strength_dbm - 20.0 * std::log10(range.range_m));
    range.receive_power_dbm = range.first_path_power_dbm + (weak ? 11.0F : 2.0F);
  }
  return replay(flat, calibration, testing::config_of(model), drive, 20.0);
}

TEST(Powers, HelpIfInformativeAndCostLittleIfMisleadingOverManyDrives) {
  constexpr std::uint64_t kDrives = 12;
  for (const Model model : {Model::kSchmidt, Model::kJoint}) {
    const auto mean_m = [model](PowerContent powers) {
      double sum_m = 0.0;
      for (std::uint64_t seed = 1; seed <= kDrives; ++seed) sum_m += with_nlos(model, powers, seed).mean_m;
      return sum_m / static_cast<double>(kDrives);
    };
    const double without_m = mean_m(PowerContent::kNothing);
    const double truth = mean_m(PowerContent::kTruth) / without_m;
    const double opposite = mean_m(PowerContent::kOpposite) / without_m;
    const double noise = mean_m(PowerContent::kNoise) / without_m;
    const std::string name(model_name(model));
    RecordProperty(name + "_truth", std::to_string(truth));
    RecordProperty(name + "_opposite", std::to_string(opposite));
    RecordProperty(name + "_noise", std::to_string(noise));
    EXPECT_LT(truth, 0.9) << model_name(model);
    EXPECT_LT(opposite, 1.05) << model_name(model);
    EXPECT_LT(noise, 1.05) << model_name(model);
  }
}

}  // namespace
}  // namespace groma::filter
