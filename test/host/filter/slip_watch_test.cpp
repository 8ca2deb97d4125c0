#include "host/filter/slip_watch.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <memory>
#include <numbers>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "host/filter/tracker.hpp"
#include "test/host/filter/small_site.hpp"

namespace groma::filter {
namespace {

using test::Random;

constexpr double kSigma_m = 0.1;

// Six anchors in a circle, ranged in turn, each with an excess in addition to a displacement of the robot.
struct Circle {
  explicit Circle(std::uint64_t seed) : random(seed) {}

  // Feeds ranges with this displacement and excess. Stops when the watch finds a displacement and returns it.
  std::optional<Eigen::Vector2d> hear(double duration_s, const Eigen::Vector2d& displacement_m,
                                      const std::array<double, 6>& excess_m, double weight = 1.0) {
    for (const double end_s = t_s + duration_s; t_s < end_s;) {
      for (std::size_t anchor = 0; anchor < excess_m.size(); ++anchor) {
        t_s += 0.003;
        const double angle = std::numbers::pi / 3.0 * static_cast<double>(anchor);
        const Eigen::RowVector2d h(std::cos(angle), std::sin(angle));
        const double off_m = h * displacement_m + excess_m[anchor] + kSigma_m * random.gaussian();
        auto found = watch.observe(static_cast<int>(anchor), 0, t_s, off_m, kSigma_m * kSigma_m, weight, h);
        if (found) return found;
      }
    }
    return std::nullopt;
  }

  SlipWatch watch{Config{}.slip_odds};
  Random random;
  double t_s = 0.0;
};

constexpr std::array<double, 6> kLos{};

TEST(SlipWatch, FindsADisplacementSeenByAllAnchors) {
  for (std::uint64_t seed = 1; seed <= 20; ++seed) {
    Circle circle(seed);
    // Constant biases of the pairs are no displacement.
    const std::array<double, 6> usual{0.05, -0.05, 0.03, 0.0, -0.04, 0.05};
    ASSERT_FALSE(circle.hear(20.0, Eigen::Vector2d::Zero(), usual)) << seed;
    const double before_s = circle.t_s;
    const Eigen::Vector2d displacement_m(0.25, -0.15);
    const auto found = circle.hear(2.0, displacement_m, usual);
    ASSERT_TRUE(found) << seed;
    EXPECT_LT(circle.t_s - before_s, 0.5);
    // The part of the displacement that the window shows by then.
    EXPECT_GT(found->dot(displacement_m.normalized()), 0.05);
    EXPECT_LT(std::abs(found->x() * displacement_m.y() - found->y() * displacement_m.x()),
              0.4 * found->norm() * displacement_m.norm());
  }
}

TEST(SlipWatch, NoiseIsNoSlip) {
  Circle circle(5);
  EXPECT_FALSE(circle.hear(3600.0, Eigen::Vector2d::Zero(), kLos));
}

TEST(SlipWatch, NlosIsNoSlip) {
  for (std::uint64_t seed = 1; seed <= 20; ++seed) {
    Circle circle(seed);
    ASSERT_FALSE(circle.hear(10.0, Eigen::Vector2d::Zero(), kLos));
    // Up to four adjacent anchors are NLOS at once, as if the robot had moved away from them.
    for (std::size_t nlos = 1; nlos <= 4; ++nlos) {
      std::array<double, 6> excess{};
      std::fill_n(excess.begin(), nlos, 0.8);
      EXPECT_FALSE(circle.hear(2.0, Eigen::Vector2d::Zero(), excess, 0.0)) << seed << ' ' << nlos;
      EXPECT_FALSE(circle.hear(2.0, Eigen::Vector2d::Zero(), kLos)) << seed << ' ' << nlos;
    }
  }
}

// One anchor that was moved nearer, or a single wrong reflection, is no slip.
TEST(SlipWatch, OneAnchorThatIsTooNearIsNoSlip) {
  Circle circle(7);
  ASSERT_FALSE(circle.hear(10.0, Eigen::Vector2d::Zero(), kLos));
  EXPECT_FALSE(circle.hear(5.0, Eigen::Vector2d::Zero(), {-1.0, 0.0, 0.0, 0.0, 0.0, 0.0}, 0.0));
}

// NLOS makes ranges too long, so two that are too short are stronger evidence than two that are too long.
TEST(SlipWatch, RangesThatAreTooShortCountMore) {
  const auto is_found = [](double displacement_m) {
    // Two anchors behind the robot, one ahead, one on each side.
    const std::array<Eigen::RowVector2d, 5> by_position{
        Eigen::RowVector2d(1.0, 0.0), Eigen::RowVector2d(1.0, 0.0), Eigen::RowVector2d(-1.0, 0.0),
        Eigen::RowVector2d(0.0, 1.0), Eigen::RowVector2d(0.0, -1.0)};
    SlipWatch watch(Config{}.slip_odds);
    bool found = false;
    for (int i = 0; i < 1000; ++i) {
      const std::size_t anchor = static_cast<std::size_t>(i) % by_position.size();
      const double off_m = i < 500 ? 0.0 : by_position[anchor].x() * displacement_m;
      found = watch
                  .observe(static_cast<int>(anchor), 0, 0.01 * i, off_m, kSigma_m * kSigma_m, 0.0,
                           by_position[anchor])
                  .has_value() ||
              found;
    }
    return found;
  };
  EXPECT_TRUE(is_found(-0.5));
  EXPECT_FALSE(is_found(0.5));
}

// Anchors without recent ranges do not count as agreeing.
TEST(SlipWatch, SilentAnchorsDoNotCount) {
  Circle circle(10);
  ASSERT_FALSE(circle.hear(10.0, Eigen::Vector2d::Zero(), kLos));
  // Only two anchors are left, and both are suddenly too near.
  for (int i = 0; i < 1000; ++i) {
    circle.t_s += 0.01;
    const int anchor = i % 2;
    const double angle = std::numbers::pi / 3.0 * anchor;
    const Eigen::RowVector2d h(std::cos(angle), std::sin(angle));
    const double off_m = i < 500 ? 0.0 : -0.5;
    EXPECT_FALSE(circle.watch.observe(anchor, 0, circle.t_s, off_m, kSigma_m * kSigma_m, 0.0, h)) << i;
  }
}

// A wrong surface, for example, makes ranges too long and too short in a pattern that no displacement
// explains.
TEST(SlipWatch, UnexplainedErrorsAreNoSlip) {
  Circle circle(9);
  ASSERT_FALSE(circle.hear(10.0, Eigen::Vector2d::Zero(), kLos));
  EXPECT_FALSE(circle.hear(2.0, {0.08, 0.0}, {-0.3, 0.3, -0.3, -0.3, 0.3, -0.3}));
}

TEST(SlipWatch, IgnoresNonFiniteValuesAndForgets) {
  Circle circle(8);
  ASSERT_FALSE(circle.hear(10.0, Eigen::Vector2d::Zero(), kLos));
  const double none = std::numeric_limits<double>::quiet_NaN();
  EXPECT_FALSE(circle.watch.observe(0, 0, circle.t_s, none, 0.01, 1.0, {1.0, 0.0}));
  EXPECT_FALSE(circle.watch.observe(0, 0, circle.t_s, 0.1, none, 1.0, {1.0, 0.0}));
  // Some evidence of a displacement, then a reset.
  EXPECT_FALSE(circle.hear(0.08, {0.3, 0.0}, kLos));
  circle.watch = SlipWatch(Config{}.slip_odds);
  EXPECT_FALSE(circle.hear(10.0, Eigen::Vector2d::Zero(), kLos));
}

TEST(SlipInflation, LastsLongerIfSlipsRepeat) {
  SlipInflation inflation;
  EXPECT_FALSE(inflation.is_open());
  EXPECT_EQ(inflation.judge(0.05).velocity_m2ps2, 0.0);
  const auto open_s = [&](double t_s) {
    inflation.begin(0.2, t_s);
    double length_s = 0.0;
    for (; inflation.is_open(); length_s += 0.05) inflation.judge(0.05);
    return length_s;
  };
  inflation.begin(0.2, 1.0);
  const OdometryInflation first = inflation.judge(0.05);
  const double excess_mps = 2.0 * 0.2 / SlipWatch::kWindow_s * std::exp(-0.05 / SlipInflation::kLasts_s);
  EXPECT_NEAR(first.velocity_m2ps2, SlipInflation::kLasts_s / 0.05 * excess_mps * excess_mps, 1e-9);
  EXPECT_NEAR(first.turn_rad2ps2,
              SlipInflation::kLasts_s / 0.05 * std::pow(SlipInflation::kTurnPer_m * excess_mps, 2), 1e-9);
  const double once_s = open_s(100.0);
  const double twice_s = open_s(101.0);
  EXPECT_NEAR(twice_s, 2.0 * once_s, 0.1);
  EXPECT_NEAR(open_s(200.0), once_s, 0.1);
  inflation.begin(0.2, 300.0);
  inflation = {};
  EXPECT_FALSE(inflation.is_open());
}

struct Slipped {
  double mean_m = 0.0;
  double max_m = 0.0;
  double nees = 0.0;
  double wrong_s = 0.0;  // longest time in TRACKING with an error over 5 sigma
  std::size_t slips = 0;
};

// Slip: the wheels spin up within half a second, as gently as a robot accelerates, and odometry shows motion
// that does not happen. Carried: odometry fades to zero as gently while the robot moves on.
struct Disturbance {
  double slip_mps = 0.0;
  bool carried = false;
  double length_s = 3.0;
  double range_s = 0.003;
};

Slipped drive_with(const Disturbance& disturbance, std::uint64_t seed, const Config& config) {
  const model::Surface flat;
  const model::Calibration calibration = testing::six_anchors(0.1);
  Random random(seed);
  testing::Drive drive = testing::drive(flat, calibration, {0.0, 0.0, 0.2},
                                        {.duration_s = 35.0, .range_s = disturbance.range_s}, random);
  constexpr double kFrom_s = 20.0;
  constexpr double kRamp_s = 0.5;
  const double until_s = kFrom_s + disturbance.length_s;
  for (model::OdometrySample& row : drive.odometry) {
    const double in = std::clamp(std::min(row.t_s - kFrom_s, until_s - row.t_s) / kRamp_s, 0.0, 1.0);
    row.vx_mps += disturbance.slip_mps * in;
    if (!disturbance.carried) continue;
    row.vx_mps *= 1.0 - in;
    row.vy_mps *= 1.0 - in;
    row.omega_radps *= 1.0 - in;
  }
  const auto tracker = std::make_unique<Tracker>(flat, testing::three_tags(), calibration, config);
  Slipped out;
  double rows = 0.0;
  double wrong_s = 0.0;
  std::size_t next = 0;
  for (std::size_t i = 0; i < drive.odometry.size() && drive.odometry[i].t_s < until_s + 2.0; ++i) {
    for (; next < drive.ranges.size() && drive.ranges[next].t_s < drive.odometry[i].t_s; ++next)
      tracker->process(drive.ranges[next]);
    tracker->process(drive.odometry[i]);
    if (i == 0) tracker->start({.t_s = drive.odometry[0].t_s, .pose = drive.truth[0]});
    if (drive.odometry[i].t_s < kFrom_s) continue;
    const Estimate estimate = tracker->estimate();
    const double error_m =
        std::hypot(estimate.pose.x_m - drive.truth[i].x_m, estimate.pose.y_m - drive.truth[i].y_m);
    const double squared = testing::squared_error(estimate, drive.truth[i]);
    out.mean_m += error_m;
    out.max_m = std::max(out.max_m, error_m);
    out.nees += squared / 3.0;
    const bool wrong = tracker->state() == State::kTracking && squared > 25.0;
    wrong_s = wrong ? wrong_s + drive.odometry[i].t_s - drive.odometry[i - 1].t_s : 0.0;
    out.wrong_s = std::max(out.wrong_s, wrong_s);
    rows += 1.0;
  }
  out.mean_m /= rows;
  out.nees /= rows;
  out.slips = tracker->filter().counters().slips;
  return out;
}

Config consistent_config() {
  Config config;
  config.odometry = {0.03, 0.03, 0.01};
  return config;
}

// Mean errors and NEES over drives; the worst of the maxima and durations, the fewest slips found.
Slipped over_drives(int drives, const Disturbance& disturbance, const Config& config) {
  constexpr std::uint64_t kFirst = 6;
  Slipped all = drive_with(disturbance, kFirst, config);
  for (int i = 1; i < drives; ++i) {
    const std::uint64_t seed = kFirst + static_cast<std::uint64_t>(i);
    const Slipped one = drive_with(disturbance, seed, config);
    all.mean_m += one.mean_m;
    all.nees += one.nees;
    all.max_m = std::max(all.max_m, one.max_m);
    all.wrong_s = std::max(all.wrong_s, one.wrong_s);
    all.slips = std::min(all.slips, one.slips);
  }
  all.mean_m /= drives;
  all.nees /= drives;
  return all;
}

TEST(Slip, IsFoundAndCostsLittle) {
  Config blind = consistent_config();
  blind.slip_odds = 1e9;
  for (const double slip_mps : {-1.0, 0.5, 1.0, 2.0}) {
    for (const double length_s : {1.0, 3.0, 8.0}) {
      const Disturbance slip{.slip_mps = slip_mps, .length_s = length_s};
      const Slipped with = over_drives(3, slip, consistent_config());
      const Slipped without = over_drives(3, slip, blind);
      const std::string name =
          "at_" + std::to_string(slip_mps) + "_mps_for_" + std::to_string(length_s) + "_s";
      RecordProperty(name + "_mean_m", std::to_string(with.mean_m));
      RecordProperty(name + "_max_m", std::to_string(with.max_m));
      RecordProperty(name + "_blind_mean_m", std::to_string(without.mean_m));
      RecordProperty(name + "_blind_max_m", std::to_string(without.max_m));
      EXPECT_GE(with.slips, 1U) << slip_mps << ' ' << length_s;
      EXPECT_LT(with.mean_m, 0.12) << slip_mps << ' ' << length_s;
      EXPECT_LT(with.max_m, 0.5) << slip_mps << ' ' << length_s;
      EXPECT_LT(with.wrong_s, 2.0) << slip_mps << ' ' << length_s;
      EXPECT_LT(with.mean_m, 0.75 * without.mean_m) << slip_mps << ' ' << length_s;
      EXPECT_LT(with.nees, 0.6 * without.nees) << slip_mps << ' ' << length_s;
    }
  }
  // With a tenth of the ranges the detection takes longer, and a single drive says little.
  for (const double length_s : {3.0, 8.0}) {
    const Disturbance slip{.slip_mps = 1.0, .length_s = length_s, .range_s = 0.03};
    const Slipped with = over_drives(10, slip, consistent_config());
    const Slipped without = over_drives(10, slip, blind);
    EXPECT_GE(with.slips, 1U) << length_s;
    EXPECT_LT(with.mean_m, 0.3) << length_s;
    EXPECT_LT(with.mean_m, 0.5 * without.mean_m) << length_s;
  }
}

TEST(Slip, DetectsARobotThatIsCarried) {
  Config blind = consistent_config();
  blind.slip_odds = 1e9;
  for (const double length_s : {2.0, 5.0}) {
    const Disturbance carried{.carried = true, .length_s = length_s};
    const Slipped with = drive_with(carried, 6, consistent_config());
    const Slipped without = drive_with(carried, 6, blind);
    EXPECT_GE(with.slips, 1U) << length_s;
    EXPECT_LT(with.wrong_s, 2.0) << length_s;
    EXPECT_LT(with.mean_m, 0.2) << length_s;
    EXPECT_LT(with.mean_m, 0.5 * without.mean_m) << length_s;
  }
}

TEST(Slip, IsNotDetectedWhereThereIsNone) {
  for (std::uint64_t seed = 1; seed <= 5; ++seed)
    EXPECT_EQ(drive_with({}, seed, consistent_config()).slips, 0U) << seed;
}

}  // namespace
}  // namespace groma::filter
