#include "host/model/surface_fit.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstddef>
#include <vector>

#include "test/support/random.hpp"

namespace groma::model {
namespace {

using test::Random;

double hill(double x_m, double y_m) {
  return 0.4 * std::sin(0.5 * x_m) * std::cos(0.4 * y_m) + 0.02 * x_m;
}

std::vector<Eigen::Vector3d> drawn(std::size_t count, double noise_m, Random& random) {
  std::vector<Eigen::Vector3d> points;
  while (points.size() < count) {
    const double x_m = random.uniform(-8.0, 12.0);
    const double y_m = random.uniform(0.0, 12.0);
    points.emplace_back(x_m, y_m, hill(x_m, y_m) + noise_m * random.gaussian());
  }
  return points;
}

TEST(SurfaceFit, IsMoreAccurateThanTheHeights) {
  Random random(1);
  const std::vector<Eigen::Vector3d> points = drawn(2000, 0.03, random);
  const std::optional<SurfaceFit> fit = fit_surface(points);
  ASSERT_TRUE(fit);
  EXPECT_EQ(fit->points, 2000U);
  EXPECT_NEAR(fit->rms_m, 0.03, 0.003);
  EXPECT_NEAR(fit->held_out_rms_m, 0.03, 0.008);
  double square_m2 = 0.0;
  for (int i = 0; i < 1000; ++i) {
    const double x_m = random.uniform(-7.5, 11.5);
    const double y_m = random.uniform(0.5, 11.5);
    square_m2 += std::pow(fit->spline.at(x_m, y_m).z_m - hill(x_m, y_m), 2) / 1000.0;
  }
  EXPECT_LT(std::sqrt(square_m2), 0.01);
  // Independent errors of the points are not mismatch.
  EXPECT_LT(fit->mismatch.sigma_m, 0.015);
  EXPECT_LT(fit->gap_m, 2.0 * fit->spacing_m);
}

TEST(SurfaceFit, UnresolvedDetailBecomesMismatch) {
  Random random(2);
  std::vector<Eigen::Vector3d> points = drawn(3000, 0.005, random);
  // Waves that knots 5 m apart cannot follow.
  for (Eigen::Vector3d& point : points)
    point.z() += 0.05 * std::sin(2.5 * point.x()) * std::sin(2.5 * point.y());
  const std::optional<SurfaceFit> fit = fit_surface(points, {.spacing_m = 5.0, .smoothing = {}});
  ASSERT_TRUE(fit);
  EXPECT_EQ(fit->spacing_m, 5.0);
  EXPECT_GT(fit->mismatch.sigma_m, 0.02);
  EXPECT_LT(fit->mismatch.sigma_m, 1.2 * fit->held_out_rms_m);
  EXPECT_GT(fit->mismatch.length_m, 0.3);
  EXPECT_EQ(fit->mismatch.slope_sigma, slope_sigma(fit->mismatch.sigma_m, fit->mismatch.length_m));
}

TEST(SurfaceFit, APlaneContinuesAcrossAGap) {
  std::vector<Eigen::Vector3d> points;
  for (double x_m = 0.0; x_m <= 30.0; x_m += 0.5) {
    for (double y_m = 0.0; y_m <= 20.0; y_m += 0.5) {
      if (x_m > 10.0 && x_m < 20.0) continue;
      points.emplace_back(x_m, y_m, 0.3 + 0.05 * x_m - 0.02 * y_m);
    }
  }
  const std::optional<SurfaceFit> fit = fit_surface(points, {.spacing_m = 2.0, .smoothing = 0.01});
  ASSERT_TRUE(fit);
  EXPECT_LT(fit->max_m, 1e-4);
  EXPECT_NEAR(fit->spline.at(15.0, 10.0).z_m, 0.3 + 0.75 - 0.2, 1e-3);
  EXPECT_GT(fit->empty_share, 0.2);
  EXPECT_NEAR(fit->gap_m, 5.0, 2.0);
  EXPECT_NEAR(fit->gap_at_m.x(), 15.0, 2.0);
}

TEST(SurfaceFit, RecoversASplineOfTheSameGrid) {
  Random random(3);
  const BSpline::Grid grid{0.0, 0.0, 1.5, 1.5, 9, 7};
  std::vector<double> heights_m(std::size_t{9} * 7);
  for (double& height_m : heights_m) height_m = random.gaussian();
  const BSpline spline(grid, heights_m);
  std::vector<Eigen::Vector3d> points{{0.0, 0.0, spline.at(0.0, 0.0).z_m},
                                      {9.0, 6.0, spline.at(9.0, 6.0).z_m}};
  for (int i = 0; i < 2000; ++i) {
    const double x_m = random.uniform(0.0, 9.0);
    const double y_m = random.uniform(0.0, 6.0);
    points.emplace_back(x_m, y_m, spline.at(x_m, y_m).z_m);
  }
  const std::optional<SurfaceFit> fit = fit_surface(points, {.spacing_m = 1.5, .smoothing = 1e-14});
  ASSERT_TRUE(fit);
  EXPECT_LT(fit->max_m, 1e-6);
  ASSERT_EQ(fit->spline.heights_m().size(), heights_m.size());
  for (std::size_t i = 0; i < heights_m.size(); ++i)
    EXPECT_NEAR(fit->spline.heights_m()[i], heights_m[i], 1e-4);
}

TEST(SurfaceFit, ALineOfPointsIsLevelBesideItAndATooFineSpacingHasNoFit) {
  std::vector<Eigen::Vector3d> line;
  line.reserve(50);
  for (int i = 0; i < 50; ++i) line.emplace_back(0.4 * i, 3.0, 0.02 * i);
  const std::optional<SurfaceFit> fit = fit_surface(line, {.spacing_m = 2.0, .smoothing = 0.01});
  ASSERT_TRUE(fit);
  EXPECT_NEAR(fit->spline.at(10.0, 3.0).z_m, 0.5, 1e-2);
  EXPECT_NEAR(fit->spline.at(10.0, 3.0).gradient.y(), 0.0, 1e-3);
  EXPECT_FALSE(fit_surface(line, {.spacing_m = 1e-6, .smoothing = {}}));
}

Chart floor_at(double z_m, double from_m, double to_m) {
  Chart chart;
  chart.shape = Plane(z_m, {0.0, 0.0, 1.0});
  chart.domain_m = {{from_m, -5.0}, {to_m, -5.0}, {to_m, 5.0}, {from_m, 5.0}};
  return chart;
}

TEST(Charts, ARobotFollowsTheChartAtItsHeight) {
  Chart ramp = floor_at(-1.0, 9.5, 30.5);
  ramp.shape = Plane(-1.0, {-0.1, 0.0, 1.0});
  const Surface surface({floor_at(0.0, -10.0, 10.0), ramp, floor_at(2.0, 0.0, 50.0)});
  EXPECT_EQ(surface.follow(0, 5.0, 0.0), 0);   // within its own domain
  EXPECT_EQ(surface.follow(0, 10.5, 0.0), 1);  // the ramp begins; the floor above is 2 m up
  EXPECT_EQ(surface.follow(1, 30.6, 0.0), 2);  // and ends
  EXPECT_EQ(surface.follow(2, -0.5, 0.0), 2);  // no chart at that height: it stays
  EXPECT_EQ(surface.follow(0, 20.0, 0.0), 0);  // under the ramp: it stays
  EXPECT_EQ(surface.nearest(5.0, 0.0, 1.8), 2);
  EXPECT_EQ(surface.nearest(5.0, 0.0, 0.3), 0);
  EXPECT_EQ(surface.nearest(5.0, 0.0, std::nan("")), 0);
  EXPECT_EQ(surface.nearest(60.0, 0.0, 2.1), 2);  // no chart covers it
  EXPECT_FALSE(surface.covers(60.0, 0.0, 2));
  EXPECT_TRUE(surface.covers(49.0, 4.9, 2));
  EXPECT_FALSE(surface.covers(std::nan(""), 0.0, 0));
  EXPECT_FALSE(Surface(BSpline({0.0, 0.0, 1.0, 1.0, 5, 5}, std::vector<double>(25))).covers(2.1, 1.0));
}

}  // namespace
}  // namespace groma::model
