#include "host/model/surface.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "test/support/numerical_jacobian.hpp"
#include "test/support/random.hpp"

namespace groma::model {
namespace {

using test::numerical_jacobian;
using test::Random;

// Cox-de Boor recursion on uniform knots 0, 1, 2, ...: the i-th basis function of this degree.
double cox_de_boor(int i, int degree, double u) {
  if (degree == 0) return u >= i && u < i + 1 ? 1.0 : 0.0;
  return (u - i) / degree * cox_de_boor(i, degree - 1, u) +
         (i + degree + 1 - u) / degree * cox_de_boor(i + 1, degree - 1, u);
}

struct Spline {
  BSpline::Grid grid{.x0_m = -3.5, .y0_m = 2.25, .dx_m = 0.8, .dy_m = 1.3, .nx = 9, .ny = 7};
  std::vector<double> heights_m;
  BSpline surface;

  explicit Spline(std::uint64_t seed) : heights_m(draw(seed)), surface(grid, heights_m) {}

  std::vector<double> draw(std::uint64_t seed) const {
    Random random(seed);
    std::vector<double> heights(static_cast<std::size_t>(grid.nx) * static_cast<std::size_t>(grid.ny));
    for (double& height : heights) height = random.gaussian();
    return heights;
  }
  double x_end() const { return grid.x0_m + grid.dx_m * (grid.nx - 3); }
  double y_end() const { return grid.y0_m + grid.dy_m * (grid.ny - 3); }

  // Sum over all control points. The grid's first cell is where the first four functions overlap: u + 3.
  double brute_force(double x_m, double y_m) const {
    const double u = (x_m - grid.x0_m) / grid.dx_m + 3.0;
    const double v = (y_m - grid.y0_m) / grid.dy_m + 3.0;
    double z = 0.0;
    for (int i = 0; i < grid.nx; ++i) {
      for (int j = 0; j < grid.ny; ++j) {
        z += heights_m[static_cast<std::size_t>(i) * static_cast<std::size_t>(grid.ny) +
                       static_cast<std::size_t>(j)] *
             cox_de_boor(i, 3, u) * cox_de_boor(j, 3, v);
      }
    }
    return z;
  }
};

Eigen::VectorXd point_of(const SurfacePoint& p) {
  Eigen::VectorXd out(3);
  out << p.z_m, p.gradient;
  return out;
}

TEST(BSpline, EqualsTheSumOverAllControlPoints) {
  const Spline spline(1);
  Random random(2);
  for (int i = 0; i < 2000; ++i) {
    const double x = random.uniform(spline.grid.x0_m, spline.x_end());
    const double y = random.uniform(spline.grid.y0_m, spline.y_end());
    EXPECT_NEAR(spline.surface.at(x, y).z_m, spline.brute_force(x, y), 1e-12) << x << " " << y;
  }
}

TEST(BSpline, EqualsTheSumOnKnotsAndAtTheBorders) {
  const Spline spline(3);
  for (int i = 0; i <= spline.grid.nx - 3; ++i) {
    for (int j = 0; j <= spline.grid.ny - 3; ++j) {
      // Slightly inside, because the half-open definition of the basis excludes the last knot.
      const double x = spline.grid.x0_m + spline.grid.dx_m * (i == spline.grid.nx - 3 ? i - 1e-13 : i);
      const double y = spline.grid.y0_m + spline.grid.dy_m * (j == spline.grid.ny - 3 ? j - 1e-13 : j);
      EXPECT_NEAR(spline.surface.at(x, y).z_m, spline.brute_force(x, y), 1e-11) << i << " " << j;
    }
  }
}

TEST(BSpline, ContinuesFlatOutside) {
  const Spline spline(4);
  const double middle_x = 0.5 * (spline.grid.x0_m + spline.x_end());
  const double middle_y = 0.5 * (spline.grid.y0_m + spline.y_end());
  for (const double beyond : {1e-6, 0.4, 3.0, 1e6, 1e300}) {
    EXPECT_EQ(spline.surface.at(spline.grid.x0_m - beyond, middle_y).z_m,
              spline.surface.at(spline.grid.x0_m, middle_y).z_m);
    EXPECT_EQ(spline.surface.at(spline.x_end() + beyond, middle_y).z_m,
              spline.surface.at(spline.x_end(), middle_y).z_m);
    EXPECT_EQ(spline.surface.at(middle_x, spline.grid.y0_m - beyond).z_m,
              spline.surface.at(middle_x, spline.grid.y0_m).z_m);
    EXPECT_EQ(spline.surface.at(middle_x, spline.y_end() + beyond).z_m,
              spline.surface.at(middle_x, spline.y_end()).z_m);
    const SurfacePoint corner = spline.surface.at(spline.x_end() + beyond, spline.grid.y0_m - beyond);
    EXPECT_EQ(corner.gradient, Eigen::Vector2d::Zero());
    EXPECT_EQ(corner.hessian, Eigen::Matrix2d::Zero());
    // Flat across the border, yet sloped along it.
    const SurfacePoint side = spline.surface.at(spline.x_end() + beyond, middle_y);
    EXPECT_EQ(side.gradient.x(), 0.0);
    EXPECT_NE(side.gradient.y(), 0.0);
    EXPECT_EQ(side.hessian(0, 1), 0.0);
    EXPECT_NE(side.hessian(1, 1), 0.0);
  }
}

TEST(BSpline, DerivativesEqualNumericalOnesInsideAndOutside) {
  const Spline spline(5);
  Random random(6);
  int outside = 0;
  for (int i = 0; i < 500; ++i) {
    Eigen::VectorXd at(2);
    at << random.uniform(spline.grid.x0_m - 1.0, spline.x_end() + 1.0),
        random.uniform(spline.grid.y0_m - 1.0, spline.y_end() + 1.0);
    const SurfacePoint point = spline.surface.at(at(0), at(1));
    const Eigen::MatrixXd numerical = numerical_jacobian(
        [&](const Eigen::VectorXd& x) { return point_of(spline.surface.at(x(0), x(1))); }, at);
    Eigen::MatrixXd exact(3, 2);
    exact << point.gradient.transpose(), point.hessian;
    EXPECT_LT((exact - numerical).cwiseAbs().maxCoeff(), 2e-4) << at.transpose();
    outside += at(0) < spline.grid.x0_m || at(0) > spline.x_end() ? 1 : 0;
  }
  EXPECT_GT(outside, 50);
}

TEST(BSpline, SmallestGridIsOneCell) {
  const BSpline::Grid grid{.x0_m = 0.0, .y0_m = 0.0, .dx_m = 1.0, .dy_m = 1.0, .nx = 4, .ny = 4};
  const BSpline surface(grid, std::vector<double>(16, 2.5));
  for (const double at : {-1.0, 0.0, 0.5, 1.0, 7.0}) EXPECT_NEAR(surface.at(at, at).z_m, 2.5, 1e-15);
}

TEST(BSpline, ANonFinitePositionHasNoHeight) {
  const Spline spline(7);
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  for (const auto& [x, y] : {std::pair{kNan, 3.0}, {0.0, kNan}, {kInfinity, 3.0}, {0.0, -kInfinity}}) {
    const SurfacePoint point = spline.surface.at(x, y);
    EXPECT_TRUE(std::isnan(point.z_m));
    EXPECT_TRUE(point.gradient.hasNaN());
    EXPECT_TRUE(point.hessian.hasNaN());
  }
}

TEST(Plane, ContainsEveryPointPerpendicularToItsNormal) {
  const Eigen::Vector3d normal(0.3, -0.2, 1.7);
  const Plane plane(1.25, normal);
  Random random(8);
  for (int i = 0; i < 100; ++i) {
    const double x = random.uniform(-50.0, 50.0);
    const double y = random.uniform(-50.0, 50.0);
    const SurfacePoint point = plane.at(x, y);
    EXPECT_NEAR(normal.dot(Eigen::Vector3d(x, y, point.z_m - 1.25)), 0.0, 1e-12);
    EXPECT_NEAR(normal.dot(Eigen::Vector3d(1.0, 0.0, point.gradient.x())), 0.0, 1e-15);
    EXPECT_NEAR(normal.dot(Eigen::Vector3d(0.0, 1.0, point.gradient.y())), 0.0, 1e-15);
  }
}

TEST(Surface, IsFlatGroundByDefault) {
  const SurfacePoint point = Surface().at(12.0, -7.0);
  EXPECT_EQ(point.z_m, 0.0);
  EXPECT_EQ(point.gradient, Eigen::Vector2d::Zero());
}

}  // namespace
}  // namespace groma::model
