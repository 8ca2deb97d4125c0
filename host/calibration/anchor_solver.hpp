// Position and pair biases of one anchor from its ranges: robust non-linear least squares on eq. (12).
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
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

[[nodiscard]] inline Eigen::Index excess_index(std::size_t tag_count) noexcept {
  return model::anchor_size(static_cast<Eigen::Index>(tag_count));
}
[[nodiscard]] inline Eigen::Index episode_index(std::int32_t episode, std::size_t tag_count) noexcept {
  return excess_index(tag_count) + 1 + episode;
}
// Position and terms of one pair.
using PairIndex = std::array<Eigen::Index, model::kPairSize>;
[[nodiscard]] inline PairIndex pair_index(std::size_t tag, std::size_t tag_count) noexcept {
  return model::pair_indices(static_cast<Eigen::Index>(tag), static_cast<Eigen::Index>(tag_count));
}
[[nodiscard]] inline model::TermVector terms_of(const AnchorVector& anchor, std::size_t tag,
                                                std::size_t tag_count) noexcept {
  return model::terms_of(anchor, static_cast<Eigen::Index>(tag), static_cast<Eigen::Index>(tag_count));
}

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

// One anchor's solution with its problem and kernels.
struct AnchorFit {
  AnchorProblem problem = {};  // its rows belong to the association
  AnchorVector anchor;
  std::vector<RobustKernel> kernels = {};  // one per tag
  double cost = 0.0;
};

// Eq. (12) at the antenna's position.
[[nodiscard]] inline model::AntennaPrediction predict(const Observation& row, const AnchorVector& anchor,
                                                      std::size_t tag_count) noexcept {
  return model::predict_antenna_range(row.tag_m, anchor.head<3>(), terms_of(anchor, row.tag, tag_count));
}
// Measured minus predicted.
[[nodiscard]] inline double residual_m(const Observation& row, const AnchorVector& anchor,
                                       std::size_t tag_count) noexcept {
  return row.range_m - predict(row, anchor, tag_count).range_m;
}

// Variance of a range due to the pose's own error: J C J^T with C that of the antenna, m^2; zero if the poses
// have no covariance.
[[nodiscard]] inline double pose_variance_m2(const Observation& row, const AnchorVector& anchor,
                                             std::size_t tag_count) noexcept {
  const Eigen::Vector3d spread_m2 = row.pose_spread_m2.cast<double>();
  if (!(spread_m2(0) + spread_m2(2) > 0.0)) return 0.0;
  const Eigen::Vector3d way = row.tag_m - anchor.head<3>();
  const Eigen::Vector2d j = model::scale_of(terms_of(anchor, row.tag, tag_count)) /
                            std::max(way.norm(), model::kMinDistance_m) * way.head<2>();
  const double variance_m2 =
      j.x() * j.x() * spread_m2(0) + 2.0 * j.x() * j.y() * spread_m2(1) + j.y() * j.y() * spread_m2(2);
  return std::max(0.0, variance_m2);
}
// Scale of the kernel over the standard deviation of kernel and pose together.
[[nodiscard]] inline double noise_share(const RobustKernel& kernel, double pose_variance_m2) noexcept {
  if (!(pose_variance_m2 > 0.0)) return 1.0;
  const double scale_m = kernel.shape().scale_m;
  return scale_m / std::sqrt(scale_m * scale_m + pose_variance_m2);
}
// Value of the kernel with its scale divided by `share`.
[[nodiscard]] inline KernelValue stretched(const RobustKernel& kernel, double share,
                                           double residual_m) noexcept {
  KernelValue out = kernel.at(share * residual_m);
  out.density *= share;
  out.slope *= share;
  out.weight *= share * share;
  return out;
}

// Excess of this range if it is long NLOS, m.
[[nodiscard]] inline double long_nlos_excess_m(const RangeLos& los_states, const AnchorVector& anchor,
                                               std::size_t tag_count) noexcept {
  const double common_m = anchor(excess_index(tag_count));
  return los_states.episode == kNoEpisode ? common_m
                                          : common_m + anchor(episode_index(los_states.episode, tag_count));
}

// One range at one solution: `seen` has the density of the whole mixture and slope and weight of its LOS
// part; nlos_slope and nlos_weight are of its long NLOS part.
struct RowValue {
  KernelValue seen;
  double los_count = 1.0;    // posterior
  double nlos_slope = 0.0;   // 1/m
  double nlos_weight = 0.0;  // 1/m^2
};
// `seen`: the value of the pair's kernel; `row`: Observation::index.
[[nodiscard]] inline RowValue value_of(const AnchorProblem& problem, std::uint32_t row,
                                       const KernelValue& seen, double residual_m, const AnchorVector& anchor,
                                       double pose_variance_m2) noexcept {
  RowValue out{.seen = seen};
  if (problem.los_states == nullptr) return out;
  const RangeLos& los_states = problem.los_states->rows[row];
  const double los = static_cast<double>(los_states.los) * seen.density;
  KernelValue through;
  double nlos = 0.0;
  if (los_states.long_nlos > 0.0F) {
    through =
        stretched(problem.los_states->long_nlos, noise_share(problem.los_states->long_nlos, pose_variance_m2),
                  residual_m - long_nlos_excess_m(los_states, anchor, problem.tag_count));
    nlos = static_cast<double>(los_states.long_nlos) * through.density;
  }
  out.seen.density = los + nlos + static_cast<double>(los_states.other_density);
  out.los_count = los / out.seen.density;
  out.seen.slope *= out.los_count;
  out.seen.weight *= out.los_count;
  out.nlos_slope = nlos / out.seen.density * through.slope;
  out.nlos_weight = nlos / out.seen.density * through.weight;
  return out;
}

using PairRow = Eigen::Matrix<double, model::kPairSize, 1>;
using PairBlock = Eigen::Matrix<double, model::kPairSize, model::kPairSize>;
// Adds weight J J^T to a lower triangle.
inline void add_square(const PairRow& j, double weight, PairBlock& lower) noexcept {
  for (Eigen::Index column = 0; column < j.size(); ++column) {
    const double weighted = weight * j(column);
    for (Eigen::Index row = column; row < j.size(); ++row) lower(row, column) += weighted * j(row);
  }
}

// One range at a fit's solution.
struct RowAt {
  model::AntennaPrediction predicted;
  double residual_m = 0.0;
  double noise_share = 1.0;
  RowValue value = {};
  PairRow j = PairRow::Zero();  // derivative of eq. (12) by position and terms of its pair
};
[[nodiscard]] inline RowAt row_at(const AnchorFit& fit, const Observation& row) noexcept {
  const std::size_t tags = fit.problem.tag_count;
  RowAt out{.predicted = predict(row, fit.anchor, tags)};
  out.residual_m = row.range_m - out.predicted.range_m;
  const RobustKernel& kernel = fit.kernels[row.tag];
  const double variance_m2 = pose_variance_m2(row, fit.anchor, tags);
  out.noise_share = noise_share(kernel, variance_m2);
  out.value = value_of(fit.problem, row.index, stretched(kernel, out.noise_share, out.residual_m),
                       out.residual_m, fit.anchor, variance_m2);
  out.j.head<3>() = -out.predicted.scale * out.predicted.direction;
  out.j.tail<model::kPairSize - 3>() = out.predicted.d_terms;
  return out;
}

// Derivative of a long NLOS range: also by the two parts of its excess.
struct LongNlosRow {
  Eigen::Matrix<double, model::kPairSize + 2, 1> derivative;
  std::array<Eigen::Index, model::kPairSize + 2> index{};  // of the anchor's unknowns
  std::size_t size = model::kPairSize + 1;                 // one more in an episode

  LongNlosRow(const PairRow& j, const RangeLos& los_states, std::size_t tag, std::size_t tag_count) noexcept {
    derivative << j, 1.0, 1.0;
    const PairIndex pair = pair_index(tag, tag_count);
    *std::copy(pair.begin(), pair.end(), index.begin()) = excess_index(tag_count);
    if (los_states.episode != kNoEpisode) index[size++] = episode_index(los_states.episode, tag_count);
  }
  // Adds weight J J^T.
  void add_square(double weight, Eigen::MatrixXd& out) const noexcept {
    for (std::size_t i = 0; i < size; ++i) {
      for (std::size_t k = 0; k < size; ++k) out(index[i], index[k]) += weight * by(i) * by(k);
    }
  }
  // Adds factor J.
  template <typename Vector>
  void add(double factor, Vector&& out) const noexcept {
    for (std::size_t i = 0; i < size; ++i) out(index[i]) += factor * by(i);
  }

 private:
  [[nodiscard]] double by(std::size_t i) const noexcept { return derivative(static_cast<Eigen::Index>(i)); }
};

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

}  // namespace groma::calibration
