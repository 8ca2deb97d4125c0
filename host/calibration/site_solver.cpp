#include "host/calibration/site_solver.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <utility>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "host/calibration/measurement_choice.hpp"
#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// Effort of the search, by hand against time: directions 22.5 and some 30 degrees apart; fewer scored ranges,
// refined starts and iterations than the first 48, 4 and 6. Search.FindsTheAnchorWithoutAStart and the
// campaigns hold with these.
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

std::vector<const Observation*> sample(std::span<const Observation> rows, std::size_t count) {
  std::vector<const Observation*> out;
  const std::size_t stride = std::max<std::size_t>(1, rows.size() / count);
  for (std::size_t i = stride / 2; i < rows.size(); i += stride) out.push_back(&rows[i]);
  return out;
}

// Points on the spheres of a few ranges taken far apart on the drive: one of them is near the anchor.
std::vector<Start> sphere_points(const AnchorProblem& problem) {
  std::vector<Start> out;
  const model::TermVector means = model::means_of(problem.priors);
  for (const Observation* row : sample(problem.rows, kReferences)) {
    const double distance_m = std::max(0.1, (row->range_m - model::offset_m(means)) / model::scale_of(means));
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

// Wide enough that neither the biases nor the coarse grid of starts hide the basin.
double valley_width_m(const AnchorProblem& problem) {
  const std::vector<const Observation*> rows = sample(problem.rows, kScoredRows);
  double mean_range_m = 0.0;
  for (const Observation* row : rows) mean_range_m += row->range_m / static_cast<double>(rows.size());
  const model::TermVector sigmas = model::sigmas_of(problem.priors);
  return 0.3 + model::offset_m(sigmas) + (model::scale_of(sigmas) + 0.03) * mean_range_m;
}

// Effort of the mirror tests, by hand against time.
constexpr std::size_t kRowsPerTag = 40;
constexpr int kIterations = 6;
// If the excess with few ranges is below this, the test is repeated with all ranges. By hand: 10 nats, odds
// of 22000 to 1, more than kPlausibleExcess of verdict.cpp.
constexpr double kCloseExcess = 10.0;
// If the fit moved by more than this, the test is repeated with all ranges. By hand.
constexpr double kRefitMove_m = 0.3;
// Two sides whose ranges differ by less than this (rms) cannot be told apart, however many ranges there are:
// the range model is not so exact. Less than a unit of DW1000 timestamps, 4.7 mm. Wrong sides of a low tag on
// a floor with bumps of 6 mm differ by 0.3 to 2 mm (simulated), those of tags at different heights by 16 mm
// or more.
constexpr double kIndistinct_m = 0.003;
// Largest cost of being away from the earlier place, as anchors do get moved: by hand, 10 nats.
// Update.ByAWeakDriveIsBetterThanEitherAloneOverManyDrives holds with it.
constexpr double kMovedCost = 10.0;
// Starts this close to each other are in one basin. By hand.
constexpr double kSameMirror_m = 0.1;
// Heights over the tags' plane to try, as shares of the distance to the nearest antenna. By hand:
// at that distance, 20 and 64 degrees from the plane; the campaigns hold with them.
constexpr double kProbes[] = {0.9, 0.35, -0.35, -0.9};
// Holds the anchor at a distance from the tags while the other unknowns are solved: by hand, well below the
// sigmas of heights.
constexpr double kHoldSigma_m = 0.01;

double height_above(const TagSpread& spread, int axis, const AnchorVector& anchor) {
  return spread.axes.col(axis).dot(anchor.head<3>() - spread.center_m);
}

struct BothSides {
  AnchorSolution here;   // the best solution
  AnchorSolution there;  // the best solution on its other side
};

// Starts on the other side, and in another basin on either side: the mirror point and, across the plane, also
// points well above and below it. Between two basins the cost is flat and a solver stops.
std::vector<AnchorVector> starts_around(const AnchorProblem& problem, const AnchorVector& anchor,
                                        const TagSpread& spread, int axis) {
  const Eigen::Vector3d normal = spread.axes.col(axis);
  const double height_m = height_above(spread, axis, anchor);
  std::vector<AnchorVector> out(1, anchor);
  out.back().head<3>() = spread.mirror(anchor.head<3>(), axis);
  if (axis != kAcrossPlane || model::is_ablated(model::Mechanism::kCalibrationProbes)) return out;
  double nearest_m = std::numeric_limits<double>::infinity();
  for (const Observation& row : problem.rows) {
    nearest_m = std::min(nearest_m, (row.tag_m - anchor.head<3>()).norm());
  }
  for (const double share : kProbes) {
    out.push_back(anchor);
    out.back().head<3>() += (share * nearest_m - height_m) * normal;
  }
  return out;
}

void drop_doubles(const AnchorVector& anchor, std::vector<AnchorVector>& starts) {
  std::vector<Eigen::Vector3d> tried_m{anchor.head<3>()};
  std::erase_if(starts, [&](const AnchorVector& start) {
    const Eigen::Vector3d place_m = start.head<3>();
    const bool tried = std::any_of(tried_m.begin(), tried_m.end(), [&](const Eigen::Vector3d& other_m) {
      return (place_m - other_m).norm() < kSameMirror_m;
    });
    if (!tried) tried_m.push_back(place_m);
    return tried;
  });
}

BothSides solve_both_sides(const AnchorProblem& problem, std::span<const RobustKernel> kernels,
                           const AnchorVector& anchor, std::span<const AnchorVector> starts,
                           const TagSpread& spread, int axis) {
  std::vector<AnchorSolution> found;
  found.push_back(solve_anchor(problem, kernels, anchor, kIterations));
  for (const AnchorVector& start : starts)
    found.push_back(solve_anchor(problem, kernels, start, kIterations));
  const auto cheaper = [](const AnchorSolution& a, const AnchorSolution& b) { return a.cost < b.cost; };
  BothSides out;
  out.here = *std::min_element(found.begin(), found.end(), cheaper);
  const double height_m = height_above(spread, axis, out.here.anchor);
  std::erase_if(found, [&](const AnchorSolution& solution) {
    return height_above(spread, axis, solution.anchor) * height_m > 0.0;
  });
  if (!found.empty()) {
    out.there = *std::min_element(found.begin(), found.end(), cheaper);
    return out;
  }
  // No minimum on the other side: use the cost at the mirrored distance from the tags.
  AnchorVector mirrored = out.here.anchor;
  mirrored.head<3>() = spread.mirror(out.here.anchor.head<3>(), axis);
  const Eigen::Vector3d normal = spread.axes.col(axis);
  AnchorProblem held = problem;
  held.position.mean_m = mirrored.head<3>();
  held.position.information += normal * normal.transpose() / (kHoldSigma_m * kHoldSigma_m);
  out.there = solve_anchor(held, kernels, mirrored, kIterations);
  return out;
}

// Effort of search and refinement, by hand against time; the campaigns hold with it. Of 250 residuals a scale
// has a relative sigma of 1/sqrt(2 * 250) = 0.045.
constexpr std::size_t kSearchRowsPerTag = 30;
constexpr std::size_t kPairResiduals = 250;
constexpr int kKernelSteps = 2;
constexpr int kSolvingSteps = 2;
constexpr int kFirstRounds = 2;
constexpr int kWarmRounds = 1;
// Number of residuals that move a kernel half-way from its prior. The site's prior is the data set's noise,
// an anchor's is the site's kernel, a pair's is its anchor's kernel. By hand; the campaigns hold with them,
// and NlosSite.ResultDoesNotDependOnTheConfiguredNoise.
constexpr double kSiteWeight = 20.0;
// Shares need far more residuals than scales do, because few ranges are NLOS: ten times as many, by hand.
constexpr double kAnchorScaleWeight = 50.0;
constexpr double kAnchorShareWeight = 500.0;
constexpr double kPairScaleWeight = 100.0;
constexpr double kPairShareWeight = 1000.0;
// An anchor has converged if a round moves it by less than this, in sigmas: 0.01 in chi square.
constexpr double kRestingSigmas = 0.1;
// Later ranges contradict an earlier solution if they cost more than its own by this each: a third of them
// are off, or fewer by far. By hand: beyond 3 scales a range costs some 3 nats more than in LOS.
constexpr double kContradictionCost = 1.0;
constexpr int kStartingSteps = 6;  // a bound on time, by hand
// Wider than any site: only keeps an anchor finite where the ranges leave it open. By hand.
constexpr double kUnknownSigma_m = 300.0;
constexpr double kKnownAnchorSigma_m = 0.02;  // of a survey, by hand: as docs/reference/commands.md states

PositionPrior position_prior(const SiteProblem& site, const AnchorObservations& data,
                             std::span<const Observation> rows) {
  const auto known = std::find_if(site.known_anchors.begin(), site.known_anchors.end(),
                                  [&](const model::Anchor& a) { return a.id == data.id; });
  PositionPrior prior;
  if (known != site.known_anchors.end() && known->position_m.allFinite()) {
    prior.mean_m = known->position_m;
    prior.information = Eigen::Matrix3d::Identity() / (kKnownAnchorSigma_m * kKnownAnchorSigma_m);
    prior.surveyed = true;
    return prior;
  }
  prior.mean_m = tag_spread(rows).center_m;
  prior.information = Eigen::Matrix3d::Identity() / (kUnknownSigma_m * kUnknownSigma_m);
  return prior;
}

// Every n-th residual of each tag, weighted by its probability of LOS.
std::vector<std::vector<WeighedResidual>> sample_residuals(const AnchorFit& fit) {
  const std::size_t tags = fit.problem.tag_count;
  std::vector<std::vector<WeighedResidual>> out(tags);
  // Counted per tag: where tags take turns, a stride over all observations would see only some of them.
  const std::size_t stride = 1 + fit.problem.rows.size() / (tags * kPairResiduals + 1);
  std::vector<std::size_t> seen(tags, 0);
  for (const Observation& row : fit.problem.rows) {
    if (seen[row.tag]++ % stride != 0) continue;
    const double r = residual_m(row, fit.anchor, tags);
    // The larger the pose's part of a residual, the less it shows of the kernel's variance.
    const double share = noise_share(fit.kernels[row.tag], pose_variance_m2(row, fit.anchor, tags));
    double weight = share * share * share * share;
    if (fit.problem.los_states != nullptr) weight *= row_at(fit, row).value.los_count;
    out[row.tag].push_back({.residual_m = share * r, .weight = weight});
  }
  return out;
}

// Hierarchical: the site's kernel is the prior of the anchors', an anchor's that of its pairs'.
void estimate_kernels(std::span<AnchorFit> fits) {
  if (fits.empty()) return;
  std::vector<std::vector<std::vector<WeighedResidual>>> residuals;
  residuals.reserve(fits.size());
  for (const AnchorFit& fit : fits) residuals.push_back(sample_residuals(fit));

  for (int step = 0; step < kKernelSteps; ++step) {
    std::vector<KernelStatistics> anchors(fits.size());
    std::vector<std::vector<KernelStatistics>> pairs(fits.size());
    KernelStatistics site;
    for (std::size_t i = 0; i < fits.size(); ++i) {
      for (std::size_t tag = 0; tag < fits[i].kernels.size(); ++tag) {
        pairs[i].push_back(fits[i].kernels[tag].statistics(residuals[i][tag], 2.0));
        anchors[i] += pairs[i].back();
      }
      site += anchors[i];
    }
    const KernelPrior of_data_set{.shape = {.scale_m = fits.front().problem.priors.sigma_m},
                                  .scale_weight = kSiteWeight,
                                  .share_weight = kSiteWeight};
    const KernelPrior of_site{.shape = likeliest_shape(site, of_data_set),
                              .scale_weight = kAnchorScaleWeight,
                              .share_weight = kAnchorShareWeight};
    for (std::size_t i = 0; i < fits.size(); ++i) {
      const KernelPrior of_anchor{.shape = likeliest_shape(anchors[i], of_site),
                                  .scale_weight = kPairScaleWeight,
                                  .share_weight = kPairShareWeight};
      for (std::size_t tag = 0; tag < fits[i].kernels.size(); ++tag) {
        fits[i].kernels[tag] = RobustKernel(model::is_ablated(model::Mechanism::kCalibrationKernels)
                                                ? of_site.shape
                                                : likeliest_shape(pairs[i][tag], of_anchor));
      }
    }
  }
}

// Whether ranges after those of the earlier solution contradict it, as happens if the robot had hardly moved
// by then.
bool is_contradicted(const AnchorFit& earlier, std::span<const Observation> rows) {
  const std::size_t seen = earlier.problem.rows.size();
  if (rows.size() == seen || model::is_ablated(model::Mechanism::kCalibrationContradict)) return false;
  AnchorFit later = earlier;
  later.problem.rows = rows.subspan(seen);
  return robust_cost(later) / static_cast<double>(rows.size() - seen) >
         earlier.cost / static_cast<double>(seen) + kContradictionCost;
}

void find_start_beside(const AnchorFit& earlier, AnchorFit& fit) {
  find_start(fit);
  const AnchorSolution found = solve_anchor(fit.problem, fit.kernels, fit.anchor, kStartingSteps);
  const AnchorSolution known = solve_anchor(fit.problem, fit.kernels, earlier.anchor, kStartingSteps);
  if (found.cost <= known.cost) return;
  fit.anchor = earlier.anchor;
  fit.kernels = earlier.kernels;
}

}  // namespace

std::vector<Observation> spread_along_the_way(std::span<const Observation> rows, std::size_t tag_count,
                                              std::size_t max_rows_per_tag) {
  struct Way {
    std::size_t rows = 0;
    double length_m = 0.0;
    const Observation* last = nullptr;
    double walked_m = 0.0;  // so far; spent_m of it by the observations taken
    double spent_m = 0.0;
  };
  std::vector<Way> ways(tag_count);
  // Adds a millimetre per observation, so that a stationary robot has a path too.
  const auto step_to = [](const Observation& row, Way& way) {
    const Observation* last = std::exchange(way.last, &row);
    return 1e-3 + (last != nullptr ? (row.tag_m - last->tag_m).norm() : 0.0);
  };
  for (const Observation& row : rows) {
    ++ways[row.tag].rows;
    ways[row.tag].length_m += step_to(row, ways[row.tag]);
  }
  for (Way& way : ways) way.last = nullptr;
  std::vector<Observation> out;
  out.reserve(std::min(rows.size(), tag_count * max_rows_per_tag));
  for (const Observation& row : rows) {
    Way& way = ways[row.tag];
    way.walked_m += step_to(row, way);
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
  return out;
}

AnchorFit descend(const AnchorProblem& problem, const AnchorVector& start) {
  AnchorFit out{.problem = problem, .anchor = start};
  // The scale shrinks from the basin's width to that of the residuals: the basin is wide at first.
  KernelShape shape = KernelShape{.scale_m = valley_width_m(problem)}.with_nlos(0.1);
  std::vector<WeighedResidual> residuals(problem.rows.size());
  for (int round = 0; round < kSearchRounds; ++round) {
    if (round > 0) {
      for (std::size_t i = 0; i < residuals.size(); ++i) {
        residuals[i].residual_m = residual_m(problem.rows[i], out.anchor, problem.tag_count);
      }
      KernelPrior prior{.shape = shape, .scale_weight = 3.0, .share_weight = 3.0};
      prior.shape.scale_m = std::max(problem.priors.sigma_m, shape.scale_m / 2.0);
      shape = fit_kernel(residuals, prior, 3);
    }
    out.kernels.assign(problem.tag_count, RobustKernel(shape));
    AnchorSolution solution = solve_anchor(problem, out.kernels, out.anchor, kSearchIterations);
    out.anchor = std::move(solution.anchor);
    out.cost = solution.cost;
  }
  return out;
}

AnchorFit search(const AnchorProblem& problem) {
  const model::RangePriors& priors = problem.priors;
  const double scale = model::scale_of(model::means_of(priors));
  const double offset_m = model::offset_m(model::means_of(priors));
  const double width_m = valley_width_m(problem);

  std::vector<Start> starts = sphere_points(problem);
  // All tags count as one until the biases are known.
  std::vector<Observation> of_one_tag;
  for (const Observation* row : sample(problem.rows, kScoredRows)) of_one_tag.emplace_back(*row).tag = 0;
  const RowColumns columns(of_one_tag, 1);
  for (Start& start : starts) {
    for (Eigen::Index block = 0; block < columns.blocks(0); ++block) {
      Lanes square_m2 = Lanes::Zero();
      for (Eigen::Index axis = 0; axis < 3; ++axis) {
        square_m2 += (columns.at(0, block, RowColumns::kAntenna + axis) - start.position_m(axis)).square();
      }
      const Lanes expected_m = scale * square_m2.sqrt() + offset_m;
      const Lanes square = ((columns.at(0, block, RowColumns::kRange) - expected_m) / width_m).square();
      start.score += (square / (1.0 + square)).head(columns.rows_in(0, block)).sum();
    }
  }
  std::stable_sort(starts.begin(), starts.end(),
                   [](const Start& a, const Start& b) { return a.score < b.score; });

  AnchorFit best{.anchor = anchor_at(problem.position.mean_m, problem.tag_count, priors),
                 .kernels = std::vector<RobustKernel>(problem.tag_count),
                 .cost = std::numeric_limits<double>::infinity()};
  std::vector<Eigen::Vector3d> tried;
  for (const Start& start : starts) {
    if (tried.size() == kRefined) break;
    const auto is_near = [&](const Eigen::Vector3d& p) {
      return (p - start.position_m).norm() < 2.0 * width_m;
    };
    if (std::any_of(tried.begin(), tried.end(), is_near)) continue;
    tried.push_back(start.position_m);

    AnchorFit candidate = descend(problem, anchor_at(start.position_m, problem.tag_count, priors));
    if (tried.size() == 1 || candidate.cost < best.cost) best = std::move(candidate);
  }
  return best;
}

// Root mean square of the difference of the ranges that two solutions predict.
double difference_m(const AnchorProblem& problem, const AnchorVector& one, const AnchorVector& other) {
  double sum_m2 = 0.0;
  for (const Observation& row : problem.rows)
    sum_m2 +=
        model::square(residual_m(row, one, problem.tag_count) - residual_m(row, other, problem.tag_count));
  return std::sqrt(sum_m2 / static_cast<double>(problem.rows.size()));
}

MirrorHypothesis test_mirror(AnchorFit& fit, const TagSpread& spread, int axis) {
  AnchorProblem sketch = fit.problem;
  const std::vector<Observation> few = spread_along_the_way(sketch.rows, sketch.tag_count, kRowsPerTag);
  sketch.rows = few;
  BothSides result = solve_both_sides(sketch, fit.kernels, fit.anchor,
                                      starts_around(sketch, fit.anchor, spread, axis), spread, axis);
  double scale = static_cast<double>(fit.problem.rows.size()) / static_cast<double>(few.size());
  const bool moved = (result.here.anchor - fit.anchor).head<3>().norm() > kRefitMove_m;
  if (moved || (result.there.cost - result.here.cost) * scale < kCloseExcess) {
    std::vector<AnchorVector> starts{result.here.anchor, result.there.anchor, fit.anchor};
    // The few ranges may have a single basin between the two that all ranges have.
    starts.back().head<3>() = spread.mirror(fit.anchor.head<3>(), axis);
    drop_doubles(fit.anchor, starts);
    result = solve_both_sides(fit.problem, fit.kernels, fit.anchor, starts, spread, axis);
    sketch.rows = fit.problem.rows;
    scale = 1.0;
    fit.anchor = result.here.anchor;
    fit.cost = result.here.cost;
  }
  CostSum of_perfect;
  for (const Observation& row : sketch.rows) of_perfect.add(fit.kernels[row.tag].at(0.0));
  const double perfect = of_perfect.cost();
  MirrorHypothesis mirror;
  mirror.anchor = result.there.anchor;
  if (difference_m(sketch, result.here.anchor, result.there.anchor) > kIndistinct_m)
    mirror.cost_excess = scale * std::max(0.0, result.there.cost - result.here.cost);
  mirror.cost_ratio =
      std::clamp((result.here.cost - perfect) / std::max(result.there.cost - perfect, 1e-9), 0.0, 1.0);
  return mirror;
}

void test_both_mirrors(AnchorFit& fit) {
  const TagSpread spread = tag_spread(fit.problem.rows);
  for (const int axis : {kAcrossLine, kAcrossPlane}) static_cast<void>(test_mirror(fit, spread, axis));
}

void weigh_by_earlier(const EarlierPlace& earlier, double inflation, AnchorFit& fit,
                      MirrorHypothesis& mirror) {
  const Eigen::LDLT<Eigen::Matrix3d> factors(earlier.covariance_m2);
  const auto cost = [&](const AnchorVector& anchor) {
    const Eigen::Vector3d offset_m = anchor.head<3>() - earlier.position_m;
    return std::min(kMovedCost, 0.5 * offset_m.dot(factors.solve(offset_m)));
  };
  mirror.cost_excess += inflation * (cost(mirror.anchor) - cost(fit.anchor));
  if (mirror.cost_excess >= 0.0) return;
  std::swap(fit.anchor, mirror.anchor);
  fit.cost = robust_cost(fit);
  mirror.cost_excess = -mirror.cost_excess;
}

Eigen::Matrix3d mirror_covariance(const MirrorHypothesis& mirror, const AnchorFit& fit, double inflation) {
  if (model::is_ablated(model::Mechanism::kCalibrationMirror)) return Eigen::Matrix3d::Zero();
  const double odds = std::exp(-mirror.cost_excess / std::max(1.0, inflation));
  const Eigen::Vector3d offset_m = mirror.anchor.head<3>() - fit.anchor.head<3>();
  return odds / (1.0 + odds) * offset_m * offset_m.transpose();
}

void refine_site(std::span<AnchorFit> fits, int max_rounds) {
  bool resting = false;
  for (int round = 0; round < max_rounds && !resting; ++round) {
    estimate_kernels(fits);
    resting = true;
    for (AnchorFit& fit : fits) {
      if (fit.problem.rows.empty()) continue;
      AnchorSolution solution = solve_anchor(fit.problem, fit.kernels, fit.anchor, kSolvingSteps);
      resting = resting && solution.moved_sigmas < kRestingSigmas;
      fit.anchor = std::move(solution.anchor);
      fit.cost = solution.cost;
    }
  }
}

void find_start(AnchorFit& fit) {
  const AnchorProblem& problem = fit.problem;
  const std::vector<Observation> few =
      spread_along_the_way(problem.rows, problem.tag_count, kSearchRowsPerTag);
  AnchorProblem sketch = problem;
  sketch.rows = few;
  const AnchorFit best =
      problem.position.surveyed
          ? descend(sketch, anchor_at(problem.position.mean_m, problem.tag_count, problem.priors))
          : search(sketch);
  fit.anchor = best.anchor;
  fit.kernels = best.kernels;
}

void bound_rows(Association& association, PollTable& polls, const SiteProblem& problem, std::size_t most) {
  const std::size_t tags = association.tags.size();
  for (std::size_t a = 0; a < association.anchors.size(); ++a) {
    AnchorObservations& data = association.anchors[a];
    if (data.rows.size() <= most) continue;
    AnchorFit sketch;
    sketch.problem = {.rows = data.rows,
                      .tag_count = tags,
                      .priors = problem.priors,
                      .position = position_prior(problem, data, data.rows)};
    find_start(sketch);
    const Eigen::Vector3d anchor_m = sketch.anchor.head<3>();
    const Eigen::Vector3d mirrored_m = tag_spread(data.rows).mirror(anchor_m, kAcrossPlane);
    std::vector<RangeGeometry> ranges;
    ranges.reserve(data.rows.size());
    for (const Observation& row : data.rows) {
      const model::AntennaPrediction predicted = predict(row, sketch.anchor, tags);
      ranges.push_back({.t_s = row.t_s,
                        .tag = row.tag,
                        .direction = predicted.direction,
                        .distance_m = predicted.distance_m,
                        .mirrored_m = (row.tag_m - mirrored_m).norm(),
                        .sigma_m = problem.priors.sigma_m});
    }
    const std::vector<std::size_t> chosen =
        choose_measurements({.ranges = ranges,
                             .tag_count = tags,
                             .priors = problem.priors,
                             .mirror_offset_m = (mirrored_m - anchor_m).norm()},
                            most);
    for (std::size_t i = 0; i < chosen.size(); ++i) {
      data.rows[i] = data.rows[chosen[i]];
      data.rows[i].index = static_cast<std::uint32_t>(i);
    }
    data.left_out = data.rows.size() - chosen.size();
    data.rows.resize(chosen.size());
    keep_rows(polls, a, chosen);
  }
}

std::vector<AnchorFit> solve_site(const SiteProblem& site, std::span<const AnchorFit> earlier) {
  const std::size_t tags = site.association->tags.size();
  std::vector<AnchorFit> fits;
  for (const AnchorObservations& data : site.association->anchors) {
    const auto end = std::upper_bound(data.rows.begin(), data.rows.end(), site.end_s,
                                      [](double t_s, const Observation& row) { return t_s < row.t_s; });
    const std::span<const Observation> rows(data.rows.begin(), end);
    AnchorFit& fit = fits.emplace_back();
    fit.problem = {
        .rows = rows, .tag_count = tags, .priors = site.priors, .position = position_prior(site, data, rows)};
    fit.anchor = anchor_at(fit.problem.position.mean_m, tags, site.priors);
    fit.kernels.assign(tags, RobustKernel(KernelShape{.scale_m = site.priors.sigma_m}));
    if (rows.empty()) continue;

    const std::size_t index = fits.size() - 1;
    const bool was_solved = index < earlier.size() && 2 * earlier[index].problem.rows.size() > rows.size();
    if (!was_solved || fit.problem.position.surveyed) {
      find_start(fit);
    } else if (is_contradicted(earlier[index], rows)) {
      find_start_beside(earlier[index], fit);
    } else {
      fit.anchor = earlier[index].anchor;
      fit.kernels = earlier[index].kernels;
    }
  }
  refine_site(fits, earlier.empty() ? kFirstRounds : kWarmRounds);
  return fits;
}

}  // namespace groma::calibration
