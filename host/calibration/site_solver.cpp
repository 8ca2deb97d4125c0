#include "host/calibration/site_solver.hpp"

#include <algorithm>

#include "host/calibration/initial_guess.hpp"

namespace groma::calibration {
namespace {

constexpr std::size_t kSearchRowsPerTag = 80;
constexpr std::size_t kPooledResiduals = 4000;
constexpr std::size_t kAnchorResiduals = 1500;
constexpr std::size_t kPairResiduals = 500;
constexpr int kLearningSteps = 3;
constexpr int kSolvingSteps = 3;
constexpr int kFirstRounds = 3;
// So many residuals it takes to move a kernel half-way from what it inherits: the site's from the data
// set's noise, an anchor's from the site's, a pair's from its anchor's.
constexpr double kSiteWeight = 20.0;
constexpr double kAnchorWeight = 50.0;
constexpr double kPairWeight = 100.0;
// Far outside any site: only keeps an anchor finite where ranges leave it open.
constexpr double kOpenSigma_m = 300.0;

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
  prior.information = Eigen::Matrix3d::Identity() / (kOpenSigma_m * kOpenSigma_m);
  return prior;
}

void append_residuals(const AnchorFit& fit, std::optional<std::uint32_t> tag, std::size_t count,
                      std::vector<double>& out) {
  const std::size_t rows = fit.problem.rows.size();
  const std::size_t stride = std::max<std::size_t>(1, rows / std::max<std::size_t>(1, count));
  if (!tag) {
    for (std::size_t i = 0; i < rows; i += stride) {
      out.push_back(residual_m(fit.problem.rows[i], fit.anchor, fit.problem.tag_count));
    }
    return;
  }
  // Of one tag: the stride counts this tag's rows alone.
  std::size_t seen = 0;
  const std::size_t tag_stride = std::max<std::size_t>(1, stride / fit.problem.tag_count);
  for (const Observation& row : fit.problem.rows) {
    if (row.tag != *tag || seen++ % tag_stride != 0) continue;
    out.push_back(residual_m(row, fit.anchor, fit.problem.tag_count));
  }
}

// Site, anchor, pair: each kernel starts from the one above.
void learn_kernels(std::vector<AnchorFit>& fits, const model::RangePriors& priors) {
  std::vector<double> residuals;
  for (const AnchorFit& fit : fits) {
    append_residuals(fit, std::nullopt, kPooledResiduals / std::max<std::size_t>(1, fits.size()), residuals);
  }
  KernelPrior site{
      .shape = {.scale_m = priors.sigma_m}, .scale_weight = kSiteWeight, .share_weight = kSiteWeight};
  site.shape = fit_kernel(residuals, site, 0.0, 3 * kLearningSteps);
  for (AnchorFit& fit : fits) {
    if (fit.problem.rows.empty()) continue;
    residuals.clear();
    append_residuals(fit, std::nullopt, kAnchorResiduals, residuals);
    KernelPrior anchor{.shape = site.shape, .scale_weight = kAnchorWeight, .share_weight = kAnchorWeight};
    anchor.shape = fit_kernel(residuals, anchor, 3.0, kLearningSteps);
    for (std::size_t tag = 0; tag < fit.problem.tag_count; ++tag) {
      residuals.clear();
      append_residuals(fit, static_cast<std::uint32_t>(tag), kPairResiduals, residuals);
      const KernelPrior pair{.shape = anchor.shape, .scale_weight = kPairWeight, .share_weight = kPairWeight};
      fit.kernels[tag] = RobustKernel(fit_kernel(residuals, pair, 1.0, kLearningSteps));
    }
  }
}

}  // namespace

void refine_site(std::vector<AnchorFit>& fits, const model::RangePriors& priors, int rounds) {
  for (int round = 0; round < rounds; ++round) {
    learn_kernels(fits, priors);
    for (AnchorFit& fit : fits) {
      if (fit.problem.rows.empty()) continue;
      AnchorSolution solution = solve_anchor(fit.problem, fit.kernels, fit.anchor, kSolvingSteps);
      fit.anchor = std::move(solution.anchor);
      fit.cost = solution.cost;
    }
  }
}

std::vector<AnchorFit> solve_site(const SiteProblem& site, std::span<const AnchorVector> starts) {
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

    const std::vector<Observation> few = spread_along_the_way(rows, tags, kSearchRowsPerTag);
    AnchorProblem sketch = fit.problem;
    sketch.rows = few;
    if (fit.problem.position.surveyed) {
      fit.kernels.assign(tags,
                         RobustKernel(KernelShape{.scale_m = 3.0 * site.priors.sigma_m, .blocked = 0.2}));
      fit.anchor = solve_anchor(sketch, fit.kernels, fit.anchor, 10).anchor;
      continue;
    }
    Candidate best = search(sketch);
    if (fits.size() <= starts.size()) {
      const std::vector<RobustKernel> kernels(tags, RobustKernel(best.kernel));
      AnchorSolution other = solve_anchor(sketch, kernels, starts[fits.size() - 1], 10);
      if (other.cost < best.solution.cost) best.solution = std::move(other);
    }
    fit.anchor = best.solution.anchor;
    fit.kernels.assign(tags, RobustKernel(best.kernel));
    fit.cost = best.solution.cost;
  }
  refine_site(fits, site.priors, kFirstRounds);
  return fits;
}

}  // namespace groma::calibration
