// Heights that were measured, by a survey, a LiDAR or the robot's own poses, as a smooth surface.
#pragma once

#include <cstddef>
#include <optional>
#include <span>

#include <Eigen/Core>

#include "host/model/surface.hpp"

namespace groma::model {

struct SurfaceFitOptions {
  std::optional<double> spacing_m;  // between knots, > 0; none: chosen by cross-validation
  // Weight of the squared second differences of neighbouring control heights against the squared residuals of
  // the points in one cell, on the average, >= 0; none: chosen likewise.
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
  double held_out_rms_m = 0.0;  // of points that the fit had not seen, nor others near them
  // Of the rectangle around the points: share of the spline's cells without one, and the place that is
  // farthest from any, to a cell's width.
  double empty_share = 0.0;
  double gap_m = 0.0;
  Eigen::Vector2d gap_at_m = Eigen::Vector2d::Zero();
};

// Control heights along both axes together, at most.
inline constexpr double kMaxControlHeights = 100'000.0;
inline constexpr std::size_t kMinSurfacePoints = 3;

// Least squares of a spline through the points (x, y, z; at least kMinSurfacePoints, finite) with its bending
// held down. The mismatch is what held-out residuals of neighbouring points have in common: their covariance
// at short distances, and the distance at which it has fallen by e; what is each point's own is noise. None
// where the spacing asks for more than kMaxControlHeights.
[[nodiscard]] std::optional<SurfaceFit> fit_surface(std::span<const Eigen::Vector3d> points,
                                                    const SurfaceFitOptions& options = {});

// The slope's error of a ground whose height errs by sigma_m, with a covariance that falls like a Gaussian to
// 1/e over length_m.
[[nodiscard]] double slope_sigma(double sigma_m, double length_m) noexcept;

}  // namespace groma::model
