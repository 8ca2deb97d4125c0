// Physically impossible samples, of any size and in any column: the run stays as good as without them, and
// all numbers stay finite.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <limits>
#include <map>
#include <span>
#include <string>
#include <vector>

#include "host/filter/dead_reckoning.hpp"
#include "host/filter/filter.hpp"
#include "host/filter/odometry_gate.hpp"
#include "host/filter/replay.hpp"
#include "host/filter/tracker.hpp"
#include "host/model/plausible.hpp"
#include "test/host/filter/small_site.hpp"

namespace groma::filter {
namespace {

using test::Random;

constexpr double kRow_s = 0.02;
constexpr double kDuration_s = 16.0;
constexpr double kLargest = std::numeric_limits<double>::max();
constexpr std::array kSizes{10.0, 25.0, 100.0, 1e5, 1e12, 1e154, 1e300, kLargest};
constexpr std::array kTurnSizes{5.0, 9.0, 12.0, 30.0, 100.0, 1e6, 1e8, 1e154, kLargest};

const model::PlanarPose kStart{1.0, -2.0, 0.4};

// A drive with the samples of all sensors.
struct Samples {
  testing::Drive drive;
  model::SensorTables sensors;
};

Samples make_samples(bool with_sensors, std::uint64_t seed = 31) {
  Samples out;
  Random random(seed);
  out.drive = testing::drive(model::Surface(), testing::six_anchors(0.1), kStart,
                             {.duration_s = kDuration_s, .row_s = kRow_s, .range_s = 0.01}, random);
  if (!with_sensors) return out;
  for (std::size_t i = 0; i < out.drive.odometry.size(); ++i) {
    const double t_s = out.drive.odometry[i].t_s;
    const model::PlanarPose& at = out.drive.truth[i];
    model::samples_of<model::YawRateSample>(out.sensors)
        .push_back({t_s, testing::true_velocity(t_s).z() + 0.004 + 0.005 * random.gaussian()});
    if (i % 10 == 0) {
      model::samples_of<model::PositionSample>(out.sensors)
          .push_back(
              {t_s, at.x_m + 0.5 * random.gaussian(), at.y_m + 0.5 * random.gaussian(), {0.25, 0.0, 0.25}});
    }
    if (i % 5 == 2) {
      model::samples_of<model::PoseSample>(out.sensors)
          .push_back({.t_s = t_s,
                      .x_m = at.x_m + 0.1 * random.gaussian(),
                      .y_m = at.y_m + 0.1 * random.gaussian(),
                      .yaw_rad = at.theta_rad + 0.02 * random.gaussian(),
                      .covariance = model::PoseCovariance{0.01, 0.0, 0.0, 0.01, 0.0, 4e-4}});
    }
  }
  return out;
}

struct Outcome {
  double mean_m = 0.0;
  ReplayResult result;
};

Outcome run(const Samples& samples, const std::vector<model::PlanarPose>& truth) {
  static const model::Surface surface;
  static const model::Calibration calibration = testing::six_anchors(0.1);
  const std::vector<model::Tag> tags = testing::three_tags();
  ReplayOptions options;
  options.config = testing::config_of(Model::kSchmidt);
  options.config.odometry_delay_sigma_s = kOdometryDelaySigma_s;
  options.config.range_delay_sigma_s = kRangeDelaySigma_s;
  options.start = {.t_s = 0.0, .pose = kStart};
  Outcome out;
  out.result = replay({.odometry = samples.drive.odometry,
                       .ranges = samples.drive.ranges,
                       .tags = tags,
                       .surface = &surface,
                       .calibration = &calibration,
                       .sensors = &samples.sensors},
                      options);
  for (std::size_t i = 0; i < out.result.rows.size(); ++i) {
    const model::PlanarEstimate& row = out.result.rows[i];
    const double error_m = std::hypot(row.x_m - truth[i].x_m, row.y_m - truth[i].y_m);
    out.mean_m += error_m / static_cast<double>(out.result.rows.size());
  }
  return out;
}

// One pose for each odometry sample, all finite, and none is TRACKING with an error beyond 5 sigma.
void expect_honest(const Outcome& with, const std::vector<model::PlanarPose>& truth,
                   const std::string& what) {
  ASSERT_EQ(with.result.rows.size(), truth.size()) << what;
  double worst = 0.0;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    const model::PlanarEstimate& row = with.result.rows[i];
    ASSERT_TRUE(std::isfinite(row.x_m + row.y_m + row.yaw_rad) && row.covariance.allFinite())
        << what << " at " << row.t_s;
    if (with.result.states[i].state != State::kTracking) continue;
    const Eigen::Vector2d error_m(row.x_m - truth[i].x_m, row.y_m - truth[i].y_m);
    const double sigmas = std::sqrt(error_m.dot(row.covariance.topLeftCorner<2, 2>().inverse() * error_m));
    worst = std::max(worst, sigmas);
  }
  EXPECT_LT(worst, 5.0) << what;
}

enum class Pattern { kOnce, kEach5s, k20InARow };
constexpr std::array kPatterns{Pattern::kOnce, Pattern::kEach5s, Pattern::k20InARow};

// Whether sample i at t_s, of a series with interval every_s, is replaced by a wrong value.
bool is_wrong(Pattern pattern, std::size_t i, double t_s, double every_s) {
  const auto first = static_cast<std::size_t>(std::lround(6.0 / every_s));
  if (pattern == Pattern::kOnce) return i == first;
  if (pattern == Pattern::k20InARow) return i >= first && i < first + 20;
  const double since_s = std::fmod(t_s, 5.0);
  return t_s > 4.0 && since_s < every_s - 1e-9;
}

// Tests each size, with both signs, in each pattern, in the column of a sample that `at` selects. The error
// has to be as small as without wrong samples, in the mean over `seeds`, because a single drive of 16 s is
// random.
template <class Sample>
void expect_good_of_all(const std::string& column, const std::vector<double>& sizes, double every_s,
                        std::vector<Sample>& (*of)(Samples&), double& (*at)(Sample&), bool with_sensors,
                        std::initializer_list<std::uint64_t> seeds = {31}) {
  struct Means {
    double with_m = 0.0;
    double without_m = 0.0;
  };
  std::map<std::string, Means> all_means;
  for (const std::uint64_t seed : seeds) {
    const Samples right = make_samples(with_sensors, seed);
    const std::vector<model::PlanarPose>& truth = right.drive.truth;
    const Outcome reference = run(right, truth);
    for (const Pattern pattern : kPatterns) {
      // The reference without wrong samples: with the right values or, for sensors, with these samples left
      // out, whichever is worse.
      Samples wrong = right;
      Samples left_out = right;
      of(left_out).clear();
      std::vector<std::size_t> spoilt;
      for (std::size_t i = 0; i < of(wrong).size(); ++i) {
        const Sample& sample = of(wrong)[i];
        if (is_wrong(pattern, i, sample.t_s, every_s)) {
          spoilt.push_back(i);
        } else {
          of(left_out).push_back(sample);
        }
      }
      double without_m = reference.mean_m;
      if (with_sensors) without_m = std::max(without_m, run(left_out, truth).mean_m);
      for (const double size : sizes) {
        for (const double value : {size, -size}) {
          for (const std::size_t i : spoilt) at(of(wrong)[i]) = value;
          const std::string what = column + " " + std::to_string(static_cast<int>(pattern)) + " " +
                                   (::testing::Message() << value).GetString();
          const Outcome with = run(wrong, truth);
          expect_honest(with, truth, what);
          Means& means = all_means[what];
          means.with_m += with.mean_m;
          means.without_m += without_m;
        }
      }
    }
  }
  for (const auto& [what, means] : all_means) EXPECT_LE(means.with_m, 1.2 * means.without_m) << what;
}

template <class Sizes>
std::vector<double> all(const Sizes& sizes) {
  return {sizes.begin(), sizes.end()};
}

std::vector<model::OdometrySample>& odometry_of(Samples& of) {
  return of.drive.odometry;
}
std::vector<model::YawRateSample>& yaw_rates_of(Samples& of) {
  return model::samples_of<model::YawRateSample>(of.sensors);
}
std::vector<model::PositionSample>& positions_of(Samples& of) {
  return model::samples_of<model::PositionSample>(of.sensors);
}
std::vector<model::PoseSample>& poses_of(Samples& of) {
  return model::samples_of<model::PoseSample>(of.sensors);
}

TEST(Implausible, OdometryOfAnySizeCostsNothing) {
  using Row = model::OdometrySample;
  const auto good = [](const char* column, const auto& sizes, double& (*at)(Row&)) {
    expect_good_of_all<Row>(column, all(sizes), kRow_s, odometry_of, at, false, {31, 32, 33, 34});
  };
  good("vx_mps", kSizes, [](Row& row) -> double& { return row.vx_mps; });
  good("vy_mps", kSizes, [](Row& row) -> double& { return row.vy_mps; });
  good("omega_radps", kTurnSizes, [](Row& row) -> double& { return row.omega_radps; });
}

TEST(Implausible, YawRatesOfAnySizeCostNothing) {
  using Rate = model::YawRateSample;
  expect_good_of_all<Rate>(
      "imu", all(kTurnSizes), kRow_s, yaw_rates_of, [](Rate& rate) -> double& { return rate.omega_radps; },
      true);
}

constexpr std::array kFixSizes{10.0, 1e3, 1e5, 1e8, 1e154, kLargest};
constexpr std::array kVariances{1e-300, 10.0, 1e4, 1e154, kLargest};

TEST(Implausible, PositionsOfAnySizeCostNothing) {
  using Fix = model::PositionSample;
  const auto good = [](const char* column, const auto& sizes, double& (*at)(Fix&)) {
    expect_good_of_all<Fix>(column, all(sizes), 0.2, positions_of, at, true);
  };
  good("gnss x_m", kFixSizes, [](Fix& fix) -> double& { return fix.x_m; });
  good("gnss y_m", kFixSizes, [](Fix& fix) -> double& { return fix.y_m; });
  good("gnss p_xx", kVariances, [](Fix& fix) -> double& { return fix.covariance_m2[0]; });
  good("gnss p_xy", kVariances, [](Fix& fix) -> double& { return fix.covariance_m2[1]; });
  good("gnss p_yy", kVariances, [](Fix& fix) -> double& { return fix.covariance_m2[2]; });
}

TEST(Implausible, PosesOfAnySizeCostNothing) {
  using Pose = model::PoseSample;
  const auto good = [](const char* column, const auto& sizes, double& (*at)(Pose&)) {
    expect_good_of_all<Pose>(column, all(sizes), 0.1, poses_of, at, true);
  };
  good("pose x_m", kFixSizes, [](Pose& pose) -> double& { return pose.x_m; });
  good("pose y_m", kFixSizes, [](Pose& pose) -> double& { return pose.y_m; });
  good("pose yaw_rad", kFixSizes, [](Pose& pose) -> double& { return pose.yaw_rad; });
  good("pose roll_rad", kFixSizes, [](Pose& pose) -> double& { return pose.roll_rad; });
  good("pose pitch_rad", kFixSizes, [](Pose& pose) -> double& { return pose.pitch_rad; });
  good("pose p_xx", kVariances, [](Pose& pose) -> double& { return (*pose.covariance)[0]; });
  good("pose p_xy", kVariances, [](Pose& pose) -> double& { return (*pose.covariance)[1]; });
  good("pose p_yt", kVariances, [](Pose& pose) -> double& { return (*pose.covariance)[4]; });
  good("pose p_tt", kVariances, [](Pose& pose) -> double& { return (*pose.covariance)[5]; });
}

TEST(Implausible, SamplesAreCountedAndTimeStillPasses) {
  Samples samples = make_samples(true);
  samples.drive.odometry[300].vx_mps = 1e308;
  samples.drive.odometry[301].omega_radps = -31.0;
  model::samples_of<model::YawRateSample>(samples.sensors)[400].omega_radps = 1e308;
  model::samples_of<model::PositionSample>(samples.sensors)[20].covariance_m2 = {1e300, 0.0, 1e300};
  model::samples_of<model::PoseSample>(samples.sensors)[20].x_m = -1e9;
  const Outcome out = run(samples, samples.drive.truth);
  EXPECT_EQ(out.result.counters.odometry[OdometryOutcome::kImplausible], 2U);
  EXPECT_EQ(out.result.counters.sensors[model::kSensorOf<model::YawRateSample>][SensorOutcome::kJumped], 1U);
  EXPECT_EQ(out.result.counters.sensors[model::kSensorOf<model::PositionSample>][SensorOutcome::kBadValue],
            1U);
  EXPECT_EQ(out.result.counters.sensors[model::kSensorOf<model::PoseSample>][SensorOutcome::kBadValue], 1U);
  EXPECT_EQ(out.result.rows.size(), samples.drive.odometry.size());
  // The pose is propagated with the sample held.
  const model::PlanarEstimate& before = out.result.rows[299];
  const model::PlanarEstimate& at = out.result.rows[300];
  EXPECT_EQ(at.t_s, samples.drive.odometry[300].t_s);
  EXPECT_NEAR(std::hypot(at.x_m - before.x_m, at.y_m - before.y_m),
              kRow_s * samples.drive.odometry[299].vx_mps, 0.02);
}

TEST(Implausible, MotionMissedMeanwhileIsInTheCovariance) {
  Filter filter(model::Surface(), testing::three_tags(), testing::six_anchors(),
                testing::config_of(Model::kSchmidt));
  filter.process(model::OdometrySample{0.0, 1.2, 0.0, 1.0});
  filter.start({.t_s = 0.0, .position_sigma_m = 0.001, .heading_sigma_rad = 0.001});
  // For 0.4 s the robot brakes and turns less, while its odometry is implausible.
  model::PlanarPose truth;
  for (int i = 1; i <= 21; ++i) {
    const double share = 1.0 - 0.05 * (i - 0.5);
    truth =
        testing::integrate(model::Surface(), truth, {0.7 + 0.5 * share, 0.0, 0.4 + 0.6 * share}, kRow_s, 4);
    const bool is_last = i == 21;
    EXPECT_EQ(filter.process(model::OdometrySample{kRow_s * i, is_last ? 0.7 : 1e308, 0.0, 0.4}),
              is_last ? OdometryOutcome::kUsed : OdometryOutcome::kImplausible);
  }
  const Estimate estimate = filter.estimate();
  EXPECT_GT(std::abs(estimate.pose.theta_rad - truth.theta_rad), 0.1);
  EXPECT_LT(testing::squared_error(estimate, truth), 16.0) << "within 4 sigma";
  // Valid samples afterwards have their usual noise.
  const double variance = filter.covariance().core()(kOdometryVx, kOdometryVx);
  EXPECT_LT(variance, 2.0 * 0.03 * 0.03);
}

TEST(Implausible, OdometryThatStaysImplausibleCountsAsMissing) {
  Samples samples = make_samples(false);
  for (std::size_t i = 300; i < samples.drive.odometry.size(); ++i) samples.drive.odometry[i].vx_mps = 1e6;
  const Outcome out = run(samples, samples.drive.truth);
  EXPECT_EQ(out.result.states[299].state, State::kTracking);
  EXPECT_EQ(out.result.states[400].state, State::kDegraded);
  EXPECT_EQ(out.result.states[400].reason, Reason::kNoOdometry);
}

TEST(Implausible, PredictionDropsTheSameSamples) {
  Filter filter(model::Surface(), testing::three_tags(), testing::six_anchors(),
                testing::config_of(Model::kSchmidt));
  filter.process(model::OdometrySample{0.0, 1.0, 0.0, 0.1});
  filter.start({.t_s = 0.0, .pose = kStart});
  const std::vector<MotionInput> ahead{
      model::OdometrySample{0.02, 1e308, 0.0, 0.1}, model::YawRateSample{0.03, 1e308},
      model::OdometrySample{0.04, 1.1, 0.0, 0.1}, model::OdometrySample{0.06, 1.1, 1e12, 0.1}};
  const Estimate predicted = testing::predict(filter, ahead);
  for (const MotionInput& input : ahead) std::visit([&](const auto& of) { filter.process(of); }, input);
  EXPECT_EQ(predicted.t_s, 0.06);
  EXPECT_EQ(predicted.pose.x_m, filter.estimate().pose.x_m);
  EXPECT_EQ(predicted.pose.y_m, filter.estimate().pose.y_m);
  EXPECT_EQ(predicted.covariance, filter.estimate().covariance);
}

TEST(OdometryGate, AcceptsConsistentSamplesAfterHalfASecondButNoImpossibleOnes) {
  OdometryGate gate;
  EXPECT_FALSE(gate.accepts({0.0, 25.0, 0.0, 0.0})) << "a robot begins at rest";
  EXPECT_TRUE(gate.accepts({0.02, 2.0, 0.0, 0.0}));
  double believed_s = 0.0;
  for (int i = 0; i < 100 && believed_s == 0.0; ++i) {
    const double t_s = 1.0 + 0.02 * i;
    if (gate.accepts({t_s, 20.0, 0.0, 0.0})) believed_s = t_s;
  }
  EXPECT_NEAR(believed_s, 1.5, 0.021);
  EXPECT_TRUE(gate.accepts({believed_s + 0.02, 19.5, 0.0, 0.0}));
  for (int i = 0; i < 1000; ++i) {
    EXPECT_FALSE(gate.accepts({10.0 + 0.02 * i, 31.0, 0.0, 0.0}));
    EXPECT_FALSE(gate.accepts({10.01 + 0.02 * i, 19.5, 0.0, 31.0}));
  }
  EXPECT_TRUE(gate.accepts({40.0, 19.0, 0.0, 0.0})) << "as before";
  // Inconsistent samples are never accepted.
  for (int i = 0; i < 1000; ++i)
    EXPECT_FALSE(gate.accepts({50.0 + 0.02 * i, i % 2 == 0 ? -20.0 : 0.0, 0.0, 0.0}));
}

TEST(Gyro, NeverAcceptsAConstantWrongRate) {
  Gyro gyro;
  const auto take = [&](double t_s, double omega_radps) {
    const bool follows = gyro.follows({t_s, omega_radps}, 0.1, SensorConfig{}.gyro_sigma_radps);
    if (follows) gyro = {t_s, omega_radps, true};
    return follows;
  };
  EXPECT_TRUE(take(0.0, 0.1));
  for (int i = 1; i < 100; ++i) EXPECT_FALSE(take(0.01 * i, 5.0)) << i;
  EXPECT_TRUE(take(1.0, 0.12));
  EXPECT_FALSE(take(1.01, 1e308));
  EXPECT_FALSE(take(1.02, -1e308));
  EXPECT_TRUE(take(1.03, 0.12));
}

TEST(StartFromPrior, SkipsImplausiblePoses) {
  const model::Surface surface;
  const std::vector<model::PoseSample> priors{{.t_s = 0.0, .x_m = 1e300},
                                              {.t_s = 0.1, .yaw_rad = -1e12},
                                              {.t_s = 0.2, .roll_rad = 3.0},
                                              {.t_s = 0.3, .x_m = 1.2},
                                              {.t_s = 0.4, .x_m = 50.0}};
  EXPECT_EQ(start_from_prior(priors, 0.0, surface)->t_s, 0.3);
  EXPECT_FALSE(start_from_prior(std::span(priors).first(3), 0.0, surface));
}

// Any finite number: half of them usual, half of random magnitude.
double any_number(Random& random, double usual) {
  if (random.uniform() < 0.5) return usual;
  const double size = std::pow(10.0, random.uniform(-308.0, 308.0));
  return random.uniform() < 0.5 ? size : -size;
}

TEST(Implausible, NothingFiniteMakesTheStateInfinite) {
  const model::Surface surface = testing::hills(0.3);
  const model::Calibration calibration = testing::six_anchors();
  for (unsigned seed = 1; seed <= 60; ++seed) {
    Random random(seed);
    Config config = testing::config_of(kModels.at(seed % kModels.size()));
    config.odometry_delay_sigma_s = seed % 2 == 0 ? kOdometryDelaySigma_s : 0.0;
    config.range_delay_sigma_s = kRangeDelaySigma_s;
    Filter filter(surface, testing::three_tags(), calibration, config);
    filter.start({.t_s = 0.0, .pose = kStart});
    double t_s = 0.0;
    for (int i = 0; i < 600; ++i) {
      // Random times, too; rarely, because later inputs would be out of order.
      t_s += random.uniform() < 0.98 ? 0.01 : std::pow(10.0, random.uniform(-12.0, 9.0));
      const auto any = [&](double usual) { return any_number(random, usual); };
      switch (random.next() % 6U) {
        case 0:
        case 1:
          filter.process(model::OdometrySample{t_s, any(1.0), any(0.1), any(0.2)});
          break;
        case 2:
          filter.process(model::RangeSample{
              .t_s = t_s,
              .tag_id = static_cast<model::NodeId>(1 + random.next() % 3U),
              .anchor_id = static_cast<model::NodeId>(11 + random.next() % 6U),
              .range_m = any(15.0),
              .first_path_power_dbm = static_cast<float>(std::clamp(any(-80.0), -3e38, 3e38)),
              .receive_power_dbm = static_cast<float>(std::clamp(any(-78.0), -3e38, 3e38))});
          break;
        case 3:
          filter.process(model::YawRateSample{t_s, any(0.2)});
          break;
        case 4:
          filter.process(model::PositionSample{t_s, any(1.0), any(-2.0), {any(0.1), any(0.0), any(0.1)}});
          break;
        default:
          filter.process(model::PoseSample{.t_s = t_s,
                                           .x_m = any(1.0),
                                           .y_m = any(-2.0),
                                           .z_m = any(0.0),
                                           .yaw_rad = any(0.4),
                                           .roll_rad = any(0.0),
                                           .pitch_rad = any(0.0),
                                           .covariance = model::PoseCovariance{
                                               any(0.1), any(0.0), any(0.0), any(0.1), any(0.0), any(0.01)}});
      }
      const Estimate estimate = filter.estimate();
      ASSERT_TRUE(filter.core().allFinite() && filter.covariance().core().allFinite())
          << "seed " << seed << ", input " << i;
      ASSERT_TRUE(std::isfinite(estimate.pose.x_m + estimate.pose.y_m + estimate.pose.theta_rad) &&
                  estimate.covariance.allFinite())
          << "seed " << seed << ", input " << i;
      if (i % 100 == 99) {
        ASSERT_TRUE(testing::whole(filter).allFinite()) << "seed " << seed << ", input " << i;
      }
    }
    filter.process(model::OdometrySample{kLargest, 1.0, 0.0, 0.1});
    EXPECT_TRUE(filter.core().allFinite() && testing::whole(filter).allFinite()) << "seed " << seed;
  }
}

}  // namespace
}  // namespace groma::filter
