// Fits a smooth surface to heights measured by a survey, a LiDAR or the robot's own poses.
#pragma once

#include <cstddef>
#include <optional>
#include <span>

#include <Eigen/Core>

#include "host/model/surface.hpp"

namespace groma::model {

struct SurfaceFitOptions {
  std::optional<double> spacing_m;  // between knots, > 0; none: chosen by cross-validation
  // Weight of the squared second differences of neighbouring control heights against the mean sum of squared
  // residuals in one cell, >= 0; none: chosen by cross-validation.
  std::optional<double> smoothing;
};

struct SurfaceFit {
  BSpline spline;
  SurfaceMismatch mismatch;
  double spacing_m = 0.0;
  double smoothing = 0.0;
  std::size_t points = 0;
  double rms_m = 0.0;           // of the residuals
  double max_m = 0.0;           // the largest residual
  double held_out_rms_m = 0.0;  // of blocks of points that the fit did not use
  // In the rectangle around the points: the share of the spline's cells without a point, and the distance and
  // place farthest from any point, at a resolution of one cell.
  double empty_share = 0.0;
  double gap_m = 0.0;
  Eigen::Vector2d gap_at_m = Eigen::Vector2d::Zero();
};

// Upper bound on nx * ny: by hand, on time and memory.
inline constexpr double kMaxControlHeights = 100'000.0;
inline constexpr std::size_t kMinSurfacePoints = 3;  // geometry: three points define a plane

// Least-squares fit of a spline to the points (x, y, z; at least kMinSurfacePoints, finite) with a penalty on
// bending. The mismatch is the covariance of the held-out residuals of neighbouring points at short
// distances, and the distance at which it has fallen to 1/e; the uncorrelated remainder is measurement noise.
// None if the spacing needs more than kMaxControlHeights, or if the system cannot be solved.
[[nodiscard]] std::optional<SurfaceFit> fit_surface(std::span<const Eigen::Vector3d> points,
                                                    const SurfaceFitOptions& options = {});

// Sigma of the slope error of a ground whose height error has sigma_m and a Gaussian-shaped covariance that
// falls to 1/e at length_m.
[[nodiscard]] double slope_sigma(double sigma_m, double length_m) noexcept;

}  // namespace groma::model
