// Position and pair biases of one anchor from its ranges: robust non-linear least squares.
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

// The belief in one row's sight, from all but its own residual.
struct RowSight {
  float in_sight = 1.0F;
  float wall = 0.0F;
  // Of the rest, density of the row as it is, 1/m: a range through a shadow says nothing of where the anchor
  // is, so it does not change with the residual.
  float other_density = 0.0F;
  std::int32_t episode = kNoEpisode;  // of the anchor's stays behind a wall
};

// The belief in what walls add to an anchor's ranges: a part that all have in common, and one of each
// episode.
struct WallPrior {
  double mean_m = 0.4;
  double sigma_m = 0.2;
  double episode_sigma_m = 0.2;
};

// All rows of an anchor. Its unknowns then are position, beta and gamma of each tag, and, where there are
// rows behind walls, what those add: the common part, then the episodes' own.
struct AnchorSight {
  std::vector<RowSight> rows;  // by Observation::index
  bool behind_wall = false;    // in some of them
  std::size_t episodes = 0;
  WallPrior prior;
  RobustKernel wall;  // of what is left of a residual behind a wall

  // Unknowns beside position, beta and gamma.
  [[nodiscard]] std::size_t extra_unknowns() const noexcept { return behind_wall ? 1 + episodes : 0; }
};

// A copy: rows that change later are not seen.
class RowColumns {
 public:
  RowColumns(std::span<const Observation> rows, std::size_t tag_count) : tags_(tag_count) {
    for (const Observation& row : rows) ++tags_[row.tag].count;
    Eigen::Index size = 0;
    for (Tag& tag : tags_) {
      tag.first = size;
      size += (tag.count + kLanes - 1) / kLanes * kLanes;
    }
    columns_.resize(size, kColumns);
    index_.resize(static_cast<std::size_t>(size));
    std::vector<Eigen::Index> next;
    next.reserve(tag_count);
    for (const Tag& tag : tags_) next.push_back(tag.first);
    for (const Observation& row : rows) {
      const Eigen::Index at = next[row.tag]++;
      columns_(at, 0) = row.tag_m.x();
      columns_(at, 1) = row.tag_m.y();
      columns_(at, 2) = row.tag_m.z();
      columns_(at, kRange) = row.range_m;
      index_[static_cast<std::size_t>(at)] = row.index;
    }
    const auto is_told = [](const Observation& row) { return !row.pose_spread_m2.isZero(0.0F); };
    if (std::any_of(rows.begin(), rows.end(), is_told)) {
      spread_m2_.setZero(size, 3);
      std::vector<Eigen::Index> again;
      again.reserve(tag_count);
      for (const Tag& tag : tags_) again.push_back(tag.first);
      for (const Observation& row : rows) {
        spread_m2_.row(again[row.tag]++) = row.pose_spread_m2.transpose().cast<double>().array();
      }
    }
    // What fills the last lanes up is no range: it has no weight.
    for (std::size_t tag = 0; tag < tag_count; ++tag) {
      const Eigen::Index filled = tags_[tag].first + blocks(tag) * kLanes;
      for (Eigen::Index at = next[tag]; at < filled; ++at) {
        columns_.row(at).setZero();
        columns_(at, kRange) = std::numeric_limits<double>::quiet_NaN();
      }
    }
  }

  // kLanes rows of a tag, the last of them filled up with ranges that are no number.
  [[nodiscard]] Eigen::Index blocks(std::size_t tag) const noexcept {
    return (tags_[tag].count + kLanes - 1) / kLanes;
  }
  [[nodiscard]] Eigen::Index rows_in(std::size_t tag, Eigen::Index block) const noexcept {
    return std::min(kLanes, tags_[tag].count - block * kLanes);
  }
  // axis 0..2 of the antenna's place, m
  [[nodiscard]] auto antenna_m(std::size_t tag, Eigen::Index block, Eigen::Index axis) const noexcept {
    return columns_.col(axis).segment<kLanes>(tags_[tag].first + block * kLanes);
  }
  [[nodiscard]] auto range_m(std::size_t tag, Eigen::Index block) const noexcept {
    return columns_.col(kRange).segment<kLanes>(tags_[tag].first + block * kLanes);
  }
  // Whether some row has a spread; term 0..2 of it, m^2.
  [[nodiscard]] bool tells_spread() const noexcept { return spread_m2_.rows() > 0; }
  [[nodiscard]] auto spread_m2(std::size_t tag, Eigen::Index block, Eigen::Index term) const noexcept {
    return spread_m2_.col(term).segment<kLanes>(tags_[tag].first + block * kLanes);
  }
  // Observation::index
  [[nodiscard]] std::uint32_t index(std::size_t tag, Eigen::Index block, Eigen::Index lane) const noexcept {
    return index_[static_cast<std::size_t>(tags_[tag].first + block * kLanes + lane)];
  }

 private:
  struct Tag {
    Eigen::Index first = 0;
    Eigen::Index count = 0;
  };
  static constexpr Eigen::Index kRange = 3;
  static constexpr Eigen::Index kColumns = 4;

  std::vector<Tag> tags_;
  Eigen::Array<double, Eigen::Dynamic, kColumns> columns_;
  Eigen::Array<double, Eigen::Dynamic, 3> spread_m2_;  // of the antennas; empty where none is told
  std::vector<std::uint32_t> index_;
};

// The unknowns of one anchor: position, then beta of each tag, then gamma of each tag: 3 + 2T; then what
// walls add, as AnchorSight has it.
using AnchorVector = Eigen::VectorXd;

[[nodiscard]] inline Eigen::Index beta_index(std::size_t tag) noexcept {
  return 3 + static_cast<Eigen::Index>(tag);
}
[[nodiscard]] inline Eigen::Index gamma_index(std::size_t tag, std::size_t tag_count) noexcept {
  return 3 + static_cast<Eigen::Index>(tag_count + tag);
}
// Of what all walls add, and of what one episode's wall adds to that.
[[nodiscard]] inline Eigen::Index wall_index(std::size_t tag_count) noexcept {
  return 3 + 2 * static_cast<Eigen::Index>(tag_count);
}
[[nodiscard]] inline Eigen::Index episode_index(std::int32_t episode, std::size_t tag_count) noexcept {
  return wall_index(tag_count) + 1 + episode;
}

// Gaussian belief in the position; a zero eigenvalue leaves a direction open.
struct PositionPrior {
  Eigen::Vector3d mean_m = Eigen::Vector3d::Zero();
  Eigen::Matrix3d information = Eigen::Matrix3d::Zero();  // 1/m^2
  bool surveyed = false;  // known beforehand: held fixed, biases alone are learnt
};

struct AnchorProblem {
  std::span<const Observation> rows;
  std::size_t tag_count = 0;
  model::RangePriors priors;
  PositionPrior position;
  const AnchorSight* sight = nullptr;  // none: every row is taken as the kernels take it
};

// One anchor's solution, with what made it.
struct AnchorFit {
  AnchorProblem problem;  // its rows belong to the association
  AnchorVector anchor;
  std::vector<RobustKernel> kernels;  // one a tag
  double cost = 0.0;
};

// The range an observation should have shown.
[[nodiscard]] inline model::AntennaPrediction predict(const Observation& row, const AnchorVector& anchor,
                                                      std::size_t tag_count) noexcept {
  return model::predict_antenna_range(row.tag_m, anchor.head<3>(), anchor(beta_index(row.tag)),
                                      anchor(gamma_index(row.tag, tag_count)));
}
[[nodiscard]] inline double residual_m(const Observation& row, const AnchorVector& anchor,
                                       std::size_t tag_count) noexcept {
  return row.range_m - predict(row, anchor, tag_count).range_m;
}

// What the pose's own error does to a range: J C J^T with C the spread of the antenna, m^2; zero where
// nothing is told of the pose.
[[nodiscard]] inline double pose_variance_m2(const Observation& row, const AnchorVector& anchor,
                                             std::size_t tag_count) noexcept {
  const Eigen::Vector3d spread_m2 = row.pose_spread_m2.cast<double>();
  if (!(spread_m2(0) + spread_m2(2) > 0.0)) return 0.0;
  const Eigen::Vector3d way = row.tag_m - anchor.head<3>();
  const Eigen::Vector2d j =
      anchor(gamma_index(row.tag, tag_count)) / std::max(way.norm(), model::kMinDistance_m) * way.head<2>();
  const double variance_m2 =
      j.x() * j.x() * spread_m2(0) + 2.0 * j.x() * j.y() * spread_m2(1) + j.y() * j.y() * spread_m2(2);
  return std::max(0.0, variance_m2);
}
// A range's noise is the kernel's and that: the kernel's scale as a share of both.
[[nodiscard]] inline double noise_share(const RobustKernel& kernel, double pose_variance_m2) noexcept {
  if (!(pose_variance_m2 > 0.0)) return 1.0;
  const double scale_m = kernel.shape().scale_m;
  return scale_m / std::sqrt(scale_m * scale_m + pose_variance_m2);
}
[[nodiscard]] inline double noise_share(const RobustKernel& kernel, const Observation& row,
                                        const AnchorVector& anchor, std::size_t tag_count) noexcept {
  return noise_share(kernel, pose_variance_m2(row, anchor, tag_count));
}
// The kernel stretched by so much.
[[nodiscard]] inline KernelValue stretched(const RobustKernel& kernel, double share,
                                           double residual_m) noexcept {
  KernelValue out = kernel.at(share * residual_m);
  out.density *= share;
  out.slope *= share;
  out.weight *= share * share;
  return out;
}

// What a wall adds to this row, by the solution.
[[nodiscard]] inline double wall_excess_m(const RowSight& sight, const AnchorVector& anchor,
                                          std::size_t tag_count) noexcept {
  const double common_m = anchor(wall_index(tag_count));
  return sight.episode == kNoEpisode ? common_m : common_m + anchor(episode_index(sight.episode, tag_count));
}

// One row at one solution: the density of the whole, slope and weight of its part in sight, and those of its
// part behind a wall.
struct RowValue {
  KernelValue seen;
  double seen_share = 1.0;   // posterior
  double wall_slope = 0.0;   // 1/m
  double wall_weight = 0.0;  // 1/m^2
};
[[nodiscard]] inline RowValue value_of(const AnchorSight& sight, const RowSight& row, const KernelValue& seen,
                                       double residual_m, const AnchorVector& anchor, std::size_t tag_count,
                                       double pose_variance_m2) noexcept {
  RowValue out{.seen = seen};
  const double in_sight = static_cast<double>(row.in_sight) * seen.density;
  KernelValue through;
  double walled = 0.0;
  if (row.wall > 0.0F) {
    through = stretched(sight.wall, noise_share(sight.wall, pose_variance_m2),
                        residual_m - wall_excess_m(row, anchor, tag_count));
    walled = static_cast<double>(row.wall) * through.density;
  }
  out.seen.density = in_sight + walled + static_cast<double>(row.other_density);
  out.seen_share = in_sight / out.seen.density;
  out.seen.slope *= out.seen_share;
  out.seen.weight *= out.seen_share;
  out.wall_slope = walled / out.seen.density * through.slope;
  out.wall_weight = walled / out.seen.density * through.weight;
  return out;
}
[[nodiscard]] inline RowValue value_of(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                                       const Observation& row, double residual_m,
                                       const AnchorVector& anchor) noexcept {
  const double variance_m2 = pose_variance_m2(row, anchor, problem.tag_count);
  const RobustKernel& kernel = kernels[row.tag];
  const KernelValue seen = stretched(kernel, noise_share(kernel, variance_m2), residual_m);
  if (problem.sight == nullptr) return {.seen = seen};
  return value_of(*problem.sight, problem.sight->rows[row.index], seen, residual_m, anchor, problem.tag_count,
                  variance_m2);
}

// Derivative of the predicted range by position, beta and gamma of the one pair that it sees.
using PairRow = Eigen::Matrix<double, 5, 1>;
using PairBlock = Eigen::Matrix<double, 5, 5>;
// Adds weight J J^T to a lower triangle.
inline void add_square(const PairRow& j, double weight, PairBlock& lower) noexcept {
  for (Eigen::Index column = 0; column < 5; ++column) {
    const double weighted = weight * j(column);
    for (Eigen::Index row = column; row < 5; ++row) lower(row, column) += weighted * j(row);
  }
}
[[nodiscard]] inline PairRow pair_jacobian(const model::AntennaPrediction& predicted, double gamma) noexcept {
  return {-gamma * predicted.direction.x(), -gamma * predicted.direction.y(),
          -gamma * predicted.direction.z(), 1.0, predicted.distance_m};
}

// Of a range behind a wall: also by the two parts of its excess.
struct WallRow {
  Eigen::Matrix<double, 7, 1> derivative;
  std::array<Eigen::Index, 7> index{};  // of the anchor's unknowns
  Eigen::Index size = 6;                // 7 in an episode
};
[[nodiscard]] inline WallRow wall_row(const PairRow& j, const RowSight& sight, std::size_t tag,
                                      std::size_t tag_count) noexcept {
  WallRow out;
  out.derivative << j, 1.0, 1.0;
  out.index = {0, 1, 2, beta_index(tag), gamma_index(tag, tag_count), wall_index(tag_count), 0};
  if (sight.episode != kNoEpisode) {
    out.index[6] = episode_index(sight.episode, tag_count);
    out.size = 7;
  }
  return out;
}
// Adds weight J J^T to a symmetric matrix.
inline void add_square(const WallRow& row, double weight, Eigen::MatrixXd& out) noexcept {
  for (Eigen::Index i = 0; i < row.size; ++i) {
    for (Eigen::Index k = 0; k < row.size; ++k) {
      out(row.index[static_cast<std::size_t>(i)], row.index[static_cast<std::size_t>(k)]) +=
          weight * row.derivative(i) * row.derivative(k);
    }
  }
}
template <typename Vector>
void add(const WallRow& row, double factor, Vector&& out) noexcept {
  for (Eigen::Index i = 0; i < row.size; ++i)
    out(row.index[static_cast<std::size_t>(i)]) += factor * row.derivative(i);
}

// Information of all priors, for all of the anchor's unknowns.
[[nodiscard]] Eigen::MatrixXd information_of_priors(const AnchorProblem& problem);

// Quadratic model of the robust cost at one point: cost, gradient, and the information with each row's
// weight, priors included, nothing damped. A surveyed position has no gradient and is tied to nothing.
struct NormalEquations {
  double cost = 0.0;
  Eigen::VectorXd gradient;
  Eigen::MatrixXd information;
};

// One kernel a tag.
[[nodiscard]] NormalEquations linearize(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                                        const AnchorVector& anchor);
[[nodiscard]] double robust_cost(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                                 const AnchorVector& anchor);

struct AnchorSolution {
  AnchorVector anchor;
  double cost = 0.0;
  double moved_sigmas = 0.0;  // from the start: the length in the metric of the information
  bool converged = false;
};

// Levenberg-Marquardt from a start. The result is never worse than the start and always finite.
[[nodiscard]] AnchorSolution solve_anchor(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                                          const AnchorVector& start, int max_iterations);

// Biases at the means of their priors.
[[nodiscard]] AnchorVector anchor_at(const Eigen::Vector3d& position_m, std::size_t tag_count,
                                     const model::RangePriors& priors);

}  // namespace groma::calibration
