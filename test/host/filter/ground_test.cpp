// The filter on floors above each other with a ramp between them, and on ground that deviates from its
// surface model.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

#include "host/filter/tracker.hpp"
#include "test/host/filter/small_site.hpp"

namespace groma::filter {
namespace {

using test::Random;

constexpr int kGround = 0;
constexpr int kRamp = 1;
constexpr int kUpper = 2;
constexpr double kRow_s = 0.05;

// A hall, a 20 % ramp at its east end that leads 3 m up, and an upper floor with a gallery above the hall.
model::Surface two_floors() {
  model::Chart ground{"ground", model::Plane(0.0, {0.0, 0.0, 1.0}), {}, {}};
  ground.domain_m = {{-20.0, -10.0}, {10.0, -10.0}, {10.0, 10.0}, {-20.0, 10.0}};
  model::Chart ramp{"ramp", model::Plane(-2.0, {-0.2, 0.0, 1.0}), {}, {}};
  ramp.domain_m = {{9.5, -3.0}, {25.5, -3.0}, {25.5, 3.0}, {9.5, 3.0}};
  model::Chart upper{"upper", model::Plane(3.0, {0.0, 0.0, 1.0}), {}, {}};
  upper.domain_m = {{25.0, -10.0}, {40.0, -10.0}, {40.0, 10.0}, {-20.0, 10.0}, {-20.0, 4.0}, {25.0, 4.0}};
  return model::Surface({ground, ramp, upper});
}

model::Calibration on_both_floors() {
  return testing::calibration_of({{20, {-19.0, -9.0, 2.6}},
                                  {21, {-19.0, 9.0, 2.4}},
                                  {22, {9.0, -9.0, 2.7}},
                                  {23, {9.0, 9.0, 2.2}},
                                  {24, {-5.0, 0.0, 2.8}},
                                  {25, {18.0, -4.0, 4.5}},
                                  {26, {26.0, 9.5, 5.6}},
                                  {27, {39.0, -9.0, 5.4}},
                                  {28, {39.0, 9.0, 5.7}},
                                  {29, {-18.0, 4.5, 5.5}},
                                  {30, {3.0, 9.5, 5.8}}});
}

// A simulated robot that drives from waypoint to waypoint. Its floor follows from its path, independent of
// Surface::follow().
class Robot {
 public:
  Robot(const model::PlanarPose& at, std::vector<Eigen::Vector2d> waypoints, std::uint64_t seed)
      : at_(at), waypoints_(std::move(waypoints)), random_(seed) {}

  [[nodiscard]] const model::PlanarPose& at() const { return at_; }
  [[nodiscard]] bool done() const { return next_ >= waypoints_.size(); }
  [[nodiscard]] double t_s() const { return t_s_; }
  void put_on(int chart) { at_.chart = chart; }

  // Gives the current odometry sample, then the ranges until the next one.
  template <class Estimator>
  void drive(Estimator& estimator) {
    const Eigen::Vector2d way = waypoints_[next_] - Eigen::Vector2d(at_.x_m, at_.y_m);
    if (way.norm() < 0.5) ++next_;
    const double off = model::wrap_angle(std::atan2(way.y(), way.x()) - at_.theta_rad);
    const Eigen::Vector3d velocity(1.5 * std::max(0.05, std::cos(off)), 0.0,
                                   std::clamp(2.0 * off, -1.5, 1.5));
    estimator.process(model::OdometrySample{t_s_, velocity.x() + 0.02 * random_.gaussian(),
                                            0.02 * random_.gaussian(),
                                            velocity.z() + 0.005 * random_.gaussian()});
    const model::Surface chart = std::get<model::Plane>(site_.shape(at_.chart));
    for (double dt_s = 0.01; dt_s < kRow_s; dt_s += 0.02) {
      model::PlanarPose when = testing::integrate(chart, at_, velocity, dt_s, 1);
      const std::size_t tag = turn_ % 3;
      const model::AnchorCalibration& anchor = calibration_.anchors[turn_ / 3 % calibration_.anchors.size()];
      ++turn_;
      const double range_m = model::predict_range(model::pose_on_surface(chart, when).pose,
                                                  testing::three_tags()[tag].lever_arm_m, anchor.position_m,
                                                  model::values_of(anchor.pairs[tag]))
                                 .range_m;
      if (range_m > 30.0) continue;
      estimator.process(model::RangeSample{t_s_ + dt_s, testing::three_tags()[tag].id, anchor.id,
                                           range_m + 0.1 * random_.gaussian()});
    }
    const int before = at_.chart;
    at_ = testing::integrate(chart, at_, velocity, kRow_s, 2);
    at_.chart = before;
    if (before == kGround && at_.x_m > 10.0) at_.chart = kRamp;
    if (before == kRamp && at_.x_m < 10.0) at_.chart = kGround;
    if (before == kRamp && at_.x_m > 25.0) at_.chart = kUpper;
    if (before == kUpper && at_.x_m < 25.0 && std::abs(at_.y_m) < 3.0) at_.chart = kRamp;
    t_s_ += kRow_s;
  }

 private:
  model::Surface site_ = two_floors();
  model::Calibration calibration_ = on_both_floors();
  model::PlanarPose at_;
  std::vector<Eigen::Vector2d> waypoints_;
  Random random_;
  std::size_t next_ = 0;
  std::size_t turn_ = 0;
  double t_s_ = 0.0;
};

double error_m(const model::PlanarPose& a, const model::PlanarPose& b) {
  return std::hypot(a.x_m - b.x_m, a.y_m - b.y_m);
}

TEST(Floors, UpTheRampOverTheGalleryAndDownAgainWithoutAWrongFloor) {
  Robot robot({-10.0, 7.0, -0.5},
              {{0.0, 0.0},
               {9.0, 0.0},
               {27.0, 0.0},
               {30.0, 7.0},
               {-10.0, 7.0},
               {28.0, 7.0},
               {32.0, 0.0},
               {8.0, 0.0},
               {-10.0, 7.0}},
              1);
  Filter filter(two_floors(), testing::three_tags(), on_both_floors(), {});
  filter.start({.t_s = 0.0, .pose = robot.at()});
  double sum_m = 0.0;
  std::size_t rows = 0;
  std::array<int, 3> seen{};
  while (!robot.done()) {
    robot.drive(filter);
    filter.advance_to(robot.t_s());
    const Estimate estimate = filter.estimate();
    const double off_m = error_m(estimate.pose, robot.at());
    ASSERT_LT(off_m, 0.6) << robot.t_s();
    sum_m += off_m;
    ++rows;
    ++seen[static_cast<std::size_t>(estimate.pose.chart)];
    // Near the border of two charts either one is right.
    const double x_m = robot.at().x_m;
    const bool meet = std::abs(x_m - 10.0) < 1.2 || std::abs(x_m - 25.0) < 1.2;
    ASSERT_TRUE(meet || estimate.pose.chart == robot.at().chart) << robot.t_s();
  }
  EXPECT_GT(*std::min_element(seen.begin(), seen.end()), 200);
  EXPECT_LT(sum_m / static_cast<double>(rows), 0.1);
}

// Time until the tracker tracks on the right floor, at most most_s.
double time_to_find(Tracker& tracker, Robot& robot, double most_s) {
  const double from_s = robot.t_s();
  while (robot.t_s() - from_s < most_s && !robot.done()) {
    robot.drive(tracker);
    if (tracker.state() == State::kTracking && tracker.estimate().pose.chart == robot.at().chart &&
        error_m(tracker.estimate().pose, robot.at()) < 0.5) {
      return robot.t_s() - from_s;
    }
  }
  return most_s;
}

TEST(Floors, RelocatesAfterAKidnapToTheOtherFloor) {
  Robot robot({-10.0, 8.0, 0.0}, {{6.0, 7.0}, {-14.0, 6.0}, {6.0, 8.0}, {-14.0, 6.0}, {6.0, 8.0}}, 2);
  Tracker tracker(two_floors(), testing::three_tags(), on_both_floors(), {});
  tracker.start({.t_s = 0.0, .pose = robot.at()});
  while (robot.t_s() < 8.0) robot.drive(tracker);
  ASSERT_EQ(tracker.state(), State::kTracking);
  ASSERT_EQ(tracker.estimate().pose.chart, kGround);
  robot.put_on(kUpper);
  EXPECT_LT(time_to_find(tracker, robot, 15.0), 12.0);
}

TEST(Floors, FindsTheStartOnEitherFloor) {
  for (const int chart : {kGround, kUpper}) {
    Robot robot({-10.0, 8.0, 0.0, chart}, {{6.0, 7.0}, {-14.0, 6.0}, {6.0, 8.0}}, 3);
    Tracker tracker(two_floors(), testing::three_tags(), on_both_floors(), {});
    EXPECT_LT(time_to_find(tracker, robot, 15.0), 10.0) << chart;
  }
}

TEST(Floors, TheTrackerReportsAPoseOffTheSurface) {
  model::Chart small{"", model::Plane(), {{-20.0, -10.0}, {0.0, -10.0}, {0.0, 10.0}, {-20.0, 10.0}}, {}};
  Robot robot({-4.0, 0.0, 0.0}, {{6.0, 0.0}}, 4);
  Tracker tracker(model::Surface({small}), testing::three_tags(), on_both_floors(), {});
  tracker.start({.t_s = 0.0, .pose = robot.at()});
  while (robot.at().x_m < -1.0) robot.drive(tracker);
  EXPECT_EQ(tracker.reason(), Reason::kNone);
  while (robot.at().x_m < 1.0) robot.drive(tracker);
  EXPECT_EQ(tracker.state(), State::kDegraded);
  EXPECT_EQ(tracker.reason(), Reason::kOffSurface);
}

// Random ground around the plane z = 0: a spline with a random height for each knot.
constexpr double kKnot_m = 3.0;
constexpr double kHeightSigma_m = 0.10;
// Sum of squares of the cubic basis functions, averaged over a cell, and of their derivatives.
const double kSquares = 151.0 / 315.0;
const double kSlopes = 2.0 / 3.0;

model::Surface drawn_ground(Random& random) {
  const model::BSpline::Grid grid{-21.0, -21.0, kKnot_m, kKnot_m, 17, 17};
  std::vector<double> heights_m(std::size_t{17} * 17);
  for (double& height_m : heights_m) height_m = kHeightSigma_m / kSquares * random.gaussian();
  return model::BSpline(grid, heights_m);
}

struct GroundFigures {
  double planar = 0.0;   // NEES / 3 of x, y, theta
  double spatial = 0.0;  // of z, roll, pitch
  double inside_95 = 0.0;
};

GroundFigures figures(Model model, bool modelled, int drives) {
  const model::Calibration calibration = testing::calibration_of({{11, {-12.0, -11.0, 7.0}},
                                                                  {12, {13.0, -9.0, 6.0}},
                                                                  {13, {12.0, 12.0, 7.5}},
                                                                  {14, {-11.0, 13.0, 6.5}},
                                                                  {15, {1.0, -14.0, 8.0}},
                                                                  {16, {0.5, 15.0, 7.0}}},
                                                                 0.2);
  model::Chart flat;
  if (modelled) {
    flat.mismatch = {.sigma_m = kHeightSigma_m,
                     .slope_sigma = kHeightSigma_m / kKnot_m * std::sqrt(kSlopes / kSquares),
                     .length_m = 1.25 * kKnot_m};
  }
  Config config;
  config.model = model;
  config.odometry = {0.03, 0.03, 0.01};
  GroundFigures out;
  for (int i = 0; i < drives; ++i) {
    Random random(900 + static_cast<std::uint64_t>(i));
    const model::Surface ground = drawn_ground(random);
    const model::PlanarPose start{1.0, -2.0, 0.4};
    const testing::Drive drive =
        testing::drive(ground, calibration, start, {.duration_s = 15.0, .range_s = 0.01}, random);
    Filter filter(model::Surface({flat}), testing::three_tags(), calibration, config);
    filter.process(drive.odometry.front());
    filter.start({.t_s = 0.0,
                  .pose = {start.x_m + 0.1 * random.gaussian(), start.y_m + 0.1 * random.gaussian(),
                           start.theta_rad + 0.05 * random.gaussian()}});
    std::size_t next = 0;
    for (std::size_t row = 1; row < drive.odometry.size(); ++row) {
      for (; next < drive.ranges.size() && drive.ranges[next].t_s < drive.odometry[row].t_s; ++next)
        filter.process(drive.ranges[next]);
      filter.process(drive.odometry[row]);
    }
    const Estimate estimate = filter.estimate();
    const model::PlanarPose& truth = drive.truth.back();
    const double squared = testing::squared_error(estimate, truth);
    out.planar += squared / (3.0 * drives);
    out.inside_95 += squared <= 7.815 ? 1.0 / drives : 0.0;
    if (!modelled) continue;
    const model::SpatialEstimate allowed =
        model::on_surface(model::Surface({flat}), estimate.pose, estimate.covariance_with_ground());
    const model::SpatialEstimate real = model::on_surface(ground, truth, Eigen::Matrix<double, 6, 6>::Zero());
    const Eigen::Vector3d off(real.z_m - allowed.z_m, real.roll_rad - allowed.roll_rad,
                              real.pitch_rad - allowed.pitch_rad);
    const Eigen::Matrix3d covariance = allowed.covariance.block<3, 3>(2, 2);
    out.spatial += off.dot(covariance.inverse() * off) / (3.0 * drives);
  }
  return out;
}

TEST(GroundMismatch, IsConsistentOverManyDrives) {
  for (const Model model : {Model::kSchmidt, Model::kJoint}) {
    const GroundFigures allowed = figures(model, true, 40);
    const GroundFigures exact = figures(model, false, 15);
    RecordProperty(std::string(model_name(model)) + "_nees", std::to_string(allowed.planar));
    RecordProperty(std::string(model_name(model)) + "_nees_exact", std::to_string(exact.planar));
    RecordProperty(std::string(model_name(model)) + "_inside_95", std::to_string(allowed.inside_95));
    RecordProperty(std::string(model_name(model)) + "_spatial_nees", std::to_string(allowed.spatial));
    // 0.39: three standard deviations of the mean of 40 chi-square(3) / 3.
    EXPECT_GT(allowed.planar, 0.61);
    EXPECT_LT(allowed.planar, 1.39);
    EXPECT_GT(allowed.inside_95, 0.84);
    EXPECT_GT(exact.planar, 1.5 * allowed.planar);
    EXPECT_GT(allowed.spatial, 0.61);
    EXPECT_LT(allowed.spatial, 1.39);
  }
}

}  // namespace
}  // namespace groma::filter
