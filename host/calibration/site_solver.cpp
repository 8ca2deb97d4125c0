#include "host/calibration/site_solver.hpp"

#include <algorithm>

#include "host/calibration/initial_guess.hpp"
#include "host/calibration/measurement_choice.hpp"
#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

constexpr std::size_t kSearchRowsPerTag = 30;
constexpr std::size_t kPairResiduals = 250;
constexpr int kLearningSteps = 2;
constexpr int kSolvingSteps = 2;
constexpr int kFirstRounds = 2;
constexpr int kWarmRounds = 1;
// So many residuals it takes to move a kernel half-way from what it inherits: the site's from the data
// set's noise, an anchor's from the site's, a pair's from its anchor's.
constexpr double kSiteWeight = 20.0;
// Shares want far more than scales before they are a pair's own: few ranges are blocked.
constexpr double kAnchorScaleWeight = 50.0;
constexpr double kAnchorShareWeight = 500.0;
constexpr double kPairScaleWeight = 100.0;
constexpr double kPairShareWeight = 1000.0;
// An anchor rests that a round moves by less than this, in sigmas.
constexpr double kRestingSigmas = 0.1;
// By so much do rows that a solution did not see cost more than those it did, each, if they contradict it: a
// third of them, or fewer that are far off.
constexpr double kContradictionCost = 1.0;
constexpr int kStartingSteps = 6;
// Far outside any site: only keeps an anchor finite where ranges leave it open.
constexpr double kUnknownSigma_m = 300.0;

PositionPrior position_prior(const SiteProblem& site, const AnchorObservations& data,
                             std::span<const Observation> rows) {
  const auto known = std::find_if(site.known_anchors.begin(), site.known_anchors.end(),
                                  [&](const model::Anchor& a) { return a.id == data.id; });
  PositionPrior prior;
  if (known != site.known_anchors.end() && known->position_m.allFinite()) {
    prior.mean_m = known->position_m;
    const double sigma_m = std::max(site.known_anchor_sigma_m, 1e-4);
    prior.information = Eigen::Matrix3d::Identity() / (sigma_m * sigma_m);
    prior.surveyed = true;
    return prior;
  }
  prior.mean_m = tag_spread(rows).center_m;
  prior.information = Eigen::Matrix3d::Identity() / (kUnknownSigma_m * kUnknownSigma_m);
  return prior;
}

// Residuals of each tag, as far as they are in sight: every n-th row.
std::vector<std::vector<WeighedResidual>> sample_residuals(const AnchorFit& fit) {
  const std::size_t tags = fit.problem.tag_count;
  std::vector<std::vector<WeighedResidual>> out(tags);
  // Counted pair by pair: a stride over all rows would see but some of the tags where they take turns.
  const std::size_t stride = 1 + fit.problem.rows.size() / (tags * kPairResiduals + 1);
  std::vector<std::size_t> seen(tags, 0);
  for (const Observation& row : fit.problem.rows) {
    if (seen[row.tag]++ % stride != 0) continue;
    const RowAt at = row_at(fit, row);
    // The more a range is blurred by its pose, the less it says of the kernel's variance.
    const double share = at.noise_share;
    out[row.tag].push_back(
        {.residual_m = share * at.residual_m, .weight = share * share * share * share * at.value.seen_share});
  }
  return out;
}

// Site, anchor, pair: each kernel leans on the one above.
void learn_kernels(std::span<AnchorFit> fits) {
  if (fits.empty()) return;
  std::vector<std::vector<std::vector<WeighedResidual>>> residuals;
  residuals.reserve(fits.size());
  for (const AnchorFit& fit : fits) residuals.push_back(sample_residuals(fit));

  for (int step = 0; step < kLearningSteps; ++step) {
    std::vector<KernelStatistics> anchors(fits.size());
    std::vector<std::vector<KernelStatistics>> pairs(fits.size());
    KernelStatistics site;
    for (std::size_t i = 0; i < fits.size(); ++i) {
      for (std::size_t tag = 0; tag < fits[i].kernels.size(); ++tag) {
        pairs[i].push_back(kernel_statistics(fits[i].kernels[tag], residuals[i][tag], 2.0));
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

}  // namespace

void refine_site(std::span<AnchorFit> fits, int max_rounds) {
  bool resting = false;
  for (int round = 0; round < max_rounds && !resting; ++round) {
    learn_kernels(fits);
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

RowSpan row_span(std::span<const AnchorFit> fits) noexcept {
  RowSpan out;
  for (const AnchorFit& fit : fits) {
    if (fit.problem.rows.empty()) continue;
    out.begin_s = std::min(out.begin_s, fit.problem.rows.front().t_s);
    out.end_s = std::max(out.end_s, fit.problem.rows.back().t_s);
  }
  return out;
}

void find_start(AnchorFit& fit) {
  const AnchorProblem& problem = fit.problem;
  const std::vector<Observation> few =
      spread_along_the_way(problem.rows, problem.tag_count, kSearchRowsPerTag);
  AnchorProblem sketch = problem;
  sketch.rows = few;
  Candidate best =
      problem.position.surveyed
          ? descend(sketch, anchor_at(problem.position.mean_m, problem.tag_count, problem.priors))
          : search(sketch);
  fit.anchor = best.solution.anchor;
  fit.kernels.assign(problem.tag_count, RobustKernel(best.kernel));
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
                             .beta_m = problem.priors.beta_m,
                             .gamma = problem.priors.gamma,
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

namespace {

// Whether rows that the earlier solution did not see contradict it, as where the robot had hardly moved till
// then.
bool is_contradicted(const AnchorFit& earlier, std::span<const Observation> rows) {
  const std::size_t seen = earlier.problem.rows.size();
  if (rows.size() == seen || model::is_ablated(model::Mechanism::kCalibrationContradict)) return false;
  AnchorFit later = earlier;
  later.problem.rows = rows.subspan(seen);
  return robust_cost(later) / static_cast<double>(rows.size() - seen) >
         earlier.cost / static_cast<double>(seen) + kContradictionCost;
}

// Searches, and keeps what it finds unless the earlier solution leads to a cheaper one.
void find_start_beside(const AnchorFit& earlier, AnchorFit& fit) {
  find_start(fit);
  const AnchorSolution found = solve_anchor(fit.problem, fit.kernels, fit.anchor, kStartingSteps);
  const AnchorSolution known = solve_anchor(fit.problem, fit.kernels, earlier.anchor, kStartingSteps);
  if (found.cost <= known.cost) return;
  fit.anchor = earlier.anchor;
  fit.kernels = earlier.kernels;
}

}  // namespace

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
    if (was_solved && !fit.problem.position.surveyed) {
      if (is_contradicted(earlier[index], rows)) {
        find_start_beside(earlier[index], fit);
        continue;
      }
      fit.anchor = earlier[index].anchor;
      fit.kernels = earlier[index].kernels;
      continue;
    }
    find_start(fit);
  }
  refine_site(fits, earlier.empty() ? kFirstRounds : kWarmRounds);
  return fits;
}

}  // namespace groma::calibration
