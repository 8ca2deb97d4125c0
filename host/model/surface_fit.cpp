#include "host/model/surface_fit.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numbers>
#include <utility>
#include <vector>

#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>

namespace groma::model {

namespace {

// All constants of this file are by hand; the SurfaceFit tests hold with them.
constexpr std::size_t kFolds = 5;
// Blocks of points that are held out together, along the longer side.
constexpr double kBlocks = 19.0;
// Upper bounds on the points of the cross-validation, and on those of the residuals' covariance: bounds on
// time, linear in the former and square in the latter.
constexpr std::size_t kValidated = 100'000;
constexpr std::size_t kPaired = 4'000;
constexpr double kCoarsestCells = 4.0;
constexpr double kFinestCells = 64.0;
constexpr double kSpacingStep = 1.5;
constexpr std::array kSmoothings{1e-4, 1e-2, 1.0, 100.0};
// Weight of first differences relative to bending: it keeps the ground level beside a single line of points.
constexpr double kLevel = 1e-6;
// Lags of the residuals' covariance, in fractions of the spacing.
constexpr std::size_t kLags = 16;
constexpr double kLagsPerSpacing = 4.0;

using Control = std::array<std::pair<Eigen::Index, double>, 16>;

// The control heights that a place depends on, with their weights (products of basis functions).
class GridWeights {
 public:
  explicit GridWeights(const BSpline::Grid& grid) : grid_(grid) {}

  [[nodiscard]] Control at(double x_m, double y_m) const noexcept {
    const auto [i, bx] = axis((x_m - grid_.x0_m) / grid_.dx_m, grid_.nx);
    const auto [j, by] = axis((y_m - grid_.y0_m) / grid_.dy_m, grid_.ny);
    Control out;
    for (std::size_t a = 0; a < 4; ++a) {
      for (std::size_t b = 0; b < 4; ++b) {
        out[4 * a + b] = {(i + static_cast<Eigen::Index>(a)) * grid_.ny + j + static_cast<Eigen::Index>(b),
                          bx[a] * by[b]};
      }
    }
    return out;
  }

 private:
  static std::pair<Eigen::Index, std::array<double, 4>> axis(double u, int count) noexcept {
    const double inside = std::clamp(u, 0.0, static_cast<double>(count - 3));
    const int cell = std::min(static_cast<int>(inside), count - 4);
    const double t = inside - cell;
    const double s = 1.0 - t;
    return {cell,
            {s * s * s / 6.0, (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
             (3.0 * s * s * s - 6.0 * s * s + 4.0) / 6.0, t * t * t / 6.0}};
  }

  BSpline::Grid grid_;
};

// Sums of w wᵀ and w z over points, w the weights of the control heights. w wᵀ is banded: each control height
// is paired only with those up to three rows and columns further.
class Sums {
 public:
  explicit Sums(const BSpline::Grid& grid)
      : grid_(grid), squares_(size() * kOffsets, 0.0), heights_(size(), 0.0) {}

  void add(const Control& control, double z_m) {
    for (const auto& [k, wk] : control) {
      heights_[static_cast<std::size_t>(k)] += wk * z_m;
      for (const auto& [l, wl] : control) {
        if (l < k) continue;
        squares_[static_cast<std::size_t>(k) * kOffsets + offset(l - k)] += wk * wl;
      }
    }
  }
  void add(const Sums& other, double sign) {
    for (std::size_t i = 0; i < squares_.size(); ++i) squares_[i] += sign * other.squares_[i];
    for (std::size_t i = 0; i < heights_.size(); ++i) heights_[i] += sign * other.heights_[i];
  }

  // Control heights for this weight of the bending; empty if there is no solution.
  [[nodiscard]] std::vector<double> solve(double bending) const {
    const auto n = static_cast<Eigen::Index>(size());
    std::vector<Eigen::Triplet<double>> terms;
    terms.reserve(size() * 32);
    for (Eigen::Index k = 0; k < n; ++k) {
      for (std::size_t o = 0; o < kOffsets; ++o) {
        const double value = squares_[static_cast<std::size_t>(k) * kOffsets + o];
        if (value != 0.0) terms.emplace_back(k + column(o), k, value);
      }
    }
    // Differences of neighbours; the mixed one counts twice in the bending.
    const auto penalize = [&](double weight, std::initializer_list<std::pair<Eigen::Index, double>> stencil) {
      for (const auto& [k, wk] : stencil) {
        for (const auto& [l, wl] : stencil) {
          if (l >= k) terms.emplace_back(l, k, weight * wk * wl);
        }
      }
    };
    const Eigen::Index ny = grid_.ny;
    for (Eigen::Index i = 0; i < grid_.nx; ++i) {
      for (Eigen::Index j = 0; j < ny; ++j) {
        const Eigen::Index k = i * ny + j;
        const bool next_x = i + 1 < grid_.nx;
        const bool next_y = j + 1 < ny;
        if (i > 0 && next_x) penalize(bending, {{k - ny, 1.0}, {k, -2.0}, {k + ny, 1.0}});
        if (j > 0 && next_y) penalize(bending, {{k - 1, 1.0}, {k, -2.0}, {k + 1, 1.0}});
        if (next_x && next_y)
          penalize(2.0 * bending, {{k, 1.0}, {k + 1, -1.0}, {k + ny, -1.0}, {k + ny + 1, 1.0}});
        if (next_x) penalize(kLevel * bending, {{k, 1.0}, {k + ny, -1.0}});
        if (next_y) penalize(kLevel * bending, {{k, 1.0}, {k + 1, -1.0}});
      }
    }
    Eigen::SparseMatrix<double> matrix(n, n);
    matrix.setFromTriplets(terms.begin(), terms.end());
    const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>, Eigen::Lower> solver(matrix);
    if (solver.info() != Eigen::Success) return {};
    const Eigen::VectorXd solution = solver.solve(Eigen::Map<const Eigen::VectorXd>(heights_.data(), n));
    if (!solution.allFinite()) return {};
    return {solution.begin(), solution.end()};
  }

 private:
  // Offsets of l from k >= 0: (0, 0..3), (1..3, -3..3).
  static constexpr std::size_t kOffsets = 4 + 3 * 7;
  [[nodiscard]] std::size_t size() const {
    return static_cast<std::size_t>(grid_.nx) * static_cast<std::size_t>(grid_.ny);
  }
  [[nodiscard]] Eigen::Index column(std::size_t offset) const {
    if (offset < 4) return static_cast<Eigen::Index>(offset);
    const auto o = static_cast<Eigen::Index>(offset) - 4;
    return (1 + o / 7) * grid_.ny + o % 7 - 3;
  }
  [[nodiscard]] std::size_t offset(Eigen::Index ahead) const {
    // On a narrow grid two offsets may have the same index difference; only the difference matters.
    const Eigen::Index row = std::min<Eigen::Index>((ahead + 3) / grid_.ny, 3);
    if (row == 0) return static_cast<std::size_t>(ahead);
    return static_cast<std::size_t>(4 + (row - 1) * 7 + ahead - row * grid_.ny + 3);
  }

  BSpline::Grid grid_;
  std::vector<double> squares_;
  std::vector<double> heights_;
};

struct Extent {
  Eigen::Vector2d low;
  Eigen::Vector2d size;
};

Extent extent_of(std::span<const Eigen::Vector3d> points) {
  Eigen::Vector2d low = points.front().head<2>();
  Eigen::Vector2d high = low;
  for (const Eigen::Vector3d& point : points) {
    low = low.cwiseMin(point.head<2>());
    high = high.cwiseMax(point.head<2>());
  }
  return {low, high - low};
}

std::optional<BSpline::Grid> grid_over(const Extent& extent, double spacing_m) {
  const Eigen::Array2d cells = (extent.size.array() / spacing_m).ceil().max(1.0);
  if (!((cells.x() + 3.0) * (cells.y() + 3.0) <= kMaxControlHeights)) return std::nullopt;
  // The extent is centred in the cells.
  const Eigen::Array2d low = extent.low.array() - 0.5 * (cells * spacing_m - extent.size.array());
  return BSpline::Grid{low.x(),
                       low.y(),
                       spacing_m,
                       spacing_m,
                       static_cast<int>(cells.x()) + 3,
                       static_cast<int>(cells.y()) + 3};
}

// The fold in which a point is held out: neighbouring blocks are in different folds.
std::size_t fold_of(const Eigen::Vector3d& point, const Extent& extent, double block_m) {
  const Eigen::Vector2d block = ((point.head<2>() - extent.low) / block_m).array().floor();
  return static_cast<std::size_t>(block.x() + 2.0 * block.y()) % kFolds;
}

struct Validation {
  double smoothing = 0.0;
  double square_m2 = std::numeric_limits<double>::infinity();  // mean
  std::vector<double> residuals_m;                             // of each point
};

// The best of the smoothings for this grid, by cross-validation.
Validation validate(std::span<const Eigen::Vector3d> points, const Extent& extent, const BSpline::Grid& grid,
                    std::span<const double> smoothings, double block_m) {
  const GridWeights grid_weights(grid);
  Sums all(grid);
  std::vector<Sums> of_fold(kFolds, Sums(grid));
  std::vector<std::size_t> fold;
  fold.reserve(points.size());
  for (const Eigen::Vector3d& point : points) {
    fold.push_back(fold_of(point, extent, block_m));
    of_fold[fold.back()].add(grid_weights.at(point.x(), point.y()), point.z());
  }
  for (const Sums& sums : of_fold) all.add(sums, 1.0);
  const double per_cell =
      static_cast<double>(points.size()) / (static_cast<double>(grid.nx - 3) * (grid.ny - 3));
  Validation best;
  for (const double smoothing : smoothings) {
    Validation now{
        .smoothing = smoothing, .square_m2 = 0.0, .residuals_m = std::vector<double>(points.size())};
    bool solved = true;
    for (std::size_t f = 0; f < kFolds && solved; ++f) {
      Sums others = all;
      others.add(of_fold[f], -1.0);
      std::vector<double> heights_m = others.solve(smoothing * per_cell);
      solved = !heights_m.empty();
      if (!solved) break;
      const BSpline spline(grid, std::move(heights_m));
      for (std::size_t i = 0; i < points.size(); ++i) {
        if (fold[i] != f) continue;
        now.residuals_m[i] = points[i].z() - spline.at(points[i].x(), points[i].y()).z_m;
        now.square_m2 += now.residuals_m[i] * now.residuals_m[i] / static_cast<double>(points.size());
      }
    }
    if (solved && now.square_m2 < best.square_m2) best = std::move(now);
  }
  return best;
}

template <typename Value>
std::vector<Value> thinned(std::span<const Value> values, std::size_t most) {
  const std::size_t every = (values.size() + most - 1) / most;
  std::vector<Value> out;
  out.reserve(values.size() / every + 1);
  for (std::size_t i = 0; i < values.size(); i += every) out.push_back(values[i]);
  return out;
}

SurfaceMismatch mismatch_of(std::span<const Eigen::Vector3d> points, std::span<const double> residuals_m,
                            double spacing_m) {
  const std::vector<Eigen::Vector3d> at = thinned(points, kPaired);
  const std::vector<double> error_m = thinned(residuals_m, kPaired);
  const double width_m = spacing_m / kLagsPerSpacing;
  std::array<double, kLags> sums{};
  std::array<std::size_t, kLags> counts{};
  for (std::size_t i = 0; i < at.size(); ++i) {
    for (std::size_t j = i + 1; j < at.size(); ++j) {
      const double apart = (at[i] - at[j]).head<2>().norm() / width_m;
      if (!(apart < static_cast<double>(kLags))) continue;
      const auto lag = static_cast<std::size_t>(apart);
      sums[lag] += error_m[i] * error_m[j];
      ++counts[lag];
    }
  }
  // Fewer pairs do not determine a covariance: its sigma is 1/sqrt(30) = 0.18 of the variance.
  constexpr std::size_t kFewPairs = 30;
  SurfaceMismatch out;
  double first_m2 = 0.0;
  for (std::size_t lag = 0; lag < kLags; ++lag) {
    if (counts[lag] < kFewPairs) continue;
    const double covariance_m2 = sums[lag] / static_cast<double>(counts[lag]);
    if (first_m2 == 0.0) {
      // Neighbouring residuals are uncorrelated: no mismatch is visible.
      if (!(covariance_m2 > 0.0)) return {.length_m = spacing_m};
      first_m2 = covariance_m2;
      out.sigma_m = std::sqrt(first_m2);
    }
    out.length_m = (static_cast<double>(lag) + 0.5) * width_m;
    if (covariance_m2 < first_m2 / std::numbers::e) break;
  }
  if (first_m2 == 0.0) {
    double square_m2 = 0.0;
    for (const double residual_m : residuals_m) square_m2 += residual_m * residual_m;
    out.sigma_m = std::sqrt(square_m2 / static_cast<double>(residuals_m.size()));
    out.length_m = spacing_m;
  }
  out.slope_sigma = slope_sigma(out.sigma_m, out.length_m);
  return out;
}

void find_gaps(std::span<const Eigen::Vector3d> points, SurfaceFit& fit) {
  const BSpline::Grid& grid = fit.spline.grid();
  const int nx = grid.nx - 3;
  const int ny = grid.ny - 3;
  std::vector<double> apart(static_cast<std::size_t>(nx) * static_cast<std::size_t>(ny),
                            std::numeric_limits<double>::infinity());
  const auto cell = [&](int i, int j) -> double& {
    return apart[static_cast<std::size_t>(i) * static_cast<std::size_t>(ny) + static_cast<std::size_t>(j)];
  };
  for (const Eigen::Vector3d& point : points) {
    const int i = std::clamp(static_cast<int>((point.x() - grid.x0_m) / grid.dx_m), 0, nx - 1);
    const int j = std::clamp(static_cast<int>((point.y() - grid.y0_m) / grid.dy_m), 0, ny - 1);
    cell(i, j) = 0.0;
  }
  fit.empty_share =
      static_cast<double>(std::count_if(apart.begin(), apart.end(), [](double d) { return d > 0.0; })) /
      static_cast<double>(apart.size());
  // Distances to the nearest cell with a point, in cells, by one sweep in each direction.
  const auto sweep = [&](int sign) {
    for (int a = 0; a < nx; ++a) {
      for (int b = 0; b < ny; ++b) {
        const int i = sign > 0 ? a : nx - 1 - a;
        const int j = sign > 0 ? b : ny - 1 - b;
        const auto from = [&](int di, int dj) {
          const int k = i - sign * di;
          const int l = j - sign * dj;
          if (k < 0 || l < 0 || k >= nx || l >= ny) return;
          cell(i, j) = std::min(cell(i, j), cell(k, l) + std::hypot(di, dj));
        };
        from(1, 0);
        from(0, 1);
        from(1, 1);
        from(1, -1);
      }
    }
  };
  sweep(1);
  sweep(-1);
  const auto most = std::max_element(apart.begin(), apart.end());
  const auto at = static_cast<int>(most - apart.begin());
  fit.gap_m = *most * fit.spacing_m;
  const int i = at / ny;
  const int j = at % ny;
  fit.gap_at_m = {grid.x0_m + (i + 0.5) * grid.dx_m, grid.y0_m + (j + 0.5) * grid.dy_m};
}

}  // namespace

double slope_sigma(double sigma_m, double length_m) noexcept {
  return std::numbers::sqrt2 * sigma_m / length_m;
}

std::optional<SurfaceFit> fit_surface(std::span<const Eigen::Vector3d> points,
                                      const SurfaceFitOptions& options) {
  const Extent extent = extent_of(points);
  if (!extent.size.allFinite()) return std::nullopt;
  const double longer_m = std::max(extent.size.maxCoeff(), 1e-3);
  const double block_m = longer_m / kBlocks;
  const std::vector<Eigen::Vector3d> validated = thinned(points, kValidated);
  std::vector<double> smoothings(kSmoothings.begin(), kSmoothings.end());
  if (options.smoothing) smoothings = {*options.smoothing};
  std::vector<double> spacings_m;
  if (options.spacing_m) {
    spacings_m = {*options.spacing_m};
  } else {
    // A spacing below that of the points is not determined by them.
    const double least_m =
        std::max(longer_m / kFinestCells, 2.0 * longer_m / std::sqrt(static_cast<double>(points.size())));
    for (double at_m = longer_m / kCoarsestCells; at_m >= least_m || spacings_m.empty(); at_m /= kSpacingStep)
      spacings_m.push_back(at_m);
  }
  Validation best;
  double spacing_m = spacings_m.front();
  for (const double at_m : spacings_m) {
    const auto grid = grid_over(extent, at_m);
    if (!grid) return std::nullopt;
    Validation now = validate(validated, extent, *grid, smoothings, block_m);
    if (!(now.square_m2 < best.square_m2)) continue;
    best = std::move(now);
    spacing_m = at_m;
  }
  if (best.residuals_m.empty()) return std::nullopt;

  const BSpline::Grid grid = *grid_over(extent, spacing_m);
  const GridWeights grid_weights(grid);
  Sums sums(grid);
  for (const Eigen::Vector3d& point : points) sums.add(grid_weights.at(point.x(), point.y()), point.z());
  const double per_cell =
      static_cast<double>(points.size()) / (static_cast<double>(grid.nx - 3) * (grid.ny - 3));
  std::vector<double> heights_m = sums.solve(best.smoothing * per_cell);
  if (heights_m.empty()) return std::nullopt;
  SurfaceFit fit{.spline = BSpline(grid, std::move(heights_m)),
                 .mismatch = mismatch_of(validated, best.residuals_m, spacing_m),
                 .spacing_m = spacing_m,
                 .smoothing = best.smoothing,
                 .points = points.size(),
                 .held_out_rms_m = std::sqrt(best.square_m2)};
  double square_m2 = 0.0;
  for (const Eigen::Vector3d& point : points) {
    const double residual_m = point.z() - fit.spline.at(point.x(), point.y()).z_m;
    square_m2 += residual_m * residual_m;
    fit.max_m = std::max(fit.max_m, std::abs(residual_m));
  }
  fit.rms_m = std::sqrt(square_m2 / static_cast<double>(points.size()));
  find_gaps(points, fit);
  return fit;
}

}  // namespace groma::model
