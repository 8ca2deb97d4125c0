// Position and pair biases of one anchor from its ranges, by robust non-linear least squares on eq. (12), and
// their covariance from the undamped information, corrected for residuals that are correlated in time.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/association.hpp"
#include "host/calibration/robust_kernel.hpp"
#include "host/model/range_model.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

inline constexpr std::int32_t kNoEpisode = -1;

// Prior probability of one range's state (LOS, short NLOS, long NLOS), from all data except its own residual.
struct RangeLos {
  float los = 1.0F;
  float long_nlos = 0.0F;
  // Density of the range in the other states times their probability, 1/m. Short NLOS says nothing about the
  // anchor's position: constant in the residual.
  float other_density = 0.0F;
  std::int32_t episode = kNoEpisode;  // index of the anchor's long NLOS episode
};
// A range that says nothing about the anchor.
inline constexpr RangeLos kIgnored{.los = 0.0F, .other_density = 1.0F};
[[nodiscard]] constexpr bool is_ignored(const RangeLos& range) noexcept {
  return range.los == 0.0F && range.long_nlos == 0.0F;
}

// Prior of the excess of long NLOS: a part common to all ranges, and one per episode. By hand; the NlosSite
// tests hold with it, with walls that add 0.3 m and an exponential excess of 0.15 m on average.
struct LongNlosPrior {
  double mean_m = 0.4;
  double sigma_m = 0.2;
  double episode_sigma_m = 0.2;
};

// NLOS states of all ranges of an anchor. If some are long NLOS, the common excess and those of the episodes
// are unknowns too.
struct AnchorLos {
  std::vector<RangeLos> rows;  // by Observation::index
  bool has_long_nlos = false;  // some ranges are long NLOS
  std::size_t episodes = 0;
  LongNlosPrior prior;
  RobustKernel long_nlos;  // of a long NLOS residual without its excess

  // Unknowns beside position and terms.
  [[nodiscard]] Eigen::Index extra_unknowns() const noexcept {
    return has_long_nlos ? 1 + static_cast<Eigen::Index>(episodes) : 0;
  }
};

// Unknowns of one anchor: position (m, map) and terms of each tag, model::anchor_size(T). With long NLOS,
// then the common excess and that of each episode (m), as in AnchorLos.
using AnchorVector = Eigen::VectorXd;
using model::anchor_at;

// Index of the common excess, and of an episode's.
[[nodiscard]] Eigen::Index excess_index(std::size_t tag_count) noexcept;
[[nodiscard]] Eigen::Index episode_index(std::int32_t episode, std::size_t tag_count) noexcept;
// Position and terms of one pair.
using PairIndex = std::array<Eigen::Index, model::kPairSize>;
[[nodiscard]] PairIndex pair_index(std::size_t tag, std::size_t tag_count) noexcept;
[[nodiscard]] model::TermVector terms_of(const AnchorVector& anchor, std::size_t tag,
                                         std::size_t tag_count) noexcept;

// Gaussian prior of the position; a zero eigenvalue leaves a direction open.
struct PositionPrior {
  Eigen::Vector3d mean_m = Eigen::Vector3d::Zero();
  Eigen::Matrix3d information = Eigen::Matrix3d::Zero();  // 1/m^2
  bool surveyed = false;                                  // held fixed: only biases are estimated
};

struct AnchorProblem {
  std::span<const Observation> rows;
  std::size_t tag_count = 0;
  model::RangePriors priors;
  PositionPrior position;
  const AnchorLos* los_states = nullptr;  // none: no NLOS states beyond the kernels'
};

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
  // Inflation of this anchor alone: brief, over blocks of up to 1 s, by correlation in the ranges themselves,
  // as when they are filtered or repeated; lasting, of up to 8 s, also by errors that depend on place.
  double brief_inflation = 1.0;
  double lasting_inflation = 1.0;
  bool surveyed = false;  // the position was held fixed
};

// One anchor's solution with its problem and kernels.
struct AnchorFit {
  AnchorProblem problem = {};  // its rows belong to the association
  AnchorVector anchor;
  std::vector<RobustKernel> kernels = {};  // one per tag
  double cost = 0.0;
  Evidence evidence = {};  // gather_evidence() of this solution; empty before
  double inflation = 1.0;  // estimate_inflation(): residuals correlated in time
};

// Eq. (12) at the antenna's position.
[[nodiscard]] model::AntennaPrediction predict(const Observation& row, const AnchorVector& anchor,
                                               std::size_t tag_count) noexcept;
// Measured minus predicted.
[[nodiscard]] double residual_m(const Observation& row, const AnchorVector& anchor,
                                std::size_t tag_count) noexcept;
// Variance of a range due to the pose's own error: J C J^T with C that of the antenna, m^2; zero if the poses
// have no covariance.
[[nodiscard]] double pose_variance_m2(const Observation& row, const AnchorVector& anchor,
                                      std::size_t tag_count) noexcept;
// Scale of the kernel over the standard deviation of kernel and pose together.
[[nodiscard]] double noise_share(const RobustKernel& kernel, double pose_variance_m2) noexcept;
// Value of the kernel with its variance increased by `pose_variance_m2`.
[[nodiscard]] KernelValue widened_value(const RobustKernel& kernel, double pose_variance_m2,
                                        double residual_m) noexcept;
// Excess of this range if it is long NLOS, m.
[[nodiscard]] double long_nlos_excess_m(const RangeLos& los_states, const AnchorVector& anchor,
                                        std::size_t tag_count) noexcept;

// One range at one solution: `seen` has the density of the whole mixture and slope and weight of its LOS
// part; nlos_slope and nlos_weight are of its long NLOS part.
struct RowValue {
  KernelValue seen;
  double los_count = 1.0;    // posterior
  double nlos_slope = 0.0;   // 1/m
  double nlos_weight = 0.0;  // 1/m^2
};

using PairRow = Eigen::Matrix<double, model::kPairSize, 1>;
using PairBlock = Eigen::Matrix<double, model::kPairSize, model::kPairSize>;
// Adds weight J J^T to a lower triangle.
void add_square(const PairRow& j, double weight, PairBlock& lower) noexcept;

// One range at a fit's solution.
struct RowAt {
  model::AntennaPrediction predicted;
  double residual_m = 0.0;
  double noise_share = 1.0;
  RowValue value = {};
  PairRow j = PairRow::Zero();  // derivative of eq. (12) by position and terms of its pair
};
[[nodiscard]] RowAt row_at(const AnchorFit& fit, const Observation& row) noexcept;

// An anchor's observations as inner loops read them: tag by tag in blocks of kLanes, column by column. The
// last block of a tag is padded with NaN ranges, which have no weight.
class RowColumns {
 public:
  static constexpr Eigen::Index kAntenna = 0;  // x, y, z, m
  static constexpr Eigen::Index kRange = 3;    // m
  static constexpr Eigen::Index kSpread = 4;   // Observation::pose_spread_m2

  RowColumns(std::span<const Observation> rows, std::size_t tag_count) : tags_(tag_count) {
    for (const Observation& row : rows) ++tags_[row.tag].count;
    std::vector<Eigen::Index> next;
    Eigen::Index size = 0;
    for (std::size_t tag = 0; tag < tag_count; ++tag) {
      tags_[tag].first = size;
      next.push_back(size);
      size += blocks(tag) * kLanes;
    }
    columns_.resize(size, kSpread + 3);
    index_.resize(static_cast<std::size_t>(size));
    for (const Observation& row : rows) {
      const Eigen::Index at = next[row.tag]++;
      for (Eigen::Index axis = 0; axis < 3; ++axis) columns_(at, kAntenna + axis) = row.tag_m(axis);
      columns_(at, kRange) = row.range_m;
      index_[static_cast<std::size_t>(at)] = row.index;
      if (row.pose_spread_m2.isZero(0.0F)) continue;
      if (!has_spread_) columns_.rightCols<3>().setZero();
      has_spread_ = true;
      for (Eigen::Index term = 0; term < 3; ++term)
        columns_(at, kSpread + term) = static_cast<double>(row.pose_spread_m2(term));
    }
    // The lanes beyond the last row.
    for (std::size_t tag = 0; tag < tag_count; ++tag) {
      for (Eigen::Index at = next[tag]; at < tags_[tag].first + blocks(tag) * kLanes; ++at) {
        columns_.row(at).setZero();
        columns_(at, kRange) = std::numeric_limits<double>::quiet_NaN();
      }
    }
  }

  [[nodiscard]] Eigen::Index blocks(std::size_t tag) const noexcept {
    return (tags_[tag].count + kLanes - 1) / kLanes;
  }
  [[nodiscard]] Eigen::Index rows_in(std::size_t tag, Eigen::Index block) const noexcept {
    return std::min(kLanes, tags_[tag].count - block * kLanes);
  }
  [[nodiscard]] auto at(std::size_t tag, Eigen::Index block, Eigen::Index column) const noexcept {
    return columns_.col(column).segment<kLanes>(tags_[tag].first + block * kLanes);
  }
  // Whether any pose has a covariance.
  [[nodiscard]] bool has_spread() const noexcept { return has_spread_; }
  // Observation::index
  [[nodiscard]] std::uint32_t index(std::size_t tag, Eigen::Index block, Eigen::Index lane) const noexcept {
    return index_[static_cast<std::size_t>(tags_[tag].first + block * kLanes + lane)];
  }

 private:
  struct Tag {
    Eigen::Index first = 0;
    Eigen::Index count = 0;
  };

  std::vector<Tag> tags_;
  Eigen::Array<double, Eigen::Dynamic, kSpread + 3> columns_;
  bool has_spread_ = false;
  std::vector<std::uint32_t> index_;
};

// Information of all priors, for all of the anchor's unknowns.
[[nodiscard]] Eigen::MatrixXd information_of_priors(const AnchorProblem& problem);

// Quadratic model of the robust cost at one point: cost, gradient and information with each range's weight;
// priors included, no damping. A surveyed position has zero gradient and no information in common with the
// biases.
struct NormalEquations {
  double cost = 0.0;
  Eigen::VectorXd gradient;
  Eigen::MatrixXd information;
};
[[nodiscard]] NormalEquations linearize(const AnchorFit& fit);
[[nodiscard]] double robust_cost(const AnchorFit& fit);

struct AnchorSolution {
  AnchorVector anchor;
  double cost = 0.0;
  double moved_sigmas = 0.0;  // distance from the start, in the metric of the information
};

// Levenberg-Marquardt from a start, with one kernel per tag. The result is never worse than the start and
// always finite.
[[nodiscard]] AnchorSolution solve_anchor(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                                          const AnchorVector& start, int max_iterations);

[[nodiscard]] Evidence gather_evidence(const AnchorFit& fit);
// Sets the evidence of each fit.
void gather_evidence(std::span<AnchorFit> fits);

// Sets the inflation of each fit from their evidence: the scatter of the score over that of independent
// residuals, 1 for white residuals, else about the number of ranges that together carry one range's
// information. It is the site's mean, or the anchor's own where that is clearly larger.
void estimate_inflation(std::span<AnchorFit> fits);

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
