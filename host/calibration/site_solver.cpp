#include "host/calibration/site_solver.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <utility>

#include "host/calibration/measurement_choice.hpp"
#include "host/calibration/mirror.hpp"
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

// The solution in the basin of the start, with kernels estimated from its own residuals: it does not depend
// on a first guess of the noise. The cost is a negative log likelihood, so costs with different kernels are
// comparable.
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
