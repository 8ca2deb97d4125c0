#include "host/filter/replay.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "test/host/filter/small_site.hpp"

namespace groma::filter {
namespace {

using test::Random;

class ReplayTest : public ::testing::Test {
 protected:
  ReplayTest() {
    Random random(71);
    drive_ = testing::drive(surface_, calibration_, start_, {.duration_s = 12.0, .range_s = 0.013}, random);
    options_.config.odometry = {0.03, 0.03, 0.01};
    options_.start = {.t_s = 0.0, .pose = start_};
  }

  ReplayResult run() const {
    return replay({drive_.odometry, drive_.ranges, tags_, &surface_, &calibration_}, options_);
  }

  model::Surface surface_ = testing::hills(0.2);
  model::Calibration calibration_ = testing::six_anchors(0.3);
  std::vector<model::Tag> tags_ = testing::three_tags();
  model::PlanarPose start_{1.0, -2.0, 0.4};
  testing::Drive drive_;
  ReplayOptions options_;
};

bool same(const model::PlanarEstimate& a, const model::PlanarEstimate& b) {
  return a.t_s == b.t_s && a.x_m == b.x_m && a.y_m == b.y_m && a.yaw_rad == b.yaw_rad &&
         a.covariance == b.covariance;
}

TEST_F(ReplayTest, GivesOneEstimateForEachOdometrySampleAtItsTime) {
  double nis = 0.0;
  options_.on_range = [&nis](const Tracker& /*tracker*/, const model::RangeSample& /*range*/,
                             const RangeResult& range) {
    if (range.outcome == RangeOutcome::kUsed) nis += range.nis;
  };
  const ReplayResult result = run();
  ASSERT_EQ(result.rows.size(), drive_.odometry.size());
  for (std::size_t i = 0; i < result.rows.size(); ++i) EXPECT_EQ(result.rows[i].t_s, drive_.odometry[i].t_s);
  // Ranges after the last odometry sample are not processed.
  std::size_t before = 0;
  for (const model::RangeSample& range : drive_.ranges)
    before += range.t_s <= drive_.odometry.back().t_s ? 1U : 0U;
  EXPECT_EQ(result.ranges_seen, before);
  EXPECT_EQ(result.counters.ranges[RangeOutcome::kUsed] + result.counters.ranges[RangeOutcome::kGated],
            before);
  double sum = 0.0;
  for (std::size_t i = 0; i < result.rows.size(); ++i) {
    sum += std::hypot(result.rows[i].x_m - drive_.truth[i].x_m, result.rows[i].y_m - drive_.truth[i].y_m);
  }
  EXPECT_LT(sum / static_cast<double>(result.rows.size()), 0.1);
  EXPECT_NEAR(nis / static_cast<double>(result.counters.ranges[RangeOutcome::kUsed]), 1.0, 0.25);
}

TEST_F(ReplayTest, IsCausal) {
  const ReplayResult whole = run();
  // If the inputs are cut anywhere, the rows before are equal bit for bit.
  for (const double cut_s : {0.6, 3.3, 9.05}) {
    const testing::Drive uncut = drive_;
    std::erase_if(drive_.odometry, [&](const model::OdometrySample& row) { return row.t_s > cut_s; });
    std::erase_if(drive_.ranges, [&](const model::RangeSample& range) { return range.t_s > cut_s; });
    const ReplayResult part = run();
    ASSERT_EQ(part.rows.size(), drive_.odometry.size());
    for (std::size_t i = 0; i < part.rows.size(); ++i) EXPECT_TRUE(same(part.rows[i], whole.rows[i])) << i;
    drive_ = uncut;
  }
}

TEST_F(ReplayTest, AnEstimateIncludesTheRangeAtItsOwnTime) {
  drive_.ranges = {{drive_.odometry[40].t_s, 1, 11, 15.0}};
  const ReplayResult with = run();
  drive_.ranges.front().range_m += 0.1;
  const ReplayResult other = run();
  EXPECT_TRUE(same(with.rows[39], other.rows[39]));
  EXPECT_EQ(with.ranges_seen, 1U);
  EXPECT_EQ(with.rows[40].t_s, drive_.odometry[40].t_s);
}

TEST_F(ReplayTest, UsesOnlyInputsBetweenStartAndEnd) {
  options_.start.t_s = 3.02;
  options_.start.pose = drive_.truth[60];
  options_.to_s = 8.0;
  const ReplayResult result = run();
  EXPECT_EQ(result.rows.front().t_s, drive_.odometry[61].t_s);
  EXPECT_LE(result.rows.back().t_s, 8.0);
  EXPECT_GT(result.rows.back().t_s, 7.9);
  std::size_t expected = 0;
  for (const model::RangeSample& range : drive_.ranges) {
    expected += range.t_s >= 3.02 && range.t_s <= result.rows.back().t_s ? 1U : 0U;
  }
  EXPECT_EQ(result.ranges_seen, expected);
  EXPECT_EQ(result.counters.ranges[RangeOutcome::kUsed] + result.counters.ranges[RangeOutcome::kGated],
            expected);
  // The odometry sample before the start is held at the start.
  EXPECT_EQ(result.counters.odometry[OdometryOutcome::kStored], 1U);
}

TEST_F(ReplayTest, CountsRangesToAnchorsThatTheCalibrationLacks) {
  calibration_.anchors.erase(calibration_.anchors.begin() + 2);
  const ReplayResult result = run();
  EXPECT_GT(result.counters.ranges[RangeOutcome::kUnknownAnchor], 100U);
  EXPECT_EQ(result.counters.ranges[RangeOutcome::kUnknownAnchor] +
                result.counters.ranges[RangeOutcome::kUsed] + result.counters.ranges[RangeOutcome::kGated],
            result.ranges_seen);
}

TEST_F(ReplayTest, TimesEachCallWithTheGivenClock) {
  EXPECT_EQ(run().update_ns.p50, 0.0);
  std::int64_t now = 0;
  options_.now_ns = [&now] { return now += 7; };
  const ReplayResult result = run();
  EXPECT_EQ(result.propagate_ns.p50, 7.0);
  EXPECT_EQ(result.update_ns.p99, 7.0);
}

TEST_F(ReplayTest, WithoutInputThereIsNoOutput) {
  drive_ = {};
  const ReplayResult result = run();
  EXPECT_TRUE(result.rows.empty());
}

TEST(StartFromPrior, IsTheFirstPoseAtOrAfterTheTime) {
  const std::vector<model::PoseSample> priors{{1.0, 1.0, 2.0, 0.0, 0.5}, {2.0, 3.0, 4.0, 0.0, 0.6}};
  const model::Surface flat;
  EXPECT_EQ(start_from_prior(priors, -10.0, flat)->t_s, 1.0);
  EXPECT_EQ(start_from_prior(priors, 1.0, flat)->pose.x_m, 1.0);
  EXPECT_EQ(start_from_prior(priors, 1.5, flat)->pose.y_m, 4.0);
  EXPECT_EQ(start_from_prior(priors, 1.5, flat)->pose.theta_rad, 0.6);
  EXPECT_FALSE(start_from_prior(priors, 2.5, flat).has_value());
  EXPECT_FALSE(start_from_prior({}, 0.0, flat).has_value());
}

TEST(StartFromPrior, TakesTheHeadingOnTheSurfaceFromAFullAttitude) {
  const model::Surface slope = model::Plane(0.0, {-0.11, 0.05, 1.0});
  const double heading = 0.9;
  const Eigen::Matrix3d rotation = model::pose_on_surface(slope, {1.0, 2.0, heading}).pose.rotation;
  model::PoseSample pose{0.0, 1.0, 2.0, 0.0, std::atan2(rotation(1, 0), rotation(0, 0))};
  // Without roll and pitch the yaw is the heading.
  EXPECT_EQ(start_from_prior(std::vector{pose}, 0.0, slope)->pose.theta_rad, pose.yaw_rad);
  EXPECT_GT(std::abs(pose.yaw_rad - heading), 1e-3);
  pose.pitch_rad = -std::asin(rotation(2, 0));
  pose.roll_rad = std::atan2(rotation(2, 1), rotation(2, 2));
  EXPECT_NEAR(start_from_prior(std::vector{pose}, 0.0, slope)->pose.theta_rad, heading, 1e-12);
}

TEST_F(ReplayTest, WithoutAStartThePoseIsFound) {
  options_.knows_start = false;
  const ReplayResult result = run();
  ASSERT_FALSE(result.rows.empty());
  ASSERT_EQ(result.states.size(), result.rows.size());
  EXPECT_GT(result.rows.front().t_s, 0.0);
  EXPECT_LT(result.rows.front().t_s, 6.0);
  EXPECT_EQ(result.states.back().state, State::kTracking);
  EXPECT_LT(std::hypot(result.rows.back().x_m - drive_.truth.back().x_m,
                       result.rows.back().y_m - drive_.truth.back().y_m),
            0.3);
}

TEST_F(ReplayTest, AnObserverSeesAnNlosPairAndChangesNothing) {
  for (model::RangeSample& range : drive_.ranges) {
    if (range.anchor_id == 13 && range.t_s > 5.0 && range.t_s < 8.0) range.range_m += 2.0;
  }
  const ReplayResult without = run();
  std::size_t seen = 0;
  Eigen::Vector3d corrected_by_nlos = Eigen::Vector3d::Zero();
  options_.on_range = [&](const Tracker& tracker, const model::RangeSample& range,
                          const RangeResult& result) {
    ++seen;
    EXPECT_EQ(tracker.estimate().t_s, range.t_s);
    const bool nlos = range.anchor_id == 13 && range.t_s > 5.0 && range.t_s < 8.0;
    EXPECT_EQ(result.weight < 0.5 && result.innovation_m > 1.0, nlos) << range.t_s;
    if (nlos) corrected_by_nlos += result.correction;
  };
  const ReplayResult with = run();
  EXPECT_EQ(seen, with.ranges_seen);
  EXPECT_LT(corrected_by_nlos.head<2>().norm(), 0.01);
  ASSERT_EQ(with.rows.size(), without.rows.size());
  for (std::size_t i = 0; i < with.rows.size(); ++i) EXPECT_TRUE(same(with.rows[i], without.rows[i]));
}

TEST_F(ReplayTest, OtherSensorsAreProcessedInOrderOfTime) {
  drive_.ranges.clear();
  model::SensorTables sensors;
  std::vector<model::PositionSample>& positions = model::samples_of<model::PositionSample>(sensors);
  for (std::size_t i = 0; i < drive_.truth.size(); i += 4) {
    positions.push_back(
        {drive_.odometry[i].t_s, drive_.truth[i].x_m, drive_.truth[i].y_m, {0.01, 0.0, 0.01}});
  }
  const ReplayResult result = replay({.odometry = drive_.odometry,
                                      .ranges = {},
                                      .tags = tags_,
                                      .surface = &surface_,
                                      .calibration = &calibration_,
                                      .sensors = &sensors},
                                     options_);
  const auto& counters = result.counters.sensors[model::kSensorOf<model::PositionSample>];
  EXPECT_EQ(counters[SensorOutcome::kUsed], positions.size());
  EXPECT_EQ(counters[SensorOutcome::kOutOfOrder], 0U);
  EXPECT_LT(std::hypot(result.rows.back().x_m - drive_.truth.back().x_m,
                       result.rows.back().y_m - drive_.truth.back().y_m),
            0.1);
}

}  // namespace
}  // namespace groma::filter
