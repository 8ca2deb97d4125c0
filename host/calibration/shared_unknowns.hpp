// Unknowns of a drive that all anchors share: pose drift, range delay, and each tag's lever-arm error and
// antenna pattern. Their prior, and which of them the ranges show.
#pragma once

#include <cstddef>
#include <functional>
#include <optional>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/anchor_solver.hpp"
#include "host/calibration/association.hpp"
#include "host/model/antenna_pattern.hpp"

namespace groma::calibration {

// Prior of the pose drift: in x, y (map) and yaw, each a stationary process; sigma_m zero means that the
// poses are exact.
struct DriftPrior {
  double sigma_m = 0.0;
  double sigma_yaw_rad = 0.0;
  double correlation_s = 20.0;  // by hand: where the search starts (kFirstDrift)
  // None: first order (Gauss-Markov), rough. Else second order, smooth: white noise through an oscillator
  // with natural frequency 1/correlation_s and this damping ratio, in (0, 1]; far below one if the robot
  // passes the same places repeatedly.
  std::optional<double> damping_ratio = {};
};
// Correlation of the drift at two times `apart_s` from each other.
[[nodiscard]] double drift_correlation(const DriftPrior& drift, double apart_s) noexcept;

// Body terms of one tag: the error of its lever arm (base_link, m), then the coefficients of its antenna
// pattern (m).
inline constexpr Eigen::Index kBodyTerms = 3 + model::kPatternTerms;
using BodyVector = Eigen::Matrix<double, kBodyTerms, 1>;
using BodyMatrix = Eigen::Matrix<double, kBodyTerms, kBodyTerms>;

// Their prior sigmas: of a lever arm measured by hand, and of a common antenna's pattern coefficients. Both
// are assumed; DriveError.EstimatesLeverArmsAndPatterns draws from them, so it does not verify them.
inline constexpr double kLeverArmSigma_m = 0.02;
inline constexpr double kPatternSigma_m = 0.015;

// Knots of the pose drift, which is linear between them.
struct Knots {
  double begin_s = 0.0;
  double spacing_s = 8.0;
  Eigen::Index count = 2;
};

// Typical standard deviations that the poses of a drive report: their median.
struct PoseQuality {
  double sigma_m = 0.0;
  double sigma_yaw_rad = 0.0;
};

// Order of the unknowns: x, y, yaw of each knot, the delay, the body terms of each of body_tags tags.
struct SharedUnknowns {
  Knots knots;
  // If poses report a covariance: the typical one, and the factor of the drift's prior at each knot (x, y,
  // yaw). Else none, and all knots are alike.
  std::optional<PoseQuality> typical = {};
  std::vector<Eigen::Matrix3d> knot_scale;
  std::size_t body_tags = 0;

  [[nodiscard]] Eigen::Index delay() const noexcept { return 3 * knots.count; }
  [[nodiscard]] Eigen::Index body(std::size_t tag) const noexcept {
    return delay() + 1 + kBodyTerms * static_cast<Eigen::Index>(tag);
  }
  [[nodiscard]] Eigen::Index size() const noexcept { return body(body_tags); }
};

// Largest spacing of the knots, unless the drive would need more than max_count.
struct KnotGrid {
  double spacing_s;
  double max_count;
};
// None if no time passes between the observations.
[[nodiscard]] std::optional<SharedUnknowns> lay_out(std::span<const AnchorFit> fits,
                                                    std::span<const PoseSpread> spreads, const KnotGrid& grid,
                                                    std::size_t body_tags);
// None if no pose reports a covariance.
[[nodiscard]] std::optional<PoseQuality> typical_quality(std::span<const PoseSpread> spreads);
// L D^-1 of each knot, with L L^T the mean covariance of the poses nearest to it and D the typical sigmas;
// identity where no pose reports one.
[[nodiscard]] std::vector<Eigen::Matrix3d> scale_knots(const Knots& knots,
                                                       std::span<const PoseSpread> spreads,
                                                       const PoseQuality& typical);
// White share of the poses' variance beside a drift of this size: what the drift leaves of the reported
// variance, and what linear interpolation between knots misses.
[[nodiscard]] double white_share(const DriftPrior& drift, const PoseQuality& typical, double spacing_s);

// Prior sigma of the delay: by hand; Calibrate.EstimatesTheRangeDelay finds 0.05 s with it. And that of no
// delay, 3 um at 30 m/s.
inline constexpr double kDelaySigma_s = 0.03;
inline constexpr double kNoDelaySigma_s = 1e-7;

// Prior of the unknowns; those with sigma zero, or `body` false, are fixed at zero.
struct SharedPrior {
  DriftPrior drift;
  double delay_sigma_s = kDelaySigma_s;
  bool body = false;
};
// Information matrix of the prior; a sigma of zero is replaced by a negligible one.
[[nodiscard]] Eigen::MatrixXd prior_information(const SharedUnknowns& unknowns, const SharedPrior& prior);
// Log determinant of the information of the unknowns that are not fixed at zero, up to a constant.
[[nodiscard]] double prior_log_determinant(const SharedUnknowns& unknowns, const SharedPrior& prior);

// Equations of the shared unknowns without their prior, the anchors eliminated.
struct SharedEquations {
  Eigen::MatrixXd information;  // Schur complement
  Eigen::VectorXd descent;
};

// The prior with drift, body terms, both or neither that the ranges show. `equations` are inflated by
// correlations of the ranges themselves; `slow` makes those that are inflated also by errors that depend on
// place, and is called only if the others show something. On coarse knots.
[[nodiscard]] SharedPrior likeliest_prior(const SharedEquations& equations, const SharedUnknowns& unknowns,
                                          const std::function<SharedEquations()>& slow);
// Refines size, correlation time and shape of the prior's drift. Needs fine knots: coarse ones show neither
// the time nor the shape.
[[nodiscard]] SharedPrior likeliest_drift(const SharedEquations& equations, const SharedUnknowns& unknowns,
                                          const SharedPrior& rough);

}  // namespace groma::calibration
