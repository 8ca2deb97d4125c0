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

// The position has to be finite.
inline Cell locate(double position_m, double origin_m, double step_m, int count) noexcept {
  const double cells = static_cast<double>(count - 3);
  const double u = (position_m - origin_m) / step_m;
  const double clamped = std::clamp(u, 0.0, cells);
  const int index = std::min(static_cast<int>(clamped), count - 4);
  return {index, clamped - index, u >= 0.0 && u <= cells};
}

// Whether a ray from the point crosses the polygon's border an odd number of times.
bool is_inside(const std::vector<Eigen::Vector2d>& polygon, double x_m, double y_m) noexcept {
  bool inside = false;
  for (std::size_t i = 0, j = polygon.size() - 1; i < polygon.size(); j = i++) {
    const Eigen::Vector2d& a = polygon[i];
    const Eigen::Vector2d& b = polygon[j];
    if ((a.y() > y_m) == (b.y() > y_m)) continue;
    if (x_m < a.x() + (y_m - a.y()) / (b.y() - a.y()) * (b.x() - a.x())) inside = !inside;
  }
  return inside;
}

}  // namespace

Plane::Plane(double z_m, const Eigen::Vector3d& normal)
    : z_m_(z_m), gradient_(-normal.x() / normal.z(), -normal.y() / normal.z()) {}

SurfacePoint Plane::at(double x_m, double y_m) const noexcept {
  return {z_m_ + gradient_.x() * x_m + gradient_.y() * y_m, gradient_, Eigen::Matrix2d::Zero()};
}

BSpline::BSpline(const Grid& grid, std::vector<double> heights_m)
    : grid_(grid), per_m_(1.0 / grid.dx_m, 1.0 / grid.dy_m), heights_m_(std::move(heights_m)) {}

SurfacePoint BSpline::at(double x_m, double y_m) const noexcept {
  // A non-finite position must not become an index.
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
  Eigen::Vector4d value = Eigen::Vector4d::Zero();
  Eigen::Vector4d first = Eigen::Vector4d::Zero();
  Eigen::Vector4d second = Eigen::Vector4d::Zero();
  for (Eigen::Index i = 0; i < 4; ++i, row += grid_.ny) {
    const Eigen::Map<const Eigen::Vector4d> c(row);
    value += bx.value(i) * c;
    first += bx.first(i) * c;
    second += bx.second(i) * c;
  }

  SurfacePoint point;
  point.z_m = value.dot(by.value);
  // Clamped outside: the height no longer depends on that coordinate.
  const double kx = cx.inside ? per_m_.x() : 0.0;
  const double ky = cy.inside ? per_m_.y() : 0.0;
  point.gradient << kx * first.dot(by.value), ky * value.dot(by.first);
  const double xy = kx * ky * first.dot(by.first);
  point.hessian << kx * kx * second.dot(by.value), xy, xy, ky * ky * value.dot(by.second);
  return point;
}

double BSpline::height_m(double x_m, double y_m) const noexcept {
  if (!std::isfinite(x_m) || !std::isfinite(y_m)) return std::numeric_limits<double>::quiet_NaN();
  const Cell cx = locate(x_m, grid_.x0_m, grid_.dx_m, grid_.nx);
  const Cell cy = locate(y_m, grid_.y0_m, grid_.dy_m, grid_.ny);
  const Eigen::Vector4d along_x = basis(cx.t).value;
  const double* row = heights_m_.data() +
                      static_cast<std::size_t>(cx.index) * static_cast<std::size_t>(grid_.ny) +
                      static_cast<std::size_t>(cy.index);
  Eigen::Vector4d value = Eigen::Vector4d::Zero();
  for (Eigen::Index i = 0; i < 4; ++i, row += grid_.ny)
    value += along_x(i) * Eigen::Map<const Eigen::Vector4d>(row);
  return value.dot(basis(cy.t).value);
}

bool Surface::covers(double x_m, double y_m, int chart) const noexcept {
  if (!std::isfinite(x_m) || !std::isfinite(y_m)) return false;
  const Chart& at = charts_[static_cast<std::size_t>(chart)];
  if (const auto* spline = std::get_if<BSpline>(&at.shape)) {
    const BSpline::Grid& grid = spline->grid();
    if (!locate(x_m, grid.x0_m, grid.dx_m, grid.nx).inside) return false;
    if (!locate(y_m, grid.y0_m, grid.dy_m, grid.ny).inside) return false;
  }
  return at.domain_m.empty() || is_inside(at.domain_m, x_m, y_m);
}

int Surface::follow(int chart, double x_m, double y_m) const noexcept {
  if (charts_.size() == 1 || covers(x_m, y_m, chart)) return chart;
  const double z_m = at(x_m, y_m, chart).z_m;
  double least_m = kStep_m;
  int found = chart;
  for (int other = 0; other < chart_count(); ++other) {
    if (other == chart || !covers(x_m, y_m, other)) continue;
    const double apart_m = std::abs(at(x_m, y_m, other).z_m - z_m);
    if (!(apart_m < least_m)) continue;
    least_m = apart_m;
    found = other;
  }
  return found;
}

int Surface::nearest(double x_m, double y_m, double z_m) const noexcept {
  int found = -1;
  bool found_covers = false;
  double least_m = 0.0;
  for (int chart = 0; chart < chart_count(); ++chart) {
    const bool covered = covers(x_m, y_m, chart);
    const double apart_m = std::abs(at(x_m, y_m, chart).z_m - z_m);
    const bool better =
        found < 0 || (covered && !found_covers) || (covered == found_covers && apart_m < least_m);
    if (!better) continue;
    found = chart;
    found_covers = covered;
    least_m = apart_m;
  }
  return found;
}

}  // namespace groma::model
