// How far an anchor's solution can be trusted: covariance from the undamped information, corrected for
// residuals that hang together in time.
#pragma once

#include <array>
#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/site_solver.hpp"
#include "host/model/calibration.hpp"

namespace groma::calibration {

// Scatter of the score, the data's gradient, summed over blocks of one length of the drive: in the metric of
// the information, what is seen and what independent residuals would give.
struct Scatter {
  double observed = 0.0;
  double expected = 0.0;
  double blocks = 0.0;
};
inline constexpr std::size_t kBlockLevels = 9;  // each twice as long as the one before: up to 128 s

// The statistics of one anchor's rows at its solution.
struct Evidence {
  Eigen::MatrixXd information;  // of priors and data, at the kernels' mean curvature
  Eigen::MatrixXd prior_information;
  Eigen::MatrixXd score_variance;             // of the score, were residuals independent
  std::array<Scatter, kBlockLevels> scatter;  // by the length of its blocks
  bool surveyed = false;                      // the position was held fixed
};
[[nodiscard]] Evidence gather_evidence(const AnchorFit& fit);
[[nodiscard]] std::vector<Evidence> gather_evidence(std::span<const AnchorFit> fits);

// How much more the score scatters than independent residuals would make it: 1 for white residuals, else
// about the number of ranges that together carry one range's information. One figure an anchor: the site's
// mean, or its own where that is clearly larger.
[[nodiscard]] std::vector<double> score_inflation(std::span<const Evidence> evidence);

// The same of one anchor alone, over blocks no longer than this.
[[nodiscard]] double inflation_within(const Evidence& evidence, double duration_s);

// How the position scatters with which part of the drive it was solved from: the delete-a-fifth jackknife,
// m^2. Unlike scores it sees what hangs together for as long as that, and where the cost is no parabola. None
// where there are too few rows, or the position was held fixed.
[[nodiscard]] std::optional<Eigen::Matrix3d> jackknife_covariance(const AnchorFit& fit);

// What the jackknife has more than the covariance expected, in those directions where that is no chance, on
// the position; the biases follow by regression. `expected`: of the ranges alone, (position, beta, gamma
// ...).
[[nodiscard]] Eigen::MatrixXd excess_of_jackknife(const Eigen::Matrix3d& jackknife,
                                                  const Eigen::MatrixXd& expected);

// Covariance of (position, beta, gamma): H^-1 (prior + inflation G) H^-1. A surveyed position keeps its
// prior's covariance, and its error goes on into the biases that were learnt with it held fixed.
[[nodiscard]] Eigen::MatrixXd anchor_covariance(const Evidence& evidence, double inflation);

// The inverse of the information that some hundreds of the rows, spread over all of them, have for all: what
// the drive's way leaves open, without what the residuals tell of the noise. The position must not be
// surveyed.
[[nodiscard]] Eigen::MatrixXd rough_covariance(const AnchorFit& fit);

// Standard deviation of a predicted range by the covariance of the anchor's position and biases, m; `j`: as
// RowAt has it.
[[nodiscard]] double prediction_sigma_m(const PairRow& j, std::size_t tag,
                                        const Eigen::MatrixXd& covariance) noexcept;

// From the residuals of every pair at the solution; each pair counts alike and the median decides, so that a
// few anchors behind walls do not. None where fewer than three pairs have rows enough.
[[nodiscard]] std::optional<model::RangeNoise> range_noise(std::span<const AnchorFit> fits);

}  // namespace groma::calibration
