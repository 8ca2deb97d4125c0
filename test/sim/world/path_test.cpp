#include "firmware/sim/world/path.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>

namespace groma::sim {
namespace {

const std::vector<Waypoint> kSquare = {
    {0.0, 0.0, {}, 0.0}, {8.0, 0.0, {}, 0.0}, {8.0, 5.0, {}, 2.0}, {0.0, 5.0, {}, 0.0}};

TEST(Path, VelocityIsTheDerivativeOfPosition) {
  const Path path(kSquare, {});
  constexpr double kStep_s = 1e-5;
  for (double t = 0.01; t < path.duration_s(); t += 0.0713) {
    const PlanarMotion before = path.at(t - kStep_s);
    const PlanarMotion after = path.at(t + kStep_s);
    const PlanarMotion at = path.at(t);
    EXPECT_NEAR((after.x_m - before.x_m) / (2.0 * kStep_s), at.vx_mps, 1e-7) << t;
    EXPECT_NEAR((after.y_m - before.y_m) / (2.0 * kStep_s), at.vy_mps, 1e-7) << t;
    EXPECT_NEAR((after.theta_rad - before.theta_rad) / (2.0 * kStep_s), at.theta_radps, 1e-7) << t;
  }
}

TEST(Path, AccelerationDoesNotJumpAndKeepsItsLimits) {
  PathOptions options;
  options.max_speed_mps = 1.3;
  options.max_acceleration_mps2 = 0.6;
  options.max_yaw_rate_radps = 0.7;
  const Path path(kSquare, options);
  constexpr double kStep_s = 1e-4;
  const auto acceleration = [&](double t) {
    const PlanarMotion a = path.at(t);
    const PlanarMotion b = path.at(t + kStep_s);
    return std::array{(b.vx_mps - a.vx_mps) / kStep_s, (b.vy_mps - a.vy_mps) / kStep_s};
  };
  double fastest = 0.0;
  for (double t = 0.0; t < path.duration_s() - 0.01; t += 0.0031) {
    const PlanarMotion at = path.at(t);
    const auto now = acceleration(t);
    const auto next = acceleration(t + 2e-4);
    EXPECT_NEAR(now[0], next[0], 0.02) << t;
    EXPECT_NEAR(now[1], next[1], 0.02) << t;
    // Along and across the path at once: a factor of root two.
    EXPECT_LE(std::hypot(now[0], now[1]), 1.45 * options.max_acceleration_mps2) << t;
    EXPECT_LE(std::hypot(at.vx_mps, at.vy_mps), options.max_speed_mps + 1e-9) << t;
    EXPECT_LE(std::abs(at.theta_radps), 1.001 * options.max_yaw_rate_radps) << t;
    fastest = std::max(fastest, std::hypot(at.vx_mps, at.vy_mps));
  }
  EXPECT_GT(fastest, 0.95 * options.max_speed_mps);
}

TEST(Path, PassesItsWaypointsInTimeAndStopsWhereRequired) {
  PathOptions options;
  options.corner_radius_m = 0.5;
  const Path path(kSquare, options);
  ASSERT_EQ(path.waypoint_times_s().size(), kSquare.size());
  for (std::size_t i = 0; i < kSquare.size(); ++i) {
    const PlanarMotion at = path.at(path.waypoint_times_s()[i]);
    const bool corner = i != 0 && i + 1 != kSquare.size();
    EXPECT_LT(std::hypot(at.x_m - kSquare[i].x_m, at.y_m - kSquare[i].y_m), corner ? 0.25 : 0.01) << i;
  }
  const double leaves_s = path.waypoint_times_s()[2];
  for (double before_s = 0.3; before_s < 1.7; before_s += 0.1) {
    const PlanarMotion at = path.at(leaves_s - before_s);
    EXPECT_LT(std::hypot(at.vx_mps, at.vy_mps), 1e-6) << before_s;
  }
}

TEST(Path, ADifferentialRobotHeadsAlongItsVelocity) {
  const Path path(kSquare, {});
  for (double t = 0.0; t < path.duration_s(); t += 0.05) {
    const PlanarMotion at = path.at(t);
    const double speed = std::hypot(at.vx_mps, at.vy_mps);
    if (speed < 0.05) continue;
    const double sideways = -std::sin(at.theta_rad) * at.vx_mps + std::cos(at.theta_rad) * at.vy_mps;
    EXPECT_LT(std::abs(sideways), 0.03 * speed + 0.005) << t;
  }
}

// East, back to the south-west, and on to the north.
TEST(Path, ACarReversesWhereItsPathDoublesBack) {
  const std::vector<Waypoint> turn{{0.0, 0.0, {}, 0.0},
                                   {8.0, 0.0, {}, 0.0},
                                   {4.0, 0.0, {}, 0.0},
                                   {4.0, -4.0, {}, 0.0},
                                   {4.0, 6.0, {}, 0.0}};
  PathOptions options;
  options.drive = Drive::kCar;
  options.corner_radius_m = 2.0;
  const Path path(turn, options);
  EXPECT_NEAR(path.least_radius_m(), 1.996, 1e-3);
  const auto speed_at = [&](double t_s) {
    const PlanarMotion at = path.at(t_s);
    return std::cos(at.theta_rad) * at.vx_mps + std::sin(at.theta_rad) * at.vy_mps;
  };
  const std::vector<double>& passes_s = path.waypoint_times_s();
  EXPECT_GT(speed_at(passes_s[1] - 4.0), 0.3);
  EXPECT_NEAR(speed_at(passes_s[1] - 0.3), 0.0, 1e-6);
  EXPECT_LT(speed_at(0.5 * (passes_s[1] + passes_s[2])), -0.3);
  EXPECT_GT(speed_at(0.5 * (passes_s[3] + passes_s[4])), 0.3);
  // It turns to the left in reverse, and ends with its front to the north.
  EXPECT_NEAR(path.at(passes_s[3]).theta_rad, 0.5 * std::numbers::pi, 1e-6);
  EXPECT_NEAR(path.at(path.duration_s()).theta_rad, 0.5 * std::numbers::pi, 1e-6);
  EXPECT_NEAR(path.at(path.duration_s()).y_m, 6.0, 1e-6);
  for (double t = 0.0; t < path.duration_s(); t += 0.05) {
    const PlanarMotion at = path.at(t);
    const double sideways = -std::sin(at.theta_rad) * at.vx_mps + std::cos(at.theta_rad) * at.vy_mps;
    EXPECT_LT(std::abs(sideways), 0.03 * std::abs(speed_at(t)) + 0.005) << t;
  }
}

TEST(Path, TurnsTowardsTheHeadingsOfAnOmnidirectionalRobot) {
  std::vector<Waypoint> waypoints = kSquare;
  waypoints[0].yaw_rad = 3.0;
  waypoints[2].yaw_rad = -3.0;  // the short way, through pi
  PathOptions options;
  options.drive = Drive::kOmnidirectional;
  const Path path(waypoints, options);
  EXPECT_NEAR(path.at(0.0).theta_rad, 3.0, 1e-9);
  EXPECT_NEAR(path.at(path.waypoint_times_s()[2] - 0.5).theta_rad, 2.0 * std::numbers::pi - 3.0, 1e-6);
  EXPECT_NEAR(path.at(path.duration_s()).theta_rad, 2.0 * std::numbers::pi - 3.0, 1e-9);
}

TEST(Path, IsStationaryBeforeItsBeginAndAfterItsEnd) {
  const Path path(kSquare, {});
  for (const double t : {-10.0, -0.01, path.duration_s() + 0.01, 1e6}) {
    const PlanarMotion at = path.at(t);
    EXPECT_EQ(at.vx_mps, 0.0);
    EXPECT_EQ(at.theta_radps, 0.0);
  }
  EXPECT_NEAR(path.at(-10.0).x_m, kSquare.front().x_m, 1e-9);
  EXPECT_NEAR(path.at(1e6).y_m, kSquare.back().y_m, 1e-9);
}

TEST(Path, ClosesALoopWithoutAJump) {
  PathOptions options;
  options.loop = true;
  const Path path(kSquare, options);
  const double round_s = path.duration_s();
  const PlanarMotion end = path.at(round_s - 1e-6);
  const PlanarMotion begin = path.at(round_s + 1e-6);
  EXPECT_NEAR(end.x_m, begin.x_m, 1e-5);
  EXPECT_NEAR(end.y_m, begin.y_m, 1e-5);
  EXPECT_NEAR(std::remainder(end.theta_rad - begin.theta_rad, 2.0 * std::numbers::pi), 0.0, 1e-5);
  const PlanarMotion first = path.at(7.3);
  const PlanarMotion third = path.at(7.3 + 2.0 * round_s);
  EXPECT_NEAR(first.x_m, third.x_m, 1e-9);
  EXPECT_NEAR(first.vy_mps, third.vy_mps, 1e-9);
}

}  // namespace
}  // namespace groma::sim
