#include "host/calibration/robust_kernel.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "test/host/calibration/exact_kernel.hpp"
#include "test/support/random.hpp"

namespace groma::calibration {
namespace {

std::vector<KernelShape> shapes() {
  return {KernelShape{},
          {.scale_m = 0.03, .wide = 0.2, .bumps = {0.1, 0.02, 0.1, 0.03, 0.01, 0.04}, .gross = 0.01},
          {.scale_m = 1.5, .wide = 0.01, .bumps = {0.0, 0.3, 0.2, 0.1, 0.0, 0.0}, .gross = 0.05},
          {.scale_m = 0.1, .wide = 0.1, .bumps = {1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 0.3}, .gross = 1e-4}};
}

TEST(RobustKernel, HasTheDensityOfItsKinds) {
  for (const KernelShape& shape : shapes()) {
    const RobustKernel kernel(shape);
    const double peak = test::exact_density(shape, 0.0);
    for (double u = -450.0; u < 450.0; u += std::abs(u) < 30.0 ? 0.0137 : 0.137) {
      const double r = u * shape.scale_m;
      const double exact = test::exact_density(shape, r);
      EXPECT_NEAR(kernel.at(r).density, exact, 2e-4 * peak) << "at " << u << " scales";
      // The tails, too, where gross and the other kinds compete: in cost.
      EXPECT_NEAR(std::log(kernel.at(r).density), std::log(exact), 0.02) << "at " << u << " scales";
    }
  }
}

TEST(RobustKernel, SlopeAndCurvatureAreTheDerivativesOfTheCost) {
  for (const KernelShape& shape : shapes()) {
    const RobustKernel kernel(shape);
    const double s = shape.scale_m;
    const double step_m = 1e-3 * s;
    const auto cost = [&](double r) { return -std::log(test::exact_density(shape, r)); };
    for (double u = -100.0; u < 300.0; u += 0.173) {
      const double r = u * s;
      const double slope = (cost(r + step_m) - cost(r - step_m)) / (2.0 * step_m);
      const double curvature = (cost(r + step_m) - 2.0 * cost(r) + cost(r - step_m)) / (step_m * step_m);
      const KernelValue value = kernel.at(r);
      EXPECT_NEAR(value.slope * s, slope * s, 5e-3) << "at " << u << " scales";
      EXPECT_NEAR(kernel.curvature(r) * s * s, curvature * s * s, 5e-3) << "at " << u << " scales";
    }
  }
}

// The parabola with the weight as its curvature, through cost and slope at r, is nowhere below the cost.
TEST(RobustKernel, WeightMajorizesTheCost) {
  for (const KernelShape& shape : shapes()) {
    const RobustKernel kernel(shape);
    const double s = shape.scale_m;
    for (double u = -12.0; u < 60.0; u += 0.531) {
      const KernelValue here = kernel.at(u * s);
      EXPECT_GE(here.weight, 0.0);
      EXPECT_GE(here.weight - kernel.curvature(u * s), -1e-6 / (s * s));
      for (double v = -14.0; v < 70.0; v += 0.377) {
        const double step_m = (v - u) * s;
        const double parabola =
            -std::log(here.density) + here.slope * step_m + 0.5 * here.weight * step_m * step_m;
        EXPECT_GE(parabola, -std::log(kernel.at(v * s).density) - 5e-3) << "from " << u << " at " << v;
      }
    }
  }
}

TEST(RobustKernel, PenalizesTooLongLessThanTooShort) {
  const RobustKernel kernel(KernelShape{.scale_m = 0.1}.with_nlos(0.2));
  for (const double r : {0.35, 0.5, 0.8}) {
    EXPECT_GT(kernel.at(r).density, kernel.at(-r).density);
    EXPECT_LT(kernel.at(r).slope, -kernel.at(-r).slope + 1e-12);
  }
}

TEST(RobustKernel, StaysFiniteAtAnyResidual) {
  for (const KernelShape& shape : shapes()) {
    const RobustKernel kernel(shape);
    for (const double r : {-1e6, -300e3, -50.0, -1e-300, 0.0, 50.0, 300e3, 1e6}) {
      const KernelValue value = kernel.at(r);
      EXPECT_GT(value.density, 0.0) << r;
      EXPECT_TRUE(std::isfinite(value.density) && std::isfinite(value.slope) && std::isfinite(value.weight) &&
                  std::isfinite(kernel.curvature(r)))
          << r;
      const KernelShares shares = kernel.shares(r);
      EXPECT_NEAR(shares.kinds.sum() + shares.gross, 1.0, 1e-6);
    }
  }
}

TEST(RobustKernel, LanesEqualSingleValues) {
  test::Random random(11);
  for (const KernelShape& shape : shapes()) {
    const RobustKernel kernel(shape);
    for (int i = 0; i < 200; ++i) {
      Lanes residuals_m;
      for (double& r : residuals_m) r = shape.scale_m * random.uniform(-150.0, 450.0) * random.uniform();
      residuals_m(kLanes - 1) = std::numeric_limits<double>::quiet_NaN();
      const KernelLanes found = kernel.at(residuals_m);
      CostSum sum;
      double expected = 0.0;
      for (Eigen::Index lane = 0; lane + 1 < kLanes; ++lane) {
        const KernelValue one = kernel.at(residuals_m(lane));
        EXPECT_DOUBLE_EQ(found.density(lane), one.density);
        EXPECT_NEAR(found.slope(lane), one.slope, 1e-12 / shape.scale_m);
        EXPECT_NEAR(found.weight(lane), one.weight, 1e-12 / (shape.scale_m * shape.scale_m));
        expected -= std::log(one.density);
      }
      EXPECT_EQ(found.slope(kLanes - 1), 0.0);
      EXPECT_EQ(found.weight(kLanes - 1), 0.0);
      sum.add(found.density, kLanes - 1);
      EXPECT_NEAR(sum.cost(), expected, 1e-9 * std::abs(expected) + 1e-12);
    }
  }
}

TEST(CostSum, IsTheSumOfTheCosts) {
  const RobustKernel kernel;
  test::Random random(3);
  CostSum sum;
  double expected = 0.0;
  for (int i = 0; i < 5000; ++i) {
    const KernelValue value = kernel.at(i % 3 == 0 ? random.uniform(-40.0, 40.0) : 0.1 * random.gaussian());
    sum.add(value);
    expected -= std::log(value.density);
  }
  EXPECT_NEAR(sum.cost(), expected, 1e-9 * std::abs(expected));
}

TEST(RobustKernel, EstimatesScaleAndShareOfSimulatedResiduals) {
  test::Random random(7);
  std::vector<WeighedResidual> residuals;
  for (int i = 0; i < 20000; ++i) {
    double r = 0.08 * random.gaussian();
    if (random.uniform() < 0.25) r += random.uniform(0.5, 3.5);
    residuals.push_back({.residual_m = r});
  }
  const KernelPrior prior{.shape = {.scale_m = 0.3}, .scale_weight = 5.0, .share_weight = 5.0};
  const KernelShape shape = fit_kernel(residuals, prior, 60);
  EXPECT_NEAR(shape.scale_m, 0.08, 0.002);
  EXPECT_NEAR(shape.blocked() + shape.gross, 0.25, 0.01);
  EXPECT_LT(shape.gross, 0.005);
  EXPECT_LT(shape.bumps[0], 0.005) << "no simulated excess is as small as 3 scales";
}

TEST(RobustKernel, ScaleAndSharesHaveSeparatePriorWeights) {
  const std::vector<WeighedResidual> residuals(100, {.residual_m = 0.0});
  const KernelPrior loose_scale{.shape = {.scale_m = 0.2}, .scale_weight = 1.0, .share_weight = 1e6};
  const KernelPrior loose_shares{.shape = {.scale_m = 0.2}, .scale_weight = 1e6, .share_weight = 1.0};
  const KernelShape of_scale = fit_kernel(residuals, loose_scale, 10);
  const KernelShape of_shares = fit_kernel(residuals, loose_shares, 10);
  EXPECT_LT(of_scale.scale_m, 0.05);
  EXPECT_NEAR(of_scale.wide, loose_scale.shape.wide, 1e-4);
  EXPECT_NEAR(of_shares.scale_m, 0.2, 1e-3);
  EXPECT_LT(of_shares.blocked(), 0.01);
}

TEST(RobustKernel, StaysAtItsPriorWithoutResiduals) {
  const KernelPrior prior{.shape = KernelShape{.scale_m = 0.2, .wide = 0.1}.with_nlos(0.1)};
  const KernelShape shape = fit_kernel({}, prior, 5);
  EXPECT_DOUBLE_EQ(shape.scale_m, prior.shape.scale_m);
  EXPECT_DOUBLE_EQ(shape.wide, prior.shape.wide);
  EXPECT_DOUBLE_EQ(shape.blocked(), prior.shape.blocked());
}

}  // namespace
}  // namespace groma::calibration
