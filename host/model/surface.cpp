#include "host/model/surface.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace groma::model {

namespace {

// The four cubic basis functions on one cell and their derivatives with respect to the cell coordinate.
struct Basis {
  Eigen::Vector4d value;
  Eigen::Vector4d first;
  Eigen::Vector4d second;
};

inline Basis basis(double t) noexcept {
  constexpr double kSixth = 1.0 / 6.0;
  const double t2 = t * t;
  const double t3 = t2 * t;
  const double s = 1.0 - t;
  Basis b;
  b.value = {s * s * s * kSixth, (3.0 * t3 - 6.0 * t2 + 4.0) * kSixth,
             (-3.0 * t3 + 3.0 * t2 + 3.0 * t + 1.0) * kSixth, t3 * kSixth};
  b.first = {-s * s * 0.5, (3.0 * t2 - 4.0 * t) * 0.5, (-3.0 * t2 + 2.0 * t + 1.0) * 0.5, t2 * 0.5};
  b.second = {s, 3.0 * t - 2.0, 1.0 - 3.0 * t, t};
  return b;
}

// One axis of the grid: cell index, coordinate within it, and whether the point lies inside.
struct Cell {
  int index;
  double t;
  bool inside;
};

inline Cell locate(double position_m, double origin_m, double step_m, int count) noexcept {
  const double cells = static_cast<double>(count - 3);
  const double u = (position_m - origin_m) / step_m;
  const double clamped = std::clamp(u, 0.0, cells);
  const int index = std::min(static_cast<int>(clamped), count - 4);
  return {index, clamped - index, u >= 0.0 && u <= cells};
}

}  // namespace

Plane::Plane(double z_m, const Eigen::Vector3d& normal)
    : z_m_(z_m), gradient_(-normal.x() / normal.z(), -normal.y() / normal.z()) {}

SurfacePoint Plane::at(double x_m, double y_m) const noexcept {
  return {z_m_ + gradient_.x() * x_m + gradient_.y() * y_m, gradient_, Eigen::Matrix2d::Zero()};
}

BSpline::BSpline(const Grid& grid, std::vector<double> heights_m)
    : grid_(grid), heights_m_(std::move(heights_m)) {}

SurfacePoint BSpline::at(double x_m, double y_m) const noexcept {
  // A position that is not a number must not become an index.
  if (!std::isfinite(x_m) || !std::isfinite(y_m)) {
    constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
    return {kNone, Eigen::Vector2d::Constant(kNone), Eigen::Matrix2d::Constant(kNone)};
  }
  const Cell cx = locate(x_m, grid_.x0_m, grid_.dx_m, grid_.nx);
  const Cell cy = locate(y_m, grid_.y0_m, grid_.dy_m, grid_.ny);
  const Basis bx = basis(cx.t);
  const Basis by = basis(cy.t);
  const double* row = heights_m_.data() +
                      static_cast<std::size_t>(cx.index) * static_cast<std::size_t>(grid_.ny) +
                      static_cast<std::size_t>(cy.index);
  Eigen::Vector4d along_y;
  Eigen::Vector4d along_y_first;
  Eigen::Vector4d along_y_second;
  for (Eigen::Index i = 0; i < 4; ++i, row += grid_.ny) {
    const Eigen::Map<const Eigen::Vector4d> c(row);
    along_y(i) = c.dot(by.value);
    along_y_first(i) = c.dot(by.first);
    along_y_second(i) = c.dot(by.second);
  }

  SurfacePoint point;
  point.z_m = bx.value.dot(along_y);
  // Clamped outside: the height no longer depends on that coordinate.
  const double kx = cx.inside ? 1.0 / grid_.dx_m : 0.0;
  const double ky = cy.inside ? 1.0 / grid_.dy_m : 0.0;
  point.gradient << kx * bx.first.dot(along_y), ky * bx.value.dot(along_y_first);
  const double xy = kx * ky * bx.first.dot(along_y_first);
  point.hessian << kx * kx * bx.second.dot(along_y), xy, xy, ky * ky * bx.value.dot(along_y_second);
  return point;
}

}  // namespace groma::model
