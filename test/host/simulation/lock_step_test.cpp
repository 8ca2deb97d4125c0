#include "host/simulation/lock_step.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include <Eigen/Cholesky>

#include "host/daemon/localizer.hpp"
#include "host/model/calibration.hpp"
#include "test/host/simulation/small_site.hpp"

namespace groma::simulation {
namespace {

class RecordingSink : public daemon::MeasurementSink {
 public:
  void on_odometry(const model::OdometrySample& sample) override { odometry.push_back(sample); }
  void on_range(const model::RangeSample& range) override { ranges.push_back(range); }
  void on_pose_prior(const model::PoseSample& /*pose*/) override { ++priors; }
  void on_clock_set() override { ++clock_sets; }

  std::vector<model::OdometrySample> odometry;
  std::vector<model::RangeSample> ranges;
  int priors = 0;
  int clock_sets = 0;
};

std::vector<model::RangeSample> ranges_of(const sim::Scenario& site, std::uint64_t seed, double step_s) {
  LockStep run(site, {.seed = seed});
  RecordingSink sink;
  run.session().attach(sink);
  for (double t_s = step_s; t_s < 3.0; t_s += step_s) run.run_until(t_s);
  run.run_until(3.0);
  run.session().flush();
  return sink.ranges;
}

TEST(LockStep, ReceivedRangesMatchTheWorld) {
  sim::Scenario site = small_site();
  LockStep run(site, {.seed = 5});
  RecordingSink sink;
  run.session().attach(sink);
  run.run_until(6.0);
  run.session().flush();

  ASSERT_GT(sink.ranges.size(), 1000U);
  EXPECT_EQ(sink.odometry.size(), 301U);
  EXPECT_EQ(sink.priors, 61);
  EXPECT_EQ(sink.clock_sets, 0);
  EXPECT_EQ(run.session().frames_lost(), 0U);
  double sum = 0.0;
  double squares = 0.0;
  for (const model::RangeSample& range : sink.ranges) {
    const sim::Propagation propagation = run.site().world().between(range.tag_id, range.anchor_id, range.t_s);
    const double error_m = range.range_m - propagation.flight_m;
    EXPECT_LT(std::abs(error_m), 0.15);
    EXPECT_NEAR(range.first_path_power_dbm, propagation.first_path_power_dbm, 1.0);
    sum += error_m;
    squares += error_m * error_m;
  }
  const auto count = static_cast<double>(sink.ranges.size());
  EXPECT_LT(std::abs(sum / count), 0.005) << "antenna delays are applied exactly once";
  EXPECT_LT(std::sqrt(squares / count), 0.035);
}

daemon::Localizer::Setup surveyed(const sim::Scenario& site) {
  daemon::Localizer::Setup setup;
  setup.surface = site.ground;
  setup.tags = site.tags;
  setup.calibration = model::surveyed_calibration(
      site.anchors, site.tags,
      {.sigma_m = site.range_sigma_m, .beta_m = site.biases.beta_m, .gamma = site.biases.gamma}, 0.02);
  setup.filter.odometry = site.odometry.noise;
  setup.filter.range_sigma_m = site.range_sigma_m;
  return setup;
}

// Sums of the squared position error and of the NEES.
struct Squares {
  double position_m2 = 0.0;
  double nees = 0.0;

  void add(const daemon::PoseEstimate& pose, const model::PoseSample& truth) {
    const Eigen::Vector3d error(pose.x_m - truth.x_m, pose.y_m - truth.y_m,
                                model::wrap_angle(pose.yaw_rad - truth.yaw_rad));
    position_m2 += error.head<2>().squaredNorm();
    nees += error.dot(pose.planar_covariance.ldlt().solve(error)) / 3.0;
  }
};

// A live pose is hardly less accurate than the later pose in measurement order, and its covariance is
// consistent.
TEST(LockStep, LivePosesArePromptAndAsAccurateAsSettledOnes) {
  const sim::Scenario site = small_site();
  LockStep run(site, {.seed = 5});
  std::vector<daemon::PoseEstimate> live;
  std::vector<daemon::PoseEstimate> settled;
  double oldest_s = 0.0;
  daemon::Localizer localizer(
      surveyed(site),
      [&](const daemon::PoseEstimate& pose) {
        oldest_s = std::max(oldest_s, run.site().now_s() - pose.t_s);
        live.push_back(pose);
      },
      [&](const daemon::PoseEstimate& pose) { settled.push_back(pose); });
  run.session().attach(localizer);
  run.run_until(20.0);
  run.session().flush();

  EXPECT_LT(oldest_s, 0.02) << "the robot's delay plus a step of the host";
  const double settles_s = live.front().t_s + 2.0;
  Squares at_once;
  Squares in_order;
  std::size_t count = 0;
  auto later = settled.begin();
  for (const daemon::PoseEstimate& pose : live) {
    while (later->t_s < pose.t_s) ++later;
    ASSERT_EQ(later->t_s, pose.t_s);
    if (pose.t_s < settles_s) continue;
    const model::PoseSample truth = run.site().world().robot().truth(pose.t_s);
    at_once.add(pose, truth);
    in_order.add(*later, truth);
    EXPECT_GE(pose.planar_covariance.trace(), 0.9 * later->planar_covariance.trace());
    ++count;
  }
  ASSERT_GT(count, 800U);
  EXPECT_LT(std::sqrt(at_once.position_m2), 1.2 * std::sqrt(in_order.position_m2));
  EXPECT_LT(at_once.nees, 1.2 * in_order.nees);
}

// Its steering reaches the localizer as JSON lines; it reverses twice. The localizer knows neither the error
// of the wheelbase nor the steering's offset.
TEST(LockStep, LocalizesACar) {
  sim::Scenario site = small_site();
  site.biases = {};
  site.path.drive = sim::Drive::kCar;
  site.path.corner_radius_m = 2.0;
  site.odometry = sim::odometry_of({.wheelbase_m = 1.4});
  site.drives = {{"turn around",
                  {{2.0, 2.0, {}, 0.0},
                   {8.0, 2.0, {}, 0.0},
                   {4.0, 2.0, {}, 0.0},
                   {4.0, -2.0, {}, 0.0},
                   {4.0, 6.0, {}, 0.0}}}};
  LockStep run(site, {.seed = 5});
  std::vector<daemon::PoseEstimate> poses;
  daemon::Localizer localizer(surveyed(site),
                              [&](const daemon::PoseEstimate& pose) { poses.push_back(pose); });
  run.session().attach(localizer);
  run.run_until(run.site().world().robot().path().duration_s());
  Squares squares;
  double count = 0.0;
  double backwards_m = 0.0;
  for (const daemon::PoseEstimate& pose : poses) {
    if (pose.t_s < poses.front().t_s + 2.0) continue;
    squares.add(pose, run.site().world().robot().truth(pose.t_s));
    count += 1.0;
    backwards_m += std::max(0.0, -run.site().world().robot().velocity(pose.t_s).vx_mps) / 50.0;
  }
  ASSERT_GT(count, 1000.0);
  EXPECT_GT(backwards_m, 6.0);
  EXPECT_EQ(run.session().counters().steering_unknown, 0U);
  EXPECT_LT(std::sqrt(squares.position_m2 / count), 0.02);
  EXPECT_LT(squares.nees / count, 2.0);
}

TEST(LockStep, ASeedGivesOneResult) {
  const sim::Scenario site = small_site();
  const auto once = ranges_of(site, 3, 0.05);
  const auto again = ranges_of(site, 3, 0.21);
  const auto other = ranges_of(site, 4, 0.05);
  ASSERT_GT(once.size(), 300U);
  ASSERT_EQ(once.size(), again.size());
  for (std::size_t i = 0; i < once.size(); ++i) {
    EXPECT_EQ(once[i].t_s, again[i].t_s);
    EXPECT_EQ(once[i].range_m, again[i].range_m);
    EXPECT_EQ(once[i].anchor_id, again[i].anchor_id);
  }
  EXPECT_NE(once.front().range_m, other.front().range_m);
}

TEST(LockStep, AScheduleThatTheFirmwareRejectsIsAnError) {
  sim::Scenario site = small_site();
  site.schedule.master_id = 99;
  EXPECT_THROW(LockStep(site, {.seed = 1}), sim::SimulationError);
}

TEST(LockStep, ALineTooSlowForItsReportsLosesFramesAndCountsThem) {
  sim::Scenario site = small_site();
  site.link.bit_per_s = 115'200;
  LockStep run(site, {.seed = 5});
  run.run_until(6.0);
  EXPECT_GT(run.session().frames_lost(), 10U);
}

}  // namespace
}  // namespace groma::simulation
