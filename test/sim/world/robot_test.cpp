#include "firmware/sim/world/robot.hpp"

#include <gtest/gtest.h>

#include <cmath>

#include <Eigen/Dense>

#include "firmware/sim/world/uneven_ground.hpp"

namespace groma::sim {
namespace {

model::Surface hilly_ground() {
  return uneven_ground({-6.0, -6.0, 1.0, 1.0, 30, 24},
                       {{{-5.0, -5.0}, {20.0, 15.0}, 2.0, {0.05, -0.02}, 0.15, 3.0}}, 3);
}

Robot robot(const OdometryOptions& odometry, const PosePriorOptions& prior, std::uint64_t seed = 1) {
  const std::vector<Waypoint> waypoints = {{0.0, 0.0, 0.2, 0.0},
                                           {8.0, 0.0, 1.5, 1.0},
                                           {8.0, 5.0, {}, 0.0},
                                           {0.0, 6.0, -2.0, 0.0},
                                           {1.0, 1.0, 0.5, 0.0}};
  PathOptions options;
  options.drive = Drive::kOmnidirectional;
  return {hilly_ground(), Path(waypoints, options), odometry, prior, KeyedRandom(seed)};
}

OdometryOptions exact_odometry() {
  OdometryOptions options;
  options.noise = {0.0, 0.0, 0.0};
  options.scale_sigma = 0.0;
  options.yaw_rate_bias_sigma_radps = 0.0;
  return options;
}

TEST(Robot, BodyVelocityIsTheNumericalDerivativeOfThePose) {
  const Robot subject = robot({}, {});
  constexpr double kStep_s = 1e-5;
  double steepest = 0.0;
  for (double t = 0.5; t < subject.path().duration_s(); t += 0.219) {
    const model::RigidPose before = subject.pose(t - kStep_s).pose;
    const model::RigidPose after = subject.pose(t + kStep_s).pose;
    const Eigen::Matrix3d rotation = subject.pose(t).pose.rotation;
    const Eigen::Vector3d velocity =
        rotation.transpose() * (after.position_m - before.position_m) / (2.0 * kStep_s);
    const Eigen::Matrix3d spin = rotation.transpose() * (after.rotation - before.rotation) / (2.0 * kStep_s);
    const BodyVelocity body = subject.velocity(t);
    EXPECT_NEAR(body.vx_mps, velocity.x(), 1e-6) << t;
    EXPECT_NEAR(body.vy_mps, velocity.y(), 1e-6) << t;
    EXPECT_NEAR(velocity.z(), 0.0, 1e-6) << t;
    EXPECT_NEAR(body.omega_radps, 0.5 * (spin(1, 0) - spin(0, 1)), 1e-6) << t;
    steepest = std::max(steepest, std::abs(rotation(2, 0)));
  }
  EXPECT_GT(steepest, 0.05) << "the test has to be on a slope";
}

TEST(Robot, OdometryIsNoisierInASlipperyArea) {
  OdometryOptions options;
  options.areas = {{{4.0, -10.0}, {20.0, 10.0}, 5.0}};
  const Robot subject = robot(options, {});
  const Robot exact = robot(exact_odometry(), {});
  const auto spread = [&](bool is_inside) {
    double squares = 0.0;
    double count = 0.0;
    for (std::uint64_t k = 0; k < 1500; ++k) {
      const model::OdometrySample sample = subject.odometry(k);
      const double x_m = subject.truth(sample.t_s).x_m;
      if ((x_m > 4.0) != is_inside) continue;
      squares += std::pow(sample.vy_mps - exact.odometry(k).vy_mps, 2);
      count += 1.0;
    }
    EXPECT_GT(count, 300.0);
    return std::sqrt(squares / count);
  };
  EXPECT_NEAR(spread(false), options.noise.sigma_vy_mps, 0.15 * options.noise.sigma_vy_mps);
  EXPECT_NEAR(spread(true), 5.0 * options.noise.sigma_vy_mps, 0.75 * options.noise.sigma_vy_mps);
}

TEST(Robot, TouchesTheGroundAndIsParallelToIt) {
  const Robot subject = robot({}, {});
  for (double t = 0.0; t < subject.path().duration_s(); t += 0.5) {
    const model::SurfacePose pose = subject.pose(t);
    const model::PoseSample truth = subject.truth(t);
    const model::SurfacePoint ground = subject.ground().at(truth.x_m, truth.y_m);
    EXPECT_NEAR(truth.z_m, ground.z_m, 1e-12);
    const Eigen::Vector3d normal =
        Eigen::Vector3d(-ground.gradient.x(), -ground.gradient.y(), 1.0).normalized();
    EXPECT_LT((pose.pose.rotation.col(2) - normal).norm(), 1e-12);
  }
}

// Integrates odometry samples as rigid motions, independently of the filter's propagation.
TEST(Robot, NoiseFreeSamplesReproduceThePath) {
  const Robot subject = robot(exact_odometry(), {});
  const auto samples =
      static_cast<std::uint64_t>(subject.path().duration_s() * subject.odometry_options().rate_hz);
  const double interval_s = 1.0 / subject.odometry_options().rate_hz;
  model::PoseSample start = subject.truth(0.0);
  Eigen::Vector2d at(start.x_m, start.y_m);
  double theta = start.yaw_rad;
  for (std::uint64_t k = 0; k < samples; ++k) {
    const model::OdometrySample sample = subject.odometry(k);
    constexpr int kSteps = 4;
    for (int i = 0; i < kSteps; ++i) {
      const double dt = interval_s / kSteps;
      const model::SurfacePose pose =
          model::pose_on_surface(subject.ground(), {at.x(), at.y(), theta + 0.5 * dt * sample.omega_radps});
      const Eigen::Vector3d step =
          pose.pose.rotation * Eigen::Vector3d(sample.vx_mps, sample.vy_mps, 0.0) * dt;
      // The rotation of the body about its own normal that the change of the ground's tilt alone causes.
      const Eigen::Matrix3d tilting = pose.rotation_wt.transpose() *
                                      (pose.d_rotation_wt_d_x * step.x() + pose.d_rotation_wt_d_y * step.y());
      at += step.head<2>();
      theta += sample.omega_radps * dt - 0.5 * (tilting(1, 0) - tilting(0, 1));
    }
  }
  const model::PoseSample end = subject.truth(static_cast<double>(samples) * interval_s);
  EXPECT_NEAR(at.x(), end.x_m, 2e-3);
  EXPECT_NEAR(at.y(), end.y_m, 2e-3);
  EXPECT_NEAR(model::wrap_angle(theta - end.yaw_rad), 0.0, 5e-4);
}

// Ahead, back around a corner, ahead again; on a plane.
Robot car(const CarOdometryOptions& steering, double scale_sigma, std::uint64_t seed = 1) {
  PathOptions options;
  options.drive = Drive::kCar;
  options.corner_radius_m = 2.5;
  OdometryOptions odometry;
  odometry.scale_sigma = scale_sigma;
  odometry.car = steering;
  return {model::Surface(),
          Path({{0.0, 0.0, {}, 0.0},
                {10.0, 0.0, {}, 0.0},
                {4.0, 0.0, {}, 0.0},
                {4.0, -6.0, {}, 0.0},
                {4.0, 8.0, {}, 0.0}},
               options),
          odometry,
          {},
          KeyedRandom(seed)};
}

CarOdometryOptions exact_steering() {
  return {.vehicle = {.wheelbase_m = 1.6, .sigma_speed_mps = 0.0, .sigma_steering_rad = 0.0},
          .wheelbase_scale_sigma = 0.0,
          .steering_offset_sigma_rad = 0.0,
          .understeer_s2pm2 = 0.0};
}

// Rolls the rear axle along the circles that the front wheel gives.
TEST(Robot, ExactSteeringReproducesACarsPath) {
  const Robot subject = car(exact_steering(), 0.0);
  const double interval_s = 1.0 / subject.odometry_options().rate_hz;
  const auto samples = static_cast<std::uint64_t>(subject.path().duration_s() / interval_s);
  double theta = subject.truth(0.0).yaw_rad;
  Eigen::Vector2d base_m(0.0, 0.0);
  double backwards_m = 0.0;
  for (std::uint64_t k = 0; k < samples; ++k) {
    const model::SteeringSample sample = subject.steering(k);
    const double way_m = sample.speed_mps * interval_s;
    const double turn = way_m * std::tan(sample.steering_rad) / 1.6;
    const Eigen::Vector2d middle(std::cos(theta + 0.5 * turn), std::sin(theta + 0.5 * turn));
    theta += turn;
    base_m += way_m * middle;
    backwards_m += std::max(0.0, -way_m);
    EXPECT_LT(std::abs(sample.steering_rad), std::atan(1.6 / 2.2)) << k;
  }
  EXPECT_NEAR(backwards_m, 10.9, 0.2);
  const model::PoseSample end = subject.truth(subject.path().duration_s());
  EXPECT_NEAR(model::wrap_angle(theta - end.yaw_rad), 0.0, 2e-3);
  EXPECT_LT((base_m - Eigen::Vector2d(end.x_m, end.y_m)).norm(), 0.05);
}

TEST(Robot, ACarsErrorsAreThoseOfItsWheelbaseAngleAndSlips) {
  double squares = 0.0;
  constexpr int kSeeds = 400;
  for (int seed = 0; seed < kSeeds; ++seed) {
    CarOdometryOptions steering = exact_steering();
    steering.steering_offset_sigma_rad = 0.01;
    const Robot subject = car(steering, 0.0, static_cast<std::uint64_t>(seed));
    const double offset_rad = subject.steering(150).steering_rad;  // on the first leg
    squares += offset_rad * offset_rad;
    EXPECT_NEAR(subject.steering(200).steering_rad, offset_rad, 1e-3);
  }
  EXPECT_NEAR(std::sqrt(squares / kSeeds), 0.01, 0.001);

  OdometryOptions odometry;
  odometry.scale_sigma = 0.0;
  odometry.car = exact_steering();
  odometry.slips = {{.from_s = 3.0, .to_s = 4.0, .scale = 2.0}};
  const Robot exact = car(exact_steering(), 0.0);
  const Robot slipping(model::Surface(), exact.path(), odometry, {}, KeyedRandom(1));
  EXPECT_DOUBLE_EQ(slipping.steering(175).speed_mps, 2.0 * exact.steering(175).speed_mps);
  EXPECT_DOUBLE_EQ(slipping.steering(225).speed_mps, exact.steering(225).speed_mps);
}

TEST(Robot, OdometryErrorsAreWhiteConstantScaleAndBias) {
  const OdometryOptions options;
  const Robot exact = robot(exact_odometry(), {});
  double scales = 0.0;
  double biases = 0.0;
  constexpr int kSeeds = 300;
  for (int seed = 0; seed < kSeeds; ++seed) {
    const Robot subject = robot(options, {}, static_cast<std::uint64_t>(seed));
    double with = 0.0;
    double square = 0.0;
    double turn = 0.0;
    constexpr std::uint64_t kFirst = 150;  // on the first leg, along x
    constexpr std::uint64_t kSamples = 200;
    for (std::uint64_t k = kFirst; k < kFirst + kSamples; ++k) {
      const model::OdometrySample sample = subject.odometry(k);
      const model::OdometrySample exact_sample = exact.odometry(k);
      with += sample.vx_mps * exact_sample.vx_mps + sample.vy_mps * exact_sample.vy_mps;
      square += exact_sample.vx_mps * exact_sample.vx_mps + exact_sample.vy_mps * exact_sample.vy_mps;
      turn += sample.omega_radps - exact_sample.omega_radps;
    }
    const double scale = with / square - 1.0;
    scales += scale * scale;
    biases += (turn / kSamples) * (turn / kSamples);
  }
  // The white part averages out to 0.0014 and 0.0004.
  EXPECT_NEAR(std::sqrt(scales / kSeeds), std::hypot(options.scale_sigma, 0.0016), 0.0012);
  EXPECT_NEAR(std::sqrt(biases / kSeeds), std::hypot(options.yaw_rate_bias_sigma_radps, 0.00042), 0.00012);

  const Robot subject = robot(options, {}, 1);
  double squares = 0.0;
  double neighbours = 0.0;
  double last = 0.0;
  constexpr std::uint64_t kSamples = 1500;
  for (std::uint64_t k = 0; k < kSamples; ++k) {
    const double error = subject.odometry(k).omega_radps - exact.odometry(k).omega_radps;
    squares += error * error;
    neighbours += error * last;
    last = error;
  }
  EXPECT_NEAR(std::sqrt(squares / kSamples), options.noise.sigma_omega_radps, 0.0005);
  EXPECT_NEAR(neighbours / squares, 0.0, 0.1);
}

TEST(Robot, PosePriorErrorsAreCorrelatedAndWhite) {
  const PosePriorOptions options;
  double squares = 0.0;
  double jumps = 0.0;
  double yaws = 0.0;
  int count = 0;
  for (std::uint64_t seed = 0; seed < 100; ++seed) {
    const Robot subject = robot({}, options, seed);
    double last = 0.0;
    for (std::uint64_t k = 0; k < 200; ++k) {
      const model::PoseSample sample = subject.pose_prior(k);
      const model::PoseSample truth = subject.truth(sample.t_s);
      const double error = sample.x_m - truth.x_m;
      const double yaw = model::wrap_angle(sample.yaw_rad - truth.yaw_rad);
      squares += error * error;
      yaws += yaw * yaw;
      if (k > 0) jumps += (error - last) * (error - last);
      last = error;
      ++count;
      EXPECT_NEAR(sample.z_m, subject.ground().at(sample.x_m, sample.y_m).z_m, 1e-12);
    }
  }
  EXPECT_NEAR(std::sqrt(squares / count), std::hypot(options.correlated_sigma_m, options.white_sigma_m),
              0.002);
  EXPECT_NEAR(std::sqrt(yaws / count), std::hypot(options.correlated_sigma_rad, options.white_sigma_rad),
              0.0003);
  EXPECT_NEAR(std::sqrt(jumps / count), std::sqrt(2.0) * options.white_sigma_m, 0.001);
}

TEST(Robot, SamplesDoNotDependOnTheOrderOfQueries) {
  const Robot a = robot({}, {}, 9);
  const Robot b = robot({}, {}, 9);
  (void)b.odometry(700);
  (void)b.pose_prior(300);
  for (const std::uint64_t k : {5U, 100U, 17U}) {
    EXPECT_EQ(a.odometry(k).vx_mps, b.odometry(k).vx_mps);
    EXPECT_EQ(a.pose_prior(k).x_m, b.pose_prior(k).x_m);
  }
}

}  // namespace
}  // namespace groma::sim
