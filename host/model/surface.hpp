// The ground as a height field z = S(x, y): the inverse chart sigma^-1 of the source paper's M-ESEKF.
#pragma once

#include <cstddef>
#include <string>
#include <utility>
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

// Uniform cubic tensor-product B-spline: with u = (x - x0)/dx, i = floor(u) and likewise v, j for y,
// z = sum over a, b in 0..3 of c[i + a][j + b] B_a(u - i) B_b(v - j). Outside the grid u and v are clamped to
// it, so that the height continues at the border's value.
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
  // at().z_m, in a third of the time.
  [[nodiscard]] double height_m(double x_m, double y_m) const noexcept;
  [[nodiscard]] const Grid& grid() const noexcept { return grid_; }
  [[nodiscard]] const std::vector<double>& heights_m() const noexcept { return heights_m_; }

 private:
  Grid grid_;
  Eigen::Vector2d per_m_;  // cells
  std::vector<double> heights_m_;
};

// How far the ground may differ from its model: zero-mean errors of height and slope that vary along the
// path. Both sigmas zero: the model is exact.
struct SurfaceMismatch {
  double sigma_m = 0.0;
  double slope_sigma = 0.0;  // of the gradient's error along each axis
  double length_m = 1.0;     // correlation length: path after which the correlation is 1/e; > 0

  [[nodiscard]] bool is_any() const noexcept { return sigma_m > 0.0 || slope_sigma > 0.0; }
};

// One sheet of the ground: a floor, or a ramp between two.
struct Chart {
  std::string name;  // empty where it is the only one
  std::variant<Plane, BSpline> shape;
  // The chart's domain as a polygon (x, y in the map frame), corners in order. Empty: everywhere for a plane,
  // the grid for a spline.
  std::vector<Eigen::Vector2d> domain_m;
  SurfaceMismatch mismatch;
};

// The ground: one chart, or several that may overlap at different heights. A place on it is x, y and the
// chart. Evaluation allocates no memory.
class Surface {
 public:
  // A robot can cross from one chart to another where their heights differ by less than this. By hand:
  // more than a curb, less than a storey; Charts.ARobotFollowsTheChartAtItsHeight holds with it.
  static constexpr double kStep_m = 0.3;

  Surface() : charts_(1) {}                                    // the plane z = 0
  Surface(Plane plane) : charts_{Chart{{}, plane, {}, {}}} {}  // NOLINT(google-explicit-constructor)
  Surface(BSpline spline)                                      // NOLINT(google-explicit-constructor)
      : charts_{Chart{{}, std::move(spline), {}, {}}} {}
  // At least one chart.
  explicit Surface(std::vector<Chart> charts) : charts_(std::move(charts)) {}

  // Defined everywhere; each shape defines its height outside the chart's domain and grid.
  [[nodiscard]] double height_m(double x_m, double y_m, int chart) const noexcept {
    const auto& shape = this->shape(chart);
    if (const auto* plane = std::get_if<Plane>(&shape)) return plane->at(x_m, y_m).z_m;
    return std::get_if<BSpline>(&shape)->height_m(x_m, y_m);
  }
  [[nodiscard]] SurfacePoint at(double x_m, double y_m, int chart = 0) const noexcept {
    const auto& shape = this->shape(chart);
    if (const auto* plane = std::get_if<Plane>(&shape)) return plane->at(x_m, y_m);
    return std::get_if<BSpline>(&shape)->at(x_m, y_m);
  }
  [[nodiscard]] const std::variant<Plane, BSpline>& shape(int chart = 0) const noexcept {
    return charts_[static_cast<std::size_t>(chart)].shape;
  }
  [[nodiscard]] const std::vector<Chart>& charts() const noexcept { return charts_; }
  [[nodiscard]] int chart_count() const noexcept { return static_cast<int>(charts_.size()); }
  [[nodiscard]] const SurfaceMismatch& mismatch(int chart) const noexcept {
    return charts_[static_cast<std::size_t>(chart)].mismatch;
  }

  // Whether (x, y) is within the chart's domain and, for a spline, within its grid.
  [[nodiscard]] bool covers(double x_m, double y_m, int chart = 0) const noexcept;
  // The chart of a robot that was on `chart` and has moved to (x, y): `chart` where it covers (x, y), else
  // the covering chart nearest in height, if within kStep_m, else `chart`.
  [[nodiscard]] int follow(int chart, double x_m, double y_m) const noexcept;
  // The chart of a place whose height is known: the nearest in height among those that cover it. A height of
  // NaN: the first that covers it. If none covers it, all charts are candidates.
  [[nodiscard]] int nearest(double x_m, double y_m, double z_m) const noexcept;

 private:
  std::vector<Chart> charts_;
};

}  // namespace groma::model
