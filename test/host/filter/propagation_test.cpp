#include "host/filter/propagation.hpp"

#include <gtest/gtest.h>

#include <cmath>

#include "host/model/surface.hpp"
#include "test/host/filter/small_site.hpp"
#include "test/support/numerical_jacobian.hpp"

namespace groma::filter {
namespace {

using test::numerical_jacobian;
using test::Random;

CoreVector some_core(Random& random) {
  CoreVector core;
  core << random.uniform(-15.0, 15.0), random.uniform(-15.0, 15.0), random.uniform(-3.0, 3.0),
      0.02 * random.gaussian(), 0.01 * random.gaussian(), 0.01 * random.gaussian(), 0.1 * random.gaussian(),
      0.1 * random.gaussian(), 0.05 * random.gaussian();
  return core;
}

model::OdometrySample some_row(Random& random) {
  return {0.0, 2.0 * random.gaussian(), random.gaussian(), random.gaussian()};
}

Eigen::Vector3d true_velocity(const CoreVector& core, const model::OdometrySample& row) {
  return {(1.0 + core(kScale)) * row.vx_mps - core(kOdometryVx),
          (1.0 + core(kScale)) * row.vy_mps - core(kOdometryVy),
          row.omega_radps - core(kYawBias) - core(kOdometryOmega)};
}

double error_of_step(const model::Surface& surface, const CoreVector& core, const model::OdometrySample& row,
                     double dt_s) {
  const model::PlanarPose fine =
      testing::integrate(surface, {core(kX), core(kY), core(kTheta)}, true_velocity(core, row), dt_s, 200);
  const Eigen::Vector3d pose = move(surface, core, row, dt_s).pose;
  return (pose - Eigen::Vector3d(fine.x_m, fine.y_m, fine.theta_rad)).norm();
}

TEST(Move, IsExactOnAPlane) {
  const model::Surface slope = model::Plane(1.0, {0.2, -0.1, 1.0});
  Random random(1);
  for (int i = 0; i < 50; ++i) {
    const CoreVector core = some_core(random);
    EXPECT_LT(error_of_step(slope, core, some_row(random), 2.0), 1e-9);
  }
}

TEST(Move, FollowsACurvedSurfaceToSecondOrder) {
  const model::Surface surface = testing::hills(0.5);
  Random random(2);
  double coarse = 0.0;
  double fine = 0.0;
  for (int i = 0; i < 200; ++i) {
    const CoreVector core = some_core(random);
    const model::OdometrySample row = some_row(random);
    coarse += error_of_step(surface, core, row, kMaxStep_s);
    fine += error_of_step(surface, core, row, 0.5 * kMaxStep_s);
  }
  EXPECT_LT(coarse / 200.0, 1e-6);
  // The error of one step is of third order in its length.
  EXPECT_NEAR(coarse / fine, 8.0, 0.5);
}

TEST(Move, KeepsThePathsLengthOnTheSurface) {
  // On a plane of slope 1, one metre driven uphill is 1/sqrt(2) m in the xy-plane.
  const model::Surface slope = model::Plane(0.0, {-1.0, 0.0, 1.0});
  const Motion motion = move(slope, CoreVector::Zero(), {0.0, 1.0, 0.0, 0.0}, 1.0);
  EXPECT_NEAR(motion.pose.x(), std::sqrt(0.5), 1e-12);
  EXPECT_NEAR(motion.pose.y(), 0.0, 1e-12);
}

TEST(Move, DerivativesEqualNumericalOnes) {
  const model::Surface surface = testing::hills(1.0);
  Random random(3);
  for (const double dt_s : {0.05, 0.01, 0.0, -0.02, 1.0}) {
    for (int i = 0; i < 100; ++i) {
      const CoreVector core = some_core(random);
      // Turning and nearly straight motion: mean_turn uses a series for small angles.
      model::OdometrySample row = some_row(random);
      if (i % 4 == 0) row.omega_radps = core(kYawBias) + core(kOdometryOmega) + 1e-6 * random.gaussian();
      const Eigen::MatrixXd numerical = numerical_jacobian(
          [&](const Eigen::VectorXd& x) {
            return Eigen::VectorXd(move(surface, CoreVector(x), row, dt_s).pose);
          },
          core, 1e-6);
      EXPECT_LT((move(surface, core, row, dt_s).d_core - numerical).cwiseAbs().maxCoeff(), 3e-6) << dt_s;
    }
  }
}

TEST(Move, IsContinuousWhereTheTurnVanishes) {
  const model::Surface surface = testing::hills(0.5);
  const CoreVector core = CoreVector::Zero();
  // Both sides of the switch to the series.
  const Eigen::Vector3d below = move(surface, core, {0.0, 1.0, 0.2, 1.9999}, 1e-3).pose;
  const Eigen::Vector3d above = move(surface, core, {0.0, 1.0, 0.2, 2.0001}, 1e-3).pose;
  EXPECT_LT((below - above).norm(), 1e-6);
  EXPECT_TRUE(move(surface, core, {0.0, 1.0, 0.2, 0.0}, 1e-3).d_core.allFinite());
}

TEST(BodyVelocity, IsTheMotionAlongTheSurfaceInTheRobotsAxes) {
  const model::Surface surface = testing::hills(1.0);
  Random random(5);
  for (int i = 0; i < 100; ++i) {
    const CoreVector core = some_core(random);
    const model::OdometrySample row = some_row(random);
    const double h = 1e-6;
    const auto place = [&](double dt_s) {
      const Eigen::Vector3d at = move(surface, core, row, dt_s).pose;
      return model::pose_on_surface(surface, {at.x(), at.y(), at.z()}).pose;
    };
    const Eigen::Vector3d moved = (place(h).position_m - place(-h).position_m) / (2.0 * h);
    const Eigen::Vector3d numerical = place(0.0).rotation.transpose() * moved;
    const BodyVelocity velocity = body_velocity(core, row);
    EXPECT_LT((velocity.value.head<2>() - numerical.head<2>()).norm(), 1e-7);
    EXPECT_NEAR(numerical.z(), 0.0, 1e-7);
    EXPECT_EQ(velocity.value.z(), true_velocity(core, row).z());
    const Eigen::MatrixXd jacobian = numerical_jacobian(
        [&](const Eigen::VectorXd& x) { return Eigen::VectorXd(body_velocity(CoreVector(x), row).value); },
        core, 1e-6);
    EXPECT_LT((velocity.d_core - jacobian).cwiseAbs().maxCoeff(), 1e-8);
  }
}

TEST(PoseRate, IsTheLimitOfAStep) {
  const model::Surface surface = testing::hills(1.0);
  Random random(4);
  for (int i = 0; i < 100; ++i) {
    const CoreVector core = some_core(random);
    const model::OdometrySample row = some_row(random);
    const double h = 1e-6;
    const Eigen::Vector3d numerical =
        (move(surface, core, row, h).pose - move(surface, core, row, -h).pose) / (2.0 * h);
    const model::SurfacePose at = model::pose_on_surface(surface, {core(kX), core(kY), core(kTheta)});
    EXPECT_LT((pose_rate(at.pose.rotation.topLeftCorner<2, 2>(), core, row) - numerical).norm(), 1e-7);
  }
}

}  // namespace
}  // namespace groma::filter
