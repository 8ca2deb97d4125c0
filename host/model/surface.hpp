// The ground as a height field z = S(x, y): the inverse chart sigma^-1 of the source paper's M-ESEKF.
#pragma once

#include <variant>
#include <vector>

#include <Eigen/Core>

namespace groma::model {

// Height with its first and second derivatives at one point of the plane.
struct SurfacePoint {
  double z_m = 0.0;
  Eigen::Vector2d gradient = Eigen::Vector2d::Zero();  // dS/dx, dS/dy
  Eigen::Matrix2d hessian = Eigen::Matrix2d::Zero();   // 1/m
};

// A plane through (0, 0, z_m) with an upward normal (any length; normal.z > 0).
class Plane {
 public:
  Plane() = default;
  // The normal's z component has to be positive: the caller checks it.
  Plane(double z_m, const Eigen::Vector3d& normal);

  [[nodiscard]] SurfacePoint at(double x_m, double y_m) const noexcept;

 private:
  double z_m_ = 0.0;
  Eigen::Vector2d gradient_ = Eigen::Vector2d::Zero();
};

// Uniform cubic tensor-product B-spline: with u = (x - x0)/dx and i = floor(u), the same for y,
// z = sum over a, b in 0..3 of c[i + a][j + b] B_a(u - i) B_b(v - j). Outside the grid u and v are
// clamped to it, so that the height goes on flat.
class BSpline {
 public:
  struct Grid {
    double x0_m = 0.0;
    double y0_m = 0.0;
    double dx_m = 1.0;  // > 0
    double dy_m = 1.0;  // > 0
    int nx = 4;         // >= 4
    int ny = 4;         // >= 4
  };

  // heights_m: nx rows of ny control heights, row by row; its size has to be nx * ny.
  BSpline(const Grid& grid, std::vector<double> heights_m);

  [[nodiscard]] SurfacePoint at(double x_m, double y_m) const noexcept;
  [[nodiscard]] const Grid& grid() const noexcept { return grid_; }
  [[nodiscard]] const std::vector<double>& heights_m() const noexcept { return heights_m_; }

 private:
  Grid grid_;
  std::vector<double> heights_m_;
};

// Either kind of surface behind one call; evaluation allocates nothing.
class Surface {
 public:
  Surface() = default;
  Surface(Plane plane) : shape_(plane) {}                 // NOLINT(google-explicit-constructor)
  Surface(BSpline spline) : shape_(std::move(spline)) {}  // NOLINT(google-explicit-constructor)

  [[nodiscard]] SurfacePoint at(double x_m, double y_m) const noexcept {
    if (const auto* plane = std::get_if<Plane>(&shape_)) return plane->at(x_m, y_m);
    return std::get_if<BSpline>(&shape_)->at(x_m, y_m);
  }
  [[nodiscard]] const std::variant<Plane, BSpline>& shape() const noexcept { return shape_; }

 private:
  std::variant<Plane, BSpline> shape_;
};

}  // namespace groma::model
