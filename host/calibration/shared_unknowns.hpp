// What is unknown of a drive beside its anchors, and shared by all of them: how the poses wander, how late
// ranges are stamped, and what each tag's ranges owe to its place and attitude on the robot's body.
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

// The belief in the poses' error before any range is seen: in x, in y (map) and in yaw, each a stationary
// process; zero means that the poses are exact.
struct WanderPrior {
  double sigma_m = 0.0;
  double sigma_yaw_rad = 0.0;
  double correlation_s = 20.0;
  // None: of first order, which is rough. Else of second order, which is smooth: white noise through an
  // oscillator of the natural frequency 1/correlation_s with this damping ratio, in (0, 1]; far below one
  // where the robot comes by the same places again and again.
  std::optional<double> damping_ratio = {};
};
// Between two times so far apart, of variance one.
[[nodiscard]] double wander_correlation(const WanderPrior& wander, double apart_s) noexcept;

// Of one tag: the error of its lever arm (base_link, m), then the coefficients of its antenna's pattern (m).
inline constexpr Eigen::Index kBodyTerms = 3 + model::kPatternTerms;
using BodyVector = Eigen::Matrix<double, kBodyTerms, 1>;
using BodyMatrix = Eigen::Matrix<double, kBodyTerms, kBodyTerms>;

// Of their prior: how well a lever arm is measured by hand, and what the pattern of a common antenna does to
// a range.
inline constexpr double kLeverArmSigma_m = 0.02;
inline constexpr double kPatternSigma_m = 0.015;

// Where the knots of the wander are; between them it is linear.
struct Knots {
  double begin_s = 0.0;
  double spacing_s = 8.0;
  Eigen::Index count = 2;
};

// Knots at most this far apart where the drive is not too long for so many.
struct KnotGrid {
  double spacing_s;
  double max_count;
};
// None where no time passes between the rows.
[[nodiscard]] std::optional<Knots> place_knots(std::span<const AnchorFit> fits, const KnotGrid& grid);

struct KnotShare {
  Eigen::Index first = 0;  // its knot's first index
  double fraction = 0.0;   // of the way to the next
};
[[nodiscard]] KnotShare knot_share(const Knots& knots, double t_s) noexcept;

// The order of the unknowns: x, y, yaw of each knot, the delay, the body terms of each tag or of none.
struct SharedUnknowns {
  Knots knots;
  // What the wander of each knot is multiplied by (x, y, yaw), where the poses tell how good they are; else
  // empty, and all are alike.
  std::vector<Eigen::Matrix3d> knot_scale;
  std::size_t body_tags = 0;

  [[nodiscard]] Eigen::Index delay() const noexcept { return 3 * knots.count; }
  [[nodiscard]] Eigen::Index body(std::size_t tag) const noexcept {
    return delay() + 1 + kBodyTerms * static_cast<Eigen::Index>(tag);
  }
  [[nodiscard]] Eigen::Index size() const noexcept { return body(body_tags); }
};

// What the poses of a drive tell of their error: standard deviations of the middle one.
struct PoseQuality {
  double sigma_m = 0.0;
  double sigma_yaw_rad = 0.0;
};
// None where no pose tells it.
[[nodiscard]] std::optional<PoseQuality> typical_quality(std::span<const PoseSpread> spreads);
// Of each knot, L D^-1: L L^T the mean covariance of the poses nearest to it, D the typical sigmas; one where
// none of them tells it.
[[nodiscard]] std::vector<Eigen::Matrix3d> scale_knots(const Knots& knots,
                                                       std::span<const PoseSpread> spreads,
                                                       const PoseQuality& typical);
// The share of the poses' variance that is new from pose to pose, beside a wander of this size: what the
// wander leaves of what they tell, and what a line between its knots misses.
[[nodiscard]] double white_share(const WanderPrior& wander, const PoseQuality& typical, double spacing_s);

// Derivative of one predicted range by the shared unknowns that it depends on: both knots about it (6), the
// delay, the body terms of its tag.
inline constexpr Eigen::Index kMotionTerms = 7;
inline constexpr Eigen::Index kSharedTerms = kMotionTerms + kBodyTerms;
using SharedRow = Eigen::Matrix<double, kSharedTerms, 1>;
// `fraction` is that of the row's KnotShare.
[[nodiscard]] SharedRow shared_jacobian(const Observation& row, const model::AntennaPrediction& predicted,
                                        double gamma, double fraction) noexcept;

// The row as the unknowns have it changed by a step: antenna moved, pattern taken off the range. `anchor_m`
// is where the anchor is thought to be.
void move_row(const SharedUnknowns& unknowns, const Eigen::VectorXd& step, const Eigen::Vector3d& anchor_m,
              Observation& row) noexcept;

// Which of the unknowns are not zero for sure, and what is believed of them.
struct SharedPrior {
  WanderPrior wander;
  double delay_sigma_s = 0.03;
  bool body = false;
};
// Information of the prior; a sigma of zero stands for one too small to matter.
[[nodiscard]] Eigen::MatrixXd prior_information(const SharedUnknowns& unknowns, const SharedPrior& prior);
// Of those unknowns that are not zero for sure, but for a constant.
[[nodiscard]] double prior_log_determinant(const SharedUnknowns& unknowns, const SharedPrior& prior);

// One anchor's part, solved for the anchor: its step is information^-1 descent - gain times the shared step.
struct AnchorPart {
  Eigen::LLT<Eigen::MatrixXd> information;
  Eigen::VectorXd descent;
  Eigen::MatrixXd gain;  // information^-1 times the cross information with the shared unknowns
};

struct JointEquations {
  std::vector<AnchorPart> anchors;
  Eigen::MatrixXd information;  // of the shared unknowns (Schur complement), their prior left out
  Eigen::VectorXd descent;
};

// `inflation` of each anchor: its ranges carry so many times less than were they independent.
[[nodiscard]] JointEquations eliminate_anchors(std::span<const AnchorFit> fits,
                                               std::span<const double> inflation,
                                               const SharedUnknowns& unknowns);

}  // namespace groma::calibration
