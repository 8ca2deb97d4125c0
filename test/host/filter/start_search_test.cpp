#include "host/filter/start_search.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <numbers>
#include <span>
#include <vector>

#include "test/host/filter/small_site.hpp"
#include "test/support/allocations.hpp"

namespace groma::filter {
namespace {

using test::Random;

Config config_of() {
  Config config;
  config.odometry = {0.03, 0.03, 0.01};
  return config;
}

std::unique_ptr<StartSearch> make(const model::Calibration& calibration) {
  return std::make_unique<StartSearch>(testing::hills(0.2), testing::three_tags(), calibration, config_of());
}

// Feeds all inputs by time; odometry before ranges with equal times.
void feed(const testing::Drive& drive, StartSearch& into) {
  std::size_t next = 0;
  for (const model::OdometrySample& row : drive.odometry) {
    for (; next < drive.ranges.size() && drive.ranges[next].t_s < row.t_s; ++next)
      into.process(drive.ranges[next]);
    into.process(row);
  }
}

double distance_m(const model::PlanarPose& a, const model::PlanarPose& b) {
  return std::hypot(a.x_m - b.x_m, a.y_m - b.y_m);
}

double nees(const StartSearch::Hypothesis& hypothesis, const model::PlanarPose& truth) {
  const Eigen::Vector3d error(hypothesis.pose.x_m - truth.x_m, hypothesis.pose.y_m - truth.y_m,
                              model::wrap_angle(hypothesis.pose.theta_rad - truth.theta_rad));
  return error.dot(hypothesis.covariance.ldlt().solve(error));
}

TEST(StartSearch, FindsThePoseFromAnyPlaceAndHeading) {
  double sum = 0.0;
  constexpr int kRuns = 60;
  for (int run = 0; run < kRuns; ++run) {
    Random random(300 + static_cast<std::uint64_t>(run));
    const model::Calibration calibration = testing::six_anchors();
    const model::PlanarPose start{random.uniform(-9.0, 9.0), random.uniform(-9.0, 9.0),
                                  random.uniform(-std::numbers::pi, std::numbers::pi)};
    const testing::Drive drive =
        testing::drive(testing::hills(0.2), calibration, start, {.duration_s = 4.0, .range_s = 0.02}, random);
    const auto search = make(calibration);
    feed(drive, *search);
    const auto hypotheses = search->search();
    ASSERT_TRUE(search->settled()) << run;
    ASSERT_EQ(hypotheses.size(), 1U) << run;
    EXPECT_LT(distance_m(hypotheses[0].pose, drive.truth.back()), 0.6) << run;
    const double error = nees(hypotheses[0], drive.truth.back());
    EXPECT_LT(error, 25.0) << run;
    sum += error / 3.0;
    // The calibration's errors give the true pose some cost, but a wrong pose costs far more.
    model::PlanarPose away = drive.truth.back();
    away.x_m += 5.0;
    EXPECT_LT(search->cautious_cost(drive.truth.back()), 0.5 * search->cautious_cost(away)) << run;
  }
  // Consistency over 60 runs: the covariance must not be overconfident.
  EXPECT_LT(sum / kRuns, 1.3);
  EXPECT_GT(sum / kRuns, 0.2);
}

TEST(StartSearch, NlosOfOneAnchorCountsAsOneEvent) {
  const model::Calibration calibration = testing::six_anchors(0.1);
  // Additional cost of the true pose if some anchors are NLOS.
  const auto cost_of_walls = [&](std::size_t walls, double range_s) {
    double costs[2] = {};
    for (const bool nlos : {false, true}) {
      Random random(77);
      testing::Drive drive = testing::drive(testing::hills(0.2), calibration, {1.0, 2.0, 0.3},
                                            {.duration_s = 5.0, .range_s = range_s}, random);
      for (model::RangeSample& range : drive.ranges) {
        for (std::size_t a = 0; nlos && a < walls; ++a) {
          if (range.anchor_id == calibration.anchors[a].id) range.range_m += 3.0;
        }
      }
      const auto search = make(calibration);
      feed(drive, *search);
      costs[nlos ? 1 : 0] = search->cautious_cost(drive.truth.back());
    }
    return costs[1] - costs[0];
  };
  const double one = cost_of_walls(1, 0.01);
  EXPECT_GT(one, 4.0);
  EXPECT_LT(one, 16.0);
  EXPECT_NEAR(cost_of_walls(3, 0.01), 3.0 * one, 0.25 * one);
  // Nearly six times as many ranges (at most one of a pair each 0.25 s is used) with the same obstacle cost
  // less than twice as much.
  EXPECT_LT(one, 2.0 * cost_of_walls(1, 0.08));
}

TEST(StartSearch, KeepsBothSidesOfALineOfAnchorsUntilTheRobotTurns) {
  // All anchors are on the line y = 0; the robot first drives along it.
  const std::vector<model::Anchor> anchors{{11, {-8.0, 0.0, 2.0}},
                                           {12, {-4.0, 0.0, 2.0}},
                                           {13, {0.0, 0.0, 2.0}},
                                           {14, {4.0, 0.0, 2.0}},
                                           {15, {8.0, 0.0, 2.0}}};
  const std::vector<model::Tag> tags{{1, {0.0, 0.0, 1.0}}};
  const model::Calibration calibration = model::surveyed_calibration(
      anchors, tags, {.sigma_m = 0.1, .beta_m = {0.0, 0.05}, .gamma = {1.0, 0.001}}, 0.02);
  StartSearch search(model::Plane(), tags, calibration, config_of());

  Random random(8);
  Eigen::Vector3d pose(-3.0, 4.0, 0.2);
  double t_s = 0.0;
  const auto go = [&](double omega_radps, double duration_s) {
    for (const double end_s = t_s + duration_s; t_s < end_s; t_s += 0.05) {
      search.process(model::OdometrySample{t_s, 0.8, 0.0, omega_radps});
      for (const model::Anchor& anchor : anchors) {
        const Eigen::Vector3d antenna(pose.x(), pose.y(), 1.0);
        search.process(
            model::RangeSample{.t_s = t_s,
                               .tag_id = 1,
                               .anchor_id = anchor.id,
                               .range_m = (antenna - anchor.position_m).norm() + 0.1 * random.gaussian()});
      }
      pose.x() += 0.05 * 0.8 * std::cos(pose.z() + 0.025 * omega_radps);
      pose.y() += 0.05 * 0.8 * std::sin(pose.z() + 0.025 * omega_radps);
      pose.z() += 0.05 * omega_radps;
    }
  };
  go(0.0, 4.0);
  const auto straight = search.search();
  EXPECT_FALSE(search.settled());
  ASSERT_EQ(straight.size(), 2U);
  EXPECT_NEAR(straight[0].pose.y_m, -straight[1].pose.y_m, 0.2);
  EXPECT_NEAR(std::abs(straight[0].pose.y_m), pose.y(), 0.3);
  EXPECT_NEAR(straight[0].cost, straight[1].cost, 1e-3);

  go(0.7, 3.0);
  const auto turned = search.search();
  EXPECT_TRUE(search.settled());
  ASSERT_EQ(turned.size(), 1U);
  EXPECT_NEAR(turned[0].pose.x_m, pose.x(), 0.3);
  EXPECT_NEAR(turned[0].pose.y_m, pose.y(), 0.3);
  EXPECT_NEAR(model::wrap_angle(turned[0].pose.theta_rad - pose.z()), 0.0, 0.15);
}

TEST(StartSearch, OneStationaryTagGivesNoHeading) {
  const model::Calibration calibration = testing::six_anchors();
  const std::vector<model::Tag> tags{{1, {0.0, 0.0, 1.0}}};
  StartSearch search(model::Plane(), tags, calibration, config_of());
  for (int i = 0; i < 100; ++i) {
    const double t_s = 0.05 * i;
    search.process(model::OdometrySample{t_s, 0.0, 0.0, 0.0});
    for (const model::AnchorCalibration& anchor : calibration.anchors) {
      const double range_m =
          (Eigen::Vector3d(2.0, -1.0, 1.0) - anchor.position_m).norm() + anchor.pairs[0].beta_m;
      search.process(model::RangeSample{.t_s = t_s, .tag_id = 1, .anchor_id = anchor.id, .range_m = range_m});
    }
  }
  const auto hypotheses = search.search();
  EXPECT_FALSE(search.settled());
  ASSERT_FALSE(hypotheses.empty());
  EXPECT_LT(std::hypot(hypotheses[0].pose.x_m - 2.0, hypotheses[0].pose.y_m + 1.0), 0.3);
  EXPECT_TRUE(hypotheses.size() > 1 || hypotheses[0].covariance(2, 2) > 1.0);
}

TEST(StartSearch, SomeNlosRangesDoNotMislead) {
  int settled = 0;
  for (std::uint64_t run = 0; run < 20; ++run) {
    Random random(500 + run);
    const model::Calibration calibration = testing::six_anchors();
    const model::PlanarPose start{random.uniform(-8.0, 8.0), random.uniform(-8.0, 8.0), 1.0};
    testing::Drive drive =
        testing::drive(testing::hills(0.2), calibration, start, {.duration_s = 5.0, .range_s = 0.01}, random);
    for (model::RangeSample& range : drive.ranges) {
      if (range.anchor_id == 11 + run % 6 || random.uniform(0.0, 1.0) < 0.1)
        range.range_m += random.uniform(0.5, 3.0);
    }
    const auto search = make(calibration);
    feed(drive, *search);
    const auto hypotheses = search->search();
    if (!search->settled()) continue;
    ++settled;
    EXPECT_LT(nees(hypotheses[0], drive.truth.back()), 50.0) << run;
    EXPECT_LT(distance_m(hypotheses[0].pose, drive.truth.back()), 1.0) << run;
  }
  EXPECT_GE(settled, 18);
}

TEST(StartSearch, InconsistentRangesDoNotSettle) {
  const model::Calibration calibration = testing::six_anchors();
  const auto search = make(calibration);
  Random random(4);
  for (int i = 0; i < 400; ++i) {
    const double t_s = 0.01 * i;
    search->process(model::OdometrySample{t_s, 0.5, 0.0, 0.0});
    search->process(model::RangeSample{.t_s = t_s,
                                       .tag_id = static_cast<model::NodeId>(1 + i % 3),
                                       .anchor_id = static_cast<model::NodeId>(11 + i % 6),
                                       .range_m = random.uniform(1.0, 40.0)});
  }
  static_cast<void>(search->search());
  EXPECT_FALSE(search->settled());
}

// The best pose is right, but most ranges contradict it: they may be of another map.
TEST(StartSearch, APoseThatExplainsFewRangesDoesNotSettle) {
  const model::Calibration calibration = testing::six_anchors(0.1);
  for (const double wrong_share : {0.2, 0.7}) {
    Random random(9);
    testing::Drive drive = testing::drive(testing::hills(0.2), calibration, {1.0, 2.0, 0.3},
                                          {.duration_s = 5.0, .range_s = 0.01}, random);
    for (model::RangeSample& range : drive.ranges) {
      if (random.uniform() < wrong_share) range.range_m = random.uniform(1.0, 40.0);
    }
    const auto search = make(calibration);
    feed(drive, *search);
    const auto hypotheses = search->search();
    ASSERT_EQ(hypotheses.size(), 1U) << wrong_share;
    EXPECT_LT(distance_m(hypotheses[0].pose, drive.truth.back()), 0.5) << wrong_share;
    EXPECT_EQ(search->settled(), wrong_share < 0.5);
  }
}

TEST(StartSearch, AllocatesNothingAndForgetsAllOnRequest) {
  Random random(1);
  const model::Calibration calibration = testing::six_anchors();
  const testing::Drive drive =
      testing::drive(testing::hills(0.2), calibration, {}, {.duration_s = 4.0, .range_s = 0.005}, random);
  const auto search = make(calibration);
  const std::size_t before = test::allocations();
  feed(drive, *search);
  static_cast<void>(search->search());
  EXPECT_EQ(test::allocations(), before);
  EXPECT_GT(search->ranges(), 100U);
  EXPECT_LE(search->ranges(), StartSearch::kMaxRanges);

  search->clear();
  EXPECT_EQ(search->ranges(), 0U);
  EXPECT_TRUE(search->search().empty());
  EXPECT_FALSE(search->settled());
}

}  // namespace
}  // namespace groma::filter
