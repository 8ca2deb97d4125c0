#include "host/model/range_model.hpp"

#include <gtest/gtest.h>

#include <numbers>
#include <vector>

#include <Eigen/Geometry>

#include "test/support/numerical_jacobian.hpp"
#include "test/support/random.hpp"

namespace groma::model {
namespace {

using test::numerical_jacobian;
using test::Random;

struct Scene {
  RigidPose pose;
  Eigen::Vector3d lever_arm_m;
  Eigen::Vector3d anchor_m;
  TermVector terms;

  explicit Scene(Random& random)
      : lever_arm_m(random.gaussians(3)),
        anchor_m(20.0 * random.gaussians(3)),
        terms(values_of({.beta_m = random.gaussian(), .gamma = 1.0 + 0.05 * random.gaussian()})) {
    pose.position_m = 10.0 * random.gaussians(3);
    pose.rotation =
        Eigen::AngleAxisd(random.uniform(-3.0, 3.0), random.gaussians(3).normalized()).toRotationMatrix();
  }
  RangePrediction predict() const { return predict_range(pose, lever_arm_m, anchor_m, terms); }
};

TEST(PredictRange, IsScaledDistancePlusBias) {
  const RigidPose pose{{1.0, 2.0, 3.0}, rotation_from_zyx(std::numbers::pi / 2.0, 0.0, 0.0)};
  // The lever arm (1, 0, 2) points along y: the tag is at (1, 3, 5), (3, 4, 12) away from the anchor.
  const RangePrediction prediction =
      predict_range(pose, {1.0, 0.0, 2.0}, {4.0, 7.0, 17.0}, values_of({.beta_m = 0.5, .gamma = 1.02}));
  EXPECT_NEAR(prediction.distance_m, 13.0, 1e-12);
  EXPECT_NEAR(prediction.range_m, 1.02 * 13.0 + 0.5, 1e-12);
}

TEST(PredictRange, DerivativesEqualNumericalOnes) {
  Random random(21);
  for (int i = 0; i < 100; ++i) {
    const Scene scene(random);
    Eigen::VectorXd at(9 + kPairTermCount);
    at << scene.pose.position_m, scene.anchor_m, scene.lever_arm_m, scene.terms;
    const Eigen::MatrixXd numerical = numerical_jacobian(
        [&](const Eigen::VectorXd& x) {
          const RigidPose pose{x.head<3>(), scene.pose.rotation};
          return Eigen::VectorXd::Constant(
              1, predict_range(pose, x.segment<3>(6), x.segment<3>(3), x.tail<kPairTermCount>()).range_m);
        },
        at);
    const RangePrediction prediction = scene.predict();
    Eigen::MatrixXd exact(1, at.size());
    exact << prediction.d_position, prediction.d_anchor, prediction.d_lever_arm,
        prediction.d_terms.transpose();
    EXPECT_LT((exact - numerical).cwiseAbs().maxCoeff(), 1e-7);
  }
}

// Of all terms, also those that the other tests leave neutral.
TEST(PredictRange, IsLinearInTheDistance) {
  Random random(24);
  for (int i = 0; i < 100; ++i) {
    const TermVector terms = random.gaussians(kPairTermCount);
    const Eigen::Vector3d direction = random.gaussians(3).normalized();
    const double distance_m = random.uniform(1.0, 30.0);
    EXPECT_NEAR(offset_m(terms, direction) + scale_of(terms) * distance_m,
                terms.dot(by_terms(distance_m, direction)), 1e-12);
  }
}

TEST(PredictRange, HasNoDirectionIfTagAndAnchorCoincide) {
  const RangePrediction prediction =
      predict_range({}, {1.0, 2.0, 3.0}, {1.0, 2.0, 3.0}, values_of({.beta_m = 0.25}));
  EXPECT_EQ(prediction.range_m, 0.25);
  EXPECT_EQ(prediction.d_position, Eigen::RowVector3d::Zero());
  EXPECT_EQ(prediction.d_anchor, Eigen::RowVector3d::Zero());
}

TEST(RangeByPlanarPose, EqualsTheNumericalDerivativeOnCurvedGround) {
  const BSpline::Grid grid{.x0_m = -8.0, .y0_m = -8.0, .dx_m = 2.0, .dy_m = 2.0, .nx = 11, .ny = 11};
  Random random(22);
  std::vector<double> heights(static_cast<std::size_t>(grid.nx) * static_cast<std::size_t>(grid.ny));
  for (double& height : heights) height = 0.5 * random.gaussian();
  const Surface surface = BSpline(grid, heights);
  for (int i = 0; i < 100; ++i) {
    const Scene scene(random);
    const Eigen::Vector3d at(random.uniform(-7.0, 7.0), random.uniform(-7.0, 7.0), random.uniform(-3.0, 3.0));
    const auto predict = [&](const Eigen::VectorXd& x) {
      const SurfacePose pose = pose_on_surface(surface, {x(0), x(1), x(2)});
      return predict_range(pose.pose, scene.lever_arm_m, scene.anchor_m, scene.terms);
    };
    const Eigen::MatrixXd numerical = numerical_jacobian(
        [&](const Eigen::VectorXd& x) { return Eigen::VectorXd::Constant(1, predict(x).range_m); }, at, 1e-6);
    const Eigen::RowVector3d exact = range_by_planar_pose(
        predict(at), pose_on_surface(surface, {at.x(), at.y(), at.z()}), scene.lever_arm_m);
    EXPECT_LT((exact - numerical).cwiseAbs().maxCoeff(), 2e-6);
  }
}

TEST(PredictSurfaceRange, EqualsTheRangeOfThePoseOnTheSurface) {
  const BSpline::Grid grid{.x0_m = -8.0, .y0_m = -8.0, .dx_m = 2.0, .dy_m = 2.0, .nx = 11, .ny = 11};
  Random random(23);
  std::vector<double> heights(static_cast<std::size_t>(grid.nx) * static_cast<std::size_t>(grid.ny));
  for (double& height : heights) height = 0.5 * random.gaussian();
  const Surface surface = BSpline(grid, heights);
  for (int i = 0; i < 100; ++i) {
    const Scene scene(random);
    const PlanarPose at{random.uniform(-7.0, 7.0), random.uniform(-7.0, 7.0), random.uniform(-3.0, 3.0)};
    const SurfacePose pose = pose_on_surface(surface, at);
    const RangePrediction expected = predict_range(pose.pose, scene.lever_arm_m, scene.anchor_m, scene.terms);
    const SurfacePoint ground = surface.at(at.x_m, at.y_m);
    const auto on = [&](const SurfacePoint& point) {
      return predict_surface_range(point, at, scene.lever_arm_m, scene.anchor_m, scene.terms);
    };
    const SurfaceRange range = on(ground);
    EXPECT_NEAR(range.range_m, expected.range_m, 1e-12);
    EXPECT_NEAR(range.distance_m, expected.distance_m, 1e-12);
    EXPECT_LT((range.d_position - expected.d_position).norm(), 1e-12);
    EXPECT_LT((range.d_anchor - expected.d_anchor).norm(), 1e-12);
    EXPECT_LT((range.d_lever_arm - expected.d_lever_arm).norm(), 1e-12);
    EXPECT_LT((range.d_pose - range_by_planar_pose(expected, pose, scene.lever_arm_m)).norm(), 1e-11);
    EXPECT_LT((range.in_body - pose.pose.rotation.transpose() * expected.direction).norm(), 1e-12);
    EXPECT_LT((range.sideways - pose.pose.rotation.topLeftCorner<2, 2>()).norm(), 1e-14);
    const Eigen::MatrixXd numerical = numerical_jacobian(
        [&](const Eigen::VectorXd& gradient) {
          SurfacePoint other = ground;
          other.gradient = gradient;
          return Eigen::VectorXd::Constant(1, on(other).range_m);
        },
        ground.gradient, 1e-6);
    EXPECT_LT((range.d_gradient - numerical).cwiseAbs().maxCoeff(), 1e-8);
  }
}

}  // namespace
}  // namespace groma::model
