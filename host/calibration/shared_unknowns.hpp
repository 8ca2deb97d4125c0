// Unknowns of a drive that all anchors share: pose drift, range delay, and each tag's lever-arm error and
// antenna pattern.
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include <Eigen/Cholesky>
#include <Eigen/Core>

#include "host/calibration/association.hpp"
#include "host/calibration/site_solver.hpp"
#include "host/model/antenna_pattern.hpp"
#include "host/model/range_model.hpp"

namespace groma::calibration {

// Prior of the pose drift: in x, y (map) and yaw, each a stationary process; sigma_m zero means that the
// poses are exact.
struct DriftPrior {
  double sigma_m = 0.0;
  double sigma_yaw_rad = 0.0;
  double correlation_s = 20.0;  // by hand: where the search starts (kFirstDrift in drive_error.cpp)
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
  double spacing_s = 8.0;  // set by place_knots()
  Eigen::Index count = 2;
};

// Largest spacing of the knots, unless the drive would need more than max_count.
struct KnotGrid {
  double spacing_s;
  double max_count;
};
// None if no time passes between the observations.
[[nodiscard]] std::optional<Knots> place_knots(std::span<const AnchorFit> fits, const KnotGrid& grid);

struct KnotShare {
  Eigen::Index first = 0;  // index of the knot's first unknown
  double fraction = 0.0;   // towards the next knot
};
[[nodiscard]] KnotShare knot_share(const Knots& knots, double t_s) noexcept;

// Order of the unknowns: x, y, yaw of each knot, the delay, the body terms of each of body_tags tags.
struct SharedUnknowns {
  Knots knots;
  // Factor of the drift's prior at each knot (x, y, yaw), if poses report a covariance; else empty, and all
  // knots are alike.
  std::vector<Eigen::Matrix3d> knot_scale;
  std::size_t body_tags = 0;

  [[nodiscard]] Eigen::Index delay() const noexcept { return 3 * knots.count; }
  [[nodiscard]] Eigen::Index body(std::size_t tag) const noexcept {
    return delay() + 1 + kBodyTerms * static_cast<Eigen::Index>(tag);
  }
  [[nodiscard]] Eigen::Index size() const noexcept { return body(body_tags); }
};

// Typical standard deviations that the poses of a drive report: their median.
struct PoseQuality {
  double sigma_m = 0.0;
  double sigma_yaw_rad = 0.0;
};
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

// Derivative of one predicted range by the shared unknowns that it depends on: the knots before and after it
// (6), the delay, the body terms of its tag.
inline constexpr Eigen::Index kMotionTerms = 7;
inline constexpr Eigen::Index kSharedTerms = kMotionTerms + kBodyTerms;
using SharedRow = Eigen::Matrix<double, kSharedTerms, 1>;
// `fraction` is that of the observation's KnotShare.
[[nodiscard]] SharedRow shared_jacobian(const Observation& row, const model::AntennaPrediction& predicted,
                                        double fraction) noexcept;

// Corrects an observation by a step of the unknowns: moves the antenna, subtracts the pattern from the range.
// `anchor_m` is the anchor's estimated position.
void move_row(const SharedUnknowns& unknowns, const Eigen::VectorXd& step, const Eigen::Vector3d& anchor_m,
              Observation& row) noexcept;

// Prior of the unknowns; those with sigma zero, or `body` false, are fixed at zero.
struct SharedPrior {
  DriftPrior drift;
  double delay_sigma_s = 0.03;  // kDelaySigma_s in drive_error.cpp
  bool body = false;
};
// Information matrix of the prior; a sigma of zero is replaced by a negligible one.
[[nodiscard]] Eigen::MatrixXd prior_information(const SharedUnknowns& unknowns, const SharedPrior& prior);
// Log determinant of the information of the unknowns that are not fixed at zero, up to a constant.
[[nodiscard]] double prior_log_determinant(const SharedUnknowns& unknowns, const SharedPrior& prior);

// One anchor's equations after elimination: its step is information^-1 descent - gain times the shared step.
struct AnchorPart {
  Eigen::LLT<Eigen::MatrixXd> information;
  Eigen::VectorXd descent;
  Eigen::MatrixXd gain;  // information^-1 times the cross information with the shared unknowns
};

struct JointEquations {
  std::vector<AnchorPart> anchors;
  Eigen::MatrixXd information;  // of the shared unknowns (Schur complement), without their prior
  Eigen::VectorXd descent;
};

// Eliminates the anchors from the joint normal equations. `inflation` of each anchor divides its information:
// its residuals are correlated.
[[nodiscard]] JointEquations eliminate_anchors(std::span<const AnchorFit> fits,
                                               std::span<const double> inflation,
                                               const SharedUnknowns& unknowns);

}  // namespace groma::calibration
