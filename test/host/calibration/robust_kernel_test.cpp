#include "host/calibration/robust_kernel.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "test/support/random.hpp"

namespace groma::calibration {
namespace {

std::vector<KernelShape> shapes() {
  return {KernelShape{},
          {.scale_m = 0.03, .excess_m = 0.4, .wide = 0.2, .blocked = 0.3, .gross = 0.01},
          {.scale_m = 1.5, .excess_m = 5.0, .wide = 0.01, .blocked = 0.6, .gross = 0.05},
          {.scale_m = 0.1, .excess_m = 10.0, .wide = 0.1, .blocked = 0.001, .gross = 1e-4}};
}

TEST(RobustKernel, DensityOfAllButGrossIntegratesToItsShare) {
  for (const KernelShape& shape : shapes()) {
    const RobustKernel kernel(shape);
    const double step_m = shape.scale_m / 50.0;
    double integral = 0.0;
    for (double r = -12.0 * kWideness * shape.scale_m; r < 40.0 * shape.excess_m + 10.0 * shape.scale_m;
         r += step_m) {
      integral += step_m * (std::exp(-kernel.at(r).cost) - shape.gross / kGrossWidth_m);
    }
    EXPECT_NEAR(integral, 1.0 - shape.gross, 1e-4);
  }
}

TEST(RobustKernel, SlopeAndCurvatureAreTheDerivativesOfTheCost) {
  for (const KernelShape& shape : shapes()) {
    const RobustKernel kernel(shape);
    const double step_m = 1e-4 * shape.scale_m;
    for (double u = -20.0; u < 60.0; u += 0.173) {
      const double r = u * shape.scale_m;
      const double slope = (kernel.at(r + step_m).cost - kernel.at(r - step_m).cost) / (2.0 * step_m);
      const double curvature = (kernel.at(r + step_m).slope - kernel.at(r - step_m).slope) / (2.0 * step_m);
      const KernelValue value = kernel.at(r);
      EXPECT_NEAR(value.slope * shape.scale_m, slope * shape.scale_m, 2e-3) << "at " << u << " scales";
      EXPECT_NEAR(value.curvature * shape.scale_m * shape.scale_m, curvature * shape.scale_m * shape.scale_m,
                  2e-3)
          << "at " << u << " scales";
      EXPECT_GE(value.weight, 0.0);
      EXPECT_GE(value.weight - value.curvature, -1e-9) << "the parabola has to lie above the cost";
    }
  }
}

TEST(RobustKernel, TooLongIsForgivenSoonerThanTooShort) {
  const RobustKernel kernel(KernelShape{.scale_m = 0.1, .excess_m = 1.0, .wide = 0.02, .blocked = 0.2});
  for (const double r : {0.35, 0.5, 0.8}) {
    EXPECT_LT(kernel.at(r).cost, kernel.at(-r).cost);
    EXPECT_LT(kernel.at(r).slope, -kernel.at(-r).slope + 1e-12);
  }
}

TEST(RobustKernel, StaysFiniteAtAnyResidual) {
  for (const KernelShape& shape : shapes()) {
    const RobustKernel kernel(shape);
    for (const double r : {-1e6, -300e3, -50.0, -1e-300, 0.0, 50.0, 300e3, 1e6}) {
      const KernelValue value = kernel.at(r);
      EXPECT_TRUE(std::isfinite(value.cost) && std::isfinite(value.slope) && std::isfinite(value.weight) &&
                  std::isfinite(value.curvature))
          << r;
      const KernelShares shares = kernel.shares(r);
      EXPECT_NEAR(shares.core + shares.wide + shares.blocked + shares.gross, 1.0, 1e-9);
    }
  }
}

TEST(RobustKernel, LearnsTheShapeThatDrewTheResiduals) {
  test::Random random(7);
  std::vector<double> residuals;
  for (int i = 0; i < 20000; ++i) {
    double r = 0.08 * random.gaussian();
    if (random.uniform() < 0.25) r += -1.2 * std::log(1.0 - random.uniform());
    residuals.push_back(r);
  }
  const KernelPrior prior{.shape = {.scale_m = 0.3, .excess_m = 3.0}, .weight = 5.0};
  const KernelShape shape = fit_kernel(residuals, prior, 60);
  EXPECT_NEAR(shape.scale_m, 0.08, 0.003);
  EXPECT_NEAR(shape.blocked, 0.25, 0.015);
  EXPECT_NEAR(shape.excess_m, 1.2, 0.08);
  EXPECT_LT(shape.gross, 0.005);
}

TEST(RobustKernel, StaysAtItsPriorWithoutResiduals) {
  const KernelPrior prior{.shape = {.scale_m = 0.2, .excess_m = 2.0, .wide = 0.1, .blocked = 0.1}};
  const KernelShape shape = fit_kernel({}, prior, 5);
  EXPECT_DOUBLE_EQ(shape.scale_m, prior.shape.scale_m);
  EXPECT_DOUBLE_EQ(shape.excess_m, prior.shape.excess_m);
  EXPECT_DOUBLE_EQ(shape.blocked, prior.shape.blocked);
}

}  // namespace
}  // namespace groma::calibration
