#include "host/calibration/initial_guess.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include <Eigen/Eigenvalues>

#include "host/calibration/row_columns.hpp"

namespace groma::calibration {
namespace {

constexpr std::size_t kReferences = 3;
constexpr int kAzimuths = 16;
constexpr std::array<double, 5> kElevations_rad{0.0, 0.45, -0.45, 1.05, -1.05};
constexpr std::size_t kScoredRows = 24;
constexpr std::size_t kRefined = 2;
constexpr int kSearchRounds = 4;
constexpr int kSearchIterations = 4;

struct Start {
  Eigen::Vector3d position_m;
  double score = 0.0;
};

// Every n-th row, so that about `count` remain.
std::vector<const Observation*> sample(std::span<const Observation> rows, std::size_t count) {
  std::vector<const Observation*> out;
  const std::size_t stride = std::max<std::size_t>(1, rows.size() / count);
  for (std::size_t i = stride / 2; i < rows.size(); i += stride) out.push_back(&rows[i]);
  return out;
}

// Of all tags as were they one.
RowColumns columns_of(const std::vector<const Observation*>& rows) {
  std::vector<Observation> of_one_tag;
  of_one_tag.reserve(rows.size());
  for (const Observation* row : rows) of_one_tag.emplace_back(*row).tag = 0;
  return RowColumns(of_one_tag, 1);
}

// Points on the spheres of ranges taken far apart on the drive: one of them is near the anchor.
std::vector<Start> sphere_points(const AnchorProblem& problem) {
  std::vector<Start> out;
  for (const Observation* row : sample(problem.rows, kReferences)) {
    const double distance_m =
        std::max(0.1, (row->range_m - problem.priors.beta_m.mean) / problem.priors.gamma.mean);
    for (const double elevation_rad : kElevations_rad) {
      for (int k = 0; k < kAzimuths; ++k) {
        const double azimuth_rad = 2.0 * std::numbers::pi * k / kAzimuths;
        const Eigen::Vector3d direction(std::cos(elevation_rad) * std::cos(azimuth_rad),
                                        std::cos(elevation_rad) * std::sin(azimuth_rad),
                                        std::sin(elevation_rad));
        out.push_back({.position_m = row->tag_m + distance_m * direction, .score = 0.0});
      }
    }
  }
  return out;
}

// So wide that neither the biases nor a coarse grid of starts hide the valley.
double valley_width_m(const AnchorProblem& problem) {
  const std::vector<const Observation*> rows = sample(problem.rows, kScoredRows);
  double mean_range_m = 0.0;
  for (const Observation* row : rows) mean_range_m += row->range_m / static_cast<double>(rows.size());
  const model::RangePriors& priors = problem.priors;
  return 0.3 + priors.beta_m.sigma + (priors.gamma.sigma + 0.03) * mean_range_m;
}

}  // namespace

std::vector<Observation> spread_along_the_way(std::span<const Observation> rows, std::size_t tag_count,
                                              std::size_t max_rows_per_tag) {
  struct Way {
    std::size_t rows = 0;
    double length_m = 0.0;
    const Observation* last = nullptr;
    double walked_m = 0.0;  // and how much of it is spent by the rows taken
    double spent_m = 0.0;
  };
  std::vector<Way> ways(tag_count);
  for (const Observation& row : rows) {
    Way& way = ways[row.tag];
    ++way.rows;
    // A millimetre for each row, so that a robot that stands still has a way too.
    way.length_m += 1e-3 + (way.last != nullptr ? (row.tag_m - way.last->tag_m).norm() : 0.0);
    way.last = &row;
  }
  for (Way& way : ways) way.last = nullptr;
  std::vector<Observation> out;
  out.reserve(std::min(rows.size(), tag_count * max_rows_per_tag));
  for (const Observation& row : rows) {
    Way& way = ways[row.tag];
    way.walked_m += 1e-3 + (way.last != nullptr ? (row.tag_m - way.last->tag_m).norm() : 0.0);
    way.last = &row;
    const double step_m = way.length_m / static_cast<double>(max_rows_per_tag);
    if (way.rows > max_rows_per_tag && way.walked_m < way.spent_m + step_m) continue;
    way.spent_m = std::max(way.spent_m + step_m, way.walked_m - step_m);
    out.push_back(row);
  }
  return out;
}

Eigen::Vector3d TagSpread::mirror(const Eigen::Vector3d& point_m, int axis) const noexcept {
  const Eigen::Vector3d normal = axes.col(axis);
  return point_m - 2.0 * normal.dot(point_m - center_m) * normal;
}

TagSpread tag_spread(std::span<const Observation> rows) {
  TagSpread out;
  if (rows.empty()) return out;
  const double n = static_cast<double>(rows.size());
  for (const Observation& row : rows) out.center_m += row.tag_m / n;
  Eigen::Matrix3d scatter = Eigen::Matrix3d::Zero();
  for (const Observation& row : rows) {
    const Eigen::Vector3d offset_m = row.tag_m - out.center_m;
    scatter += offset_m * offset_m.transpose() / n;
  }
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(scatter);
  out.axes = eigen.eigenvectors().rowwise().reverse();
  out.deviation_m = eigen.eigenvalues().reverse().cwiseMax(0.0).cwiseSqrt();
  return out;
}

Candidate descend(const AnchorProblem& problem, const AnchorVector& start) {
  Candidate out;
  out.solution.anchor = start;
  // The scale falls from the valley's width to what the residuals show: the basin is wide at first.
  out.kernel = KernelShape{.scale_m = valley_width_m(problem)}.with_blocked(0.1);
  std::vector<WeighedResidual> residuals(problem.rows.size());
  for (int round = 0; round < kSearchRounds; ++round) {
    const std::vector<RobustKernel> kernels(problem.tag_count, RobustKernel(out.kernel));
    out.solution = solve_anchor(problem, kernels, out.solution.anchor, kSearchIterations);
    if (round + 1 == kSearchRounds) break;
    for (std::size_t i = 0; i < residuals.size(); ++i) {
      residuals[i].residual_m = residual_m(problem.rows[i], out.solution.anchor, problem.tag_count);
    }
    KernelPrior prior{.shape = out.kernel, .scale_weight = 3.0, .share_weight = 3.0};
    prior.shape.scale_m = std::max(problem.priors.sigma_m, out.kernel.scale_m / 2.0);
    out.kernel = fit_kernel(residuals, prior, 3);
  }
  return out;
}

Candidate search(const AnchorProblem& problem) {
  const model::RangePriors& priors = problem.priors;
  const std::vector<const Observation*> scored = sample(problem.rows, kScoredRows);
  const double width_m = valley_width_m(problem);

  std::vector<Start> starts = sphere_points(problem);
  // No more tags than one: before the biases are known they are all the same.
  const RowColumns columns = columns_of(scored);
  for (Start& start : starts) {
    for (Eigen::Index block = 0; block < columns.blocks(0); ++block) {
      Lanes square_m2 = Lanes::Zero();
      for (Eigen::Index axis = 0; axis < 3; ++axis) {
        square_m2 += (columns.antenna_m(0, block, axis) - start.position_m(axis)).square();
      }
      const Lanes expected_m = priors.gamma.mean * square_m2.sqrt() + priors.beta_m.mean;
      const Lanes square = ((columns.range_m(0, block) - expected_m) / width_m).square();
      start.score += (square / (1.0 + square)).head(columns.rows_in(0, block)).sum();
    }
  }
  std::stable_sort(starts.begin(), starts.end(),
                   [](const Start& a, const Start& b) { return a.score < b.score; });

  Candidate best;
  bool found = false;
  std::vector<Eigen::Vector3d> tried;
  for (const Start& start : starts) {
    if (tried.size() == kRefined) break;
    const auto is_near = [&](const Eigen::Vector3d& p) {
      return (p - start.position_m).norm() < 2.0 * width_m;
    };
    if (std::any_of(tried.begin(), tried.end(), is_near)) continue;
    tried.push_back(start.position_m);

    Candidate candidate = descend(problem, anchor_at(start.position_m, problem.tag_count, priors));
    if (!found || candidate.solution.cost < best.solution.cost) best = candidate;
    found = true;
  }
  if (!found) best.solution.anchor = anchor_at(problem.position.mean_m, problem.tag_count, priors);
  return best;
}

}  // namespace groma::calibration
