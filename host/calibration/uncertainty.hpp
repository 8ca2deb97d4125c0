// Covariance of an anchor's solution from the undamped information, corrected for residuals that are
// correlated in time.
#pragma once

#include <array>
#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/anchor_solver.hpp"

namespace groma::calibration {

// Scatter of the score (the gradient of the data's cost), summed over blocks of the drive of one length, in
// the metric of the information: as observed, and as expected if residuals were independent.
struct Scatter {
  double observed = 0.0;
  double expected = 0.0;
  double blocks = 0.0;
};
inline constexpr std::size_t kBlockLevels = 9;  // 0.5 s, each twice as long as the one before: up to 128 s

// Statistics of one anchor's ranges at its solution.
struct Evidence {
  Eigen::MatrixXd information;  // of priors and data, at the kernels' mean curvature
  Eigen::MatrixXd prior_information;
  Eigen::MatrixXd score_variance;             // of the score, if residuals were independent
  std::array<Scatter, kBlockLevels> scatter;  // by block length
  bool surveyed = false;                      // the position was held fixed
};
[[nodiscard]] Evidence gather_evidence(const AnchorFit& fit);
[[nodiscard]] std::vector<Evidence> gather_evidence(std::span<const AnchorFit> fits);

// Scatter of the score over that of independent residuals: 1 for white residuals, else about the number of
// ranges that together carry one range's information. One value per anchor: the site's mean, or its own where
// that is clearly larger.
[[nodiscard]] std::vector<double> score_inflation(std::span<const Evidence> evidence);

// The same of one anchor alone, over blocks of at most `duration_s`.
[[nodiscard]] double inflation_within(const Evidence& evidence, double duration_s);

// Delete-a-fifth jackknife covariance of the position, m^2: how the position depends on the part of the drive
// that is left out. Unlike scores it shows correlations as long as that and a cost that is not quadratic.
// None if there are too few ranges, or if the position was held fixed.
[[nodiscard]] std::optional<Eigen::Matrix3d> jackknife_covariance(const AnchorFit& fit);

// Covariance to add where the jackknife exceeds the expected position covariance; only in directions in which
// that is significant. The biases follow by regression. `expected`: of the ranges alone, for the anchor's
// unknowns.
[[nodiscard]] Eigen::MatrixXd excess_of_jackknife(const Eigen::Matrix3d& jackknife,
                                                  const Eigen::MatrixXd& expected);

// Covariance of the anchor's unknowns: H^-1 (prior + inflation G) H^-1, with H the information and G the
// score's variance. A surveyed position keeps its prior's covariance, which propagates into the biases: they
// were estimated with the position held fixed.
[[nodiscard]] Eigen::MatrixXd anchor_covariance(const Evidence& evidence, double inflation);

// Inverse information from at most 200 ranges evenly spaced among all, scaled to all: what the geometry of
// the drive leaves open, without what the residuals show of the noise. The position must not be surveyed.
[[nodiscard]] Eigen::MatrixXd rough_covariance(const AnchorFit& fit);

// Standard deviation of a predicted range by the covariance of the anchor's position and biases, m; `j` as in
// RowAt.
[[nodiscard]] double prediction_sigma_m(const PairRow& j, std::size_t tag,
                                        const Eigen::MatrixXd& covariance) noexcept;

}  // namespace groma::calibration
