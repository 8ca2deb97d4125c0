#include "host/calibration/calibrate.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>

#include "host/calibration/anchor_links.hpp"
#include "host/calibration/covariance_budget.hpp"
#include "host/calibration/range_noise.hpp"
#include "host/calibration/site.hpp"
#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// If pose heights differ from the surface by more than this (rms), both heights are tried. By hand; it only
// saves time, because the solution of lower cost is kept.
constexpr double kHeightDisagreement_m = 0.1;
constexpr double kHeldOutShare = 0.2;  // by hand: the fifth that docs/reference/commands.md states
// Largest pose sigma per axis with which moves are searched for. By hand: at this sigma the poses explain the
// least move with 2 sigmas. Moved.FindsHardlyAnyWherePosesDriftAsFarOverManyDrives holds with it.
constexpr double kMovePose_m = 0.5 * kMinMove_m;
// An axis of a lever arm is reported if its sigma is below this share of kLeverArmSigma_m. By hand: the
// ranges then have at least 1/0.5^2 - 1 = 3 times the prior's information.
constexpr double kRefinedShare = 0.5;

model::RangePriors usable_priors(const model::RangePriors& given) {
  const model::RangePriors fallback;
  const auto sigma = [](double value, double instead) {
    return std::max(std::isfinite(value) && value > 0.0 ? value : instead, 1e-6);
  };
  model::RangePriors out = given;
  out.sigma_m = std::max(sigma(given.sigma_m, fallback.sigma_m), 1e-3);
  for (const model::PairTerm& term : model::kPairTerms) {
    model::ScalarPrior& prior = out.*term.prior;
    const model::ScalarPrior& instead = fallback.*term.prior;
    prior.sigma = sigma(prior.sigma, instead.sigma);
    if (!std::isfinite(prior.mean) || (term.neutral > 0.0 && prior.mean <= 0.1)) prior.mean = instead.mean;
  }
  return out;
}

double held_out_from(const Association& association) {
  double begin_s = std::numeric_limits<double>::infinity();
  double end_s = -begin_s;
  for (const AnchorObservations& anchor : association.anchors) {
    if (anchor.rows.empty()) continue;
    begin_s = std::min(begin_s, anchor.rows.front().t_s);
    end_s = std::max(end_s, anchor.rows.back().t_s);
  }
  return end_s - kHeldOutShare * (end_s - begin_s);
}

// Poses whose own covariance is as large as a move cannot show one.
bool poses_show_moves(const Association& association) {
  if (model::is_ablated(model::Mechanism::kCalibrationMoves)) return false;
  return std::all_of(
      association.pose_spreads.begin(), association.pose_spreads.end(), [](const PoseSpread& spread) {
        return spread.covariance.topLeftCorner<2, 2>().trace() < 2.0 * kMovePose_m * kMovePose_m;
      });
}

bool has_moves(const Site& site) {
  return std::any_of(site.evidence.begin(), site.evidence.end(),
                     [](const AnchorEvidence& evidence) { return evidence.path.has_moved(); });
}

// Solves the anchors one by one, with uncorrected poses.
Site solve_anchors(const Drive& drive, const Options& options, HeightSource height, bool find_moves) {
  Site site;
  site.association = associate(drive, height);  // antenna positions of eq. (12)
  site.polls = tabulate_polls(site.association);
  SiteProblem problem{
      .association = &site.association, .priors = drive.priors, .known_anchors = drive.known_anchors};
  bound_rows(site.association, site.polls, problem, options.most_anchor_ranges);
  problem.end_s = held_out_from(site.association);
  site.beginning = solve_site(problem, {});  // search and solve without the held-out part
  problem.end_s = std::numeric_limits<double>::infinity();
  site.fits = solve_site(problem, site.beginning);  // robust least squares on eq. (12), per anchor
  site.evidence.resize(site.fits.size());
  if (is_within_reach(site.fits)) {
    find_nlos(site.polls, site.fits, site.los_states);
    if (find_moves && poses_show_moves(site.association)) find_moved(site);
  }
  test_mirrors(site, options.earlier);
  return site;
}

// Takes either the poses' own height or the surface's, whichever explains the ranges better.
Site solve_at_best_height(const Drive& drive, const Options& options, bool find_moves) {
  Site site = solve_anchors(drive, options, HeightSource::kPose, find_moves);
  if (height_disagreement_m(drive) < kHeightDisagreement_m) return site;
  if (model::is_ablated(model::Mechanism::kCalibrationHeights)) return site;
  Site other = solve_anchors(drive, options, HeightSource::kSurface, find_moves);
  const auto cost = [](const Site& of) {
    return std::accumulate(of.fits.begin(), of.fits.end(), 0.0,
                           [](double sum, const AnchorFit& fit) { return sum + fit.cost; });
  };
  return cost(other) < cost(site) ? std::move(other) : std::move(site);
}

// Solves the anchors, then the errors common to the drive: pose drift, range delay, lever arms, antenna
// patterns.
Site solve_drive(const Drive& drive, const Options& options, bool find_moves) {
  Site site = solve_at_best_height(drive, options, find_moves);
  // Score before correct_drive(): that uses all ranges, including those held out.
  for (std::size_t i = 0; i < site.fits.size(); ++i) {
    const AnchorFit& first = site.beginning[i];
    site.evidence[i].held_out =
        score_held_out(first, std::span(site.association.anchors[i].rows).subspan(first.problem.rows.size()));
  }
  site.error = correct_drive(site.association, site.fits);
  return site;
}

// Classifies each range as LOS or NLOS again, now that lever arms and antenna patterns are corrected.
void find_nlos_again(Site& site, const model::Calibration* earlier) {
  if (!has_moves(site) && is_within_reach(site.fits) &&
      !model::is_ablated(model::Mechanism::kCalibrationAgain)) {
    find_nlos(site.polls, site.fits, site.los_states);
    test_mirrors(site, earlier);
  }
  correct_further(site.association, site.fits, site.error);
}

std::vector<model::TagCalibration> tag_calibrations(std::span<const BodyError> body,
                                                    std::span<const model::Tag> tags) {
  std::vector<model::TagCalibration> out;
  for (std::size_t i = 0; i < body.size(); ++i) {
    model::TagCalibration& tag = out.emplace_back();
    tag.id = tags[i].id;
    tag.pattern_m = body[i].mean.tail<model::kPatternTerms>();
    model::LeverArmCalibration lever_arm{.position_m = tags[i].lever_arm_m};
    for (Eigen::Index axis = 0; axis < 3; ++axis) {
      const double sigma_m = std::sqrt(body[i].covariance(axis, axis));
      if (!(sigma_m < kRefinedShare * kLeverArmSigma_m)) continue;
      lever_arm.position_m(axis) += body[i].mean(axis);
      lever_arm.sigma_m(axis) = sigma_m;
      tag.lever_arm = lever_arm;
    }
  }
  return out;
}

model::AnchorCalibration describe(const Site& site, std::size_t i, const Eigen::MatrixXd& covariance,
                                  std::span<const FittedRange> fitted) {
  const AnchorFit& fit = site.fits[i];
  const AnchorObservations& data = site.association.anchors[i];
  model::AnchorCalibration out;
  out.id = data.id;
  for (const model::Tag& tag : site.association.tags) out.pairs.push_back({.tag_id = tag.id});
  set_values(out, fit.anchor, covariance);
  // Ranges before the anchor's last move count as rejected, and so do those more likely NLOS than LOS.
  out.ranges_used = static_cast<std::size_t>(
      std::count_if(fitted.begin(), fitted.end(), [](const FittedRange& row) { return !(row.los < 0.5); }));
  out.ranges_rejected = data.rejected + data.rows.size() - out.ranges_used;
  if (site.evidence[i].mirror) out.mirror_ratio = site.evidence[i].mirror->cost_ratio;
  out.held_out_rms_m = site.evidence[i].held_out.rms_m;
  out.held_out_robust_rms_m = site.evidence[i].held_out.robust_rms_m;
  return out;
}

}  // namespace

// The source paper's first stage, "Real-Time Initialization": anchor positions r_A and biases beta, gamma of
// the range model, eq. (12), by robust non-linear least squares from pose priors, tag offsets r_RS and
// ranges. Their means and covariances initialize the sensor states x_s, eq. (9), of the second stage.
Result calibrate(const Drive& drive, const Options& options) {
  Drive usable = drive;
  usable.priors = usable_priors(drive.priors);
  Site site = solve_drive(usable, options, true);
  // If the poses drift by as much as a move, apparent moves of anchors are not real.
  if (has_moves(site) && site.error.prior.drift.sigma_m > kMovePose_m)
    site = solve_drive(usable, options, false);
  if (!site.error.body.empty() && site.has_los_states()) find_nlos_again(site, options.earlier);
  estimate_inflation(site.fits);
  const std::vector<Eigen::MatrixXd> solved = join_links(usable.anchor_ranges, usable.priors, site);

  Result result;
  for (const AnchorFit& fit : site.fits) {
    result.fitted.push_back(fitted_ranges(fit, site.association.tags));
  }
  gather_anchor_evidence(site, result.fitted);
  // Mean and covariance of each anchor's part of x_s, and its verdict.
  for (std::size_t i = 0; i < site.fits.size(); ++i) {
    const Eigen::MatrixXd covariance = covariance_budget(site, i, solved[i]).covariance;
    model::AnchorCalibration& anchor =
        result.calibration.anchors.emplace_back(describe(site, i, covariance, result.fitted[i]));
    judge_anchor(site.evidence[i], anchor);
    result.ranges_used += anchor.ranges_used;
    result.ranges_rejected += anchor.ranges_rejected;
  }
  result.calibration.tags = tag_calibrations(site.error.body, site.association.tags);
  result.calibration.common_frame_covariance = site.error.frame_covariance;
  result.calibration.range_delay_s = site.error.range_delay_s;
  result.calibration.range_delay_sigma_s = site.error.range_delay_sigma_s;
  result.calibration.range_noise = range_noise(site.fits);
  result.calibration.verdict = judge_site(result.calibration.anchors);
  return result;
}

}  // namespace groma::calibration
