#include "host/model/pose.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>
#include <vector>

#include <Eigen/Geometry>

#include "test/support/numerical_jacobian.hpp"
#include "test/support/random.hpp"

namespace groma::model {
namespace {

using test::numerical_jacobian;
using test::Random;

constexpr double kPi = std::numbers::pi;

Eigen::VectorXd flat(const Eigen::Matrix3d& m) {
  return Eigen::Map<const Eigen::VectorXd>(m.data(), 9);
}

Surface hills() {
  const BSpline::Grid grid{.x0_m = -8.0, .y0_m = -8.0, .dx_m = 1.5, .dy_m = 2.0, .nx = 14, .ny = 11};
  Random random(11);
  std::vector<double> heights(static_cast<std::size_t>(grid.nx) * static_cast<std::size_t>(grid.ny));
  for (double& height : heights) height = 0.5 * random.gaussian();
  return BSpline(grid, heights);
}

TEST(WrapAngle, WrapsToMinusPiToPiByWholeTurns) {
  for (const double angle : {0.0, 1.0, -1.0, kPi, -kPi, 3.0 * kPi, -3.0 * kPi, 1000.0, -1000.0,
                             std::nextafter(kPi, 4.0), std::nextafter(-kPi, -4.0)}) {
    const double wrapped = wrap_angle(angle);
    EXPECT_GT(wrapped, -kPi) << angle;
    EXPECT_LE(wrapped, kPi) << angle;
    EXPECT_NEAR(std::sin(wrapped), std::sin(angle), 1e-12) << angle;
    EXPECT_NEAR(std::cos(wrapped), std::cos(angle), 1e-12) << angle;
  }
  EXPECT_TRUE(std::isnan(wrap_angle(std::nan(""))));
}

TEST(SurfaceRotation, IsTheSmallestRotationFromUpToTheNormal) {
  Random random(12);
  for (int i = 0; i < 200; ++i) {
    const Eigen::Vector2d gradient(2.0 * random.gaussian(), 2.0 * random.gaussian());
    const Eigen::Vector3d normal = Eigen::Vector3d(-gradient.x(), -gradient.y(), 1.0).normalized();
    const Eigen::Matrix3d smallest =
        Eigen::Quaterniond::FromTwoVectors(Eigen::Vector3d::UnitZ(), normal).toRotationMatrix();
    EXPECT_LT((surface_rotation(gradient) - smallest).cwiseAbs().maxCoeff(), 1e-12);
  }
  EXPECT_EQ(surface_rotation(Eigen::Vector2d::Zero()), Eigen::Matrix3d::Identity());
}

TEST(SurfaceRotation, DerivativesEqualNumericalOnes) {
  Random random(13);
  for (int i = 0; i < 100; ++i) {
    const Eigen::Vector2d gradient(random.gaussian(), random.gaussian());
    const SurfaceRotation rotation = surface_rotation_with_derivatives(gradient);
    const Eigen::MatrixXd numerical = numerical_jacobian(
        [](const Eigen::VectorXd& g) { return flat(surface_rotation(Eigen::Vector2d(g))); }, gradient);
    EXPECT_LT((flat(rotation.d_gx) - numerical.col(0)).cwiseAbs().maxCoeff(), 1e-8);
    EXPECT_LT((flat(rotation.d_gy) - numerical.col(1)).cwiseAbs().maxCoeff(), 1e-8);
  }
}

TEST(RotationFromZyx, TurnsAboutZThenYThenX) {
  Random random(14);
  for (int i = 0; i < 50; ++i) {
    const double yaw = random.uniform(-kPi, kPi);
    const double pitch = random.uniform(-1.5, 1.5);
    const double roll = random.uniform(-kPi, kPi);
    const Eigen::Matrix3d expected = (Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitZ()) *
                                      Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()) *
                                      Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitX()))
                                         .toRotationMatrix();
    EXPECT_LT((rotation_from_zyx(yaw, pitch, roll) - expected).cwiseAbs().maxCoeff(), 1e-14);
  }
}

TEST(PoseOnSurface, IsOnTheGroundNormalToItAndRotatedByTheHeading) {
  const Surface surface = hills();
  Random random(15);
  for (int i = 0; i < 100; ++i) {
    const PlanarPose planar{random.uniform(-7.0, 7.0), random.uniform(-7.0, 7.0), random.uniform(-kPi, kPi)};
    const SurfacePoint ground = surface.at(planar.x_m, planar.y_m);
    const SurfacePose pose = pose_on_surface(surface, planar);
    EXPECT_EQ(pose.pose.position_m, Eigen::Vector3d(planar.x_m, planar.y_m, ground.z_m));
    const Eigen::Matrix3d turn =
        Eigen::AngleAxisd(planar.theta_rad, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    EXPECT_LT((pose.pose.rotation - surface_rotation(ground.gradient) * turn).cwiseAbs().maxCoeff(), 1e-14);
    EXPECT_EQ(pose.rotation_wt, surface_rotation(ground.gradient));
  }
}

TEST(PoseOnSurface, DerivativesEqualNumericalOnes) {
  const Surface surface = hills();
  Random random(16);
  for (int i = 0; i < 100; ++i) {
    const Eigen::Vector3d at(random.uniform(-7.0, 7.0), random.uniform(-7.0, 7.0), random.uniform(-kPi, kPi));
    const SurfacePose pose = pose_on_surface(surface, {at.x(), at.y(), at.z()});
    const Eigen::MatrixXd numerical = numerical_jacobian(
        [&](const Eigen::VectorXd& x) {
          const SurfacePose p = pose_on_surface(surface, {x(0), x(1), x(2)});
          Eigen::VectorXd out(21);
          out << p.pose.position_m, flat(p.pose.rotation), flat(p.rotation_wt);
          return out;
        },
        at, 1e-6);
    Eigen::MatrixXd exact(21, 3);
    exact.setZero();
    exact.topLeftCorner<3, 2>() = pose.d_position_d_xy;
    exact.block<9, 1>(3, 0) = flat(pose.d_rotation_d_x);
    exact.block<9, 1>(3, 1) = flat(pose.d_rotation_d_y);
    exact.block<9, 1>(3, 2) = flat(pose.d_rotation_d_theta);
    exact.block<9, 1>(12, 0) = flat(pose.d_rotation_wt_d_x);
    exact.block<9, 1>(12, 1) = flat(pose.d_rotation_wt_d_y);
    EXPECT_LT((exact - numerical).cwiseAbs().maxCoeff(), 1e-5) << at.transpose();
  }
}

}  // namespace
}  // namespace groma::model
