#include "host/calibration/calibrate.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <numbers>
#include <numeric>
#include <utility>

#include "host/calibration/anchor_links.hpp"
#include "host/calibration/association.hpp"
#include "host/calibration/comparison.hpp"
#include "host/calibration/drive_error.hpp"
#include "host/calibration/moved.hpp"
#include "host/calibration/robust_kernel.hpp"
#include "host/calibration/sight_solver.hpp"
#include "host/calibration/site_solver.hpp"
#include "host/calibration/uncertainty.hpp"
#include "host/calibration/verdict.hpp"
#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// Poses whose height differs from the ground's by more than this are tried at both heights.
constexpr double kHeightDisagreement_m = 0.1;
constexpr double kHeldOutShare = 0.2;
constexpr std::size_t kMinHeldOut = 10;
// A solution that leaves the plane open by more than this says nothing of ranges that it has not seen: over
// such ways spheres leave their tangents.
constexpr double kOpenSigma_m = 0.5;
// An anchor is not further off than so many times its nearest range.
constexpr double kReachFactor = 2.0;
// Where the score scatters so much more than independent residuals make it, parts of the drive are set
// against each other.
constexpr double kHangingTogether = 1.5;
// Square sigmas between the heights by the drive's beginning and by all of it: chi square with one degree of
// freedom, 99.9 %.
constexpr double kHeightChiSquare = 10.8;
// Poses may be off by so much an axis where moves are looked for.
constexpr double kMovePose_m = 0.5 * kMinMove_m;
// Residuals that neither a wall nor a shadow makes.
constexpr double kFar_m = 1.5;
constexpr double kShort_m = 0.3;
// At most, from where every anchor is on its better side until all of them rest.
constexpr int kLastRounds = 10;

model::RangePriors usable_priors(const model::RangePriors& given) {
  const model::RangePriors fallback;
  const auto sigma = [](double value, double instead) {
    return std::max(std::isfinite(value) && value > 0.0 ? value : instead, 1e-6);
  };
  const auto usable = [&](const model::ScalarPrior& prior, const model::ScalarPrior& instead) {
    return model::ScalarPrior{std::isfinite(prior.mean) ? prior.mean : instead.mean,
                              sigma(prior.sigma, instead.sigma)};
  };
  model::RangePriors out{.sigma_m = std::max(sigma(given.sigma_m, fallback.sigma_m), 1e-3),
                         .beta_m = usable(given.beta_m, fallback.beta_m),
                         .gamma = usable(given.gamma, fallback.gamma)};
  if (!(out.gamma.mean > 0.1)) out.gamma.mean = fallback.gamma.mean;
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

struct HeldOut {
  std::optional<double> rms_m;
  std::optional<double> robust_rms_m;
  std::optional<double> share_of_scale;  // robust rms over what the fit expects; none where it cannot tell
  double height_variance_m2 = std::numeric_limits<double>::infinity();  // that the fit expects
};

// Residuals count by what the first solution can tell of them: of where the robot had not been till then, not
// much.
HeldOut score_held_out(const AnchorFit& first, std::span<const Observation> rows, double from_s) {
  std::vector<double> absolute_m;
  double square_m2 = 0.0;
  double scale_m = 0.0;
  const Eigen::MatrixXd covariance = first.problem.position.surveyed
                                         ? anchor_covariance(gather_evidence(first), 1.0)
                                         : rough_covariance(first);
  for (const Observation& row : rows) {
    if (row.t_s <= from_s) continue;
    const RowAt at = row_at(first, row);
    square_m2 += at.residual_m * at.residual_m;
    const double noise_m = first.kernels[row.tag].shape().scale_m / at.noise_share;
    scale_m += std::hypot(noise_m, prediction_sigma_m(at.j, row.tag, covariance));
    absolute_m.push_back(std::abs(at.residual_m));
  }
  HeldOut out;
  if (absolute_m.size() < kMinHeldOut) return out;
  const double n = static_cast<double>(absolute_m.size());
  out.rms_m = std::sqrt(square_m2 / n);
  out.robust_rms_m = kSigmaOfMad * median(std::move(absolute_m));
  if (covariance.topLeftCorner<2, 2>().trace() < kOpenSigma_m * kOpenSigma_m) {
    out.share_of_scale = *out.robust_rms_m / (scale_m / n);
    out.height_variance_m2 = covariance(2, 2);
  }
  return out;
}

double mean_scale_m(const AnchorFit& fit) {
  double sum_m = 0.0;
  for (const RobustKernel& kernel : fit.kernels) sum_m += kernel.shape().scale_m;
  return sum_m / std::max<double>(1.0, static_cast<double>(fit.kernels.size()));
}

std::vector<FittedRange> look_at_rows(const AnchorFit& fit, std::span<const model::Tag> tags) {
  std::vector<FittedRange> out;
  out.reserve(fit.problem.rows.size());
  for (const Observation& row : fit.problem.rows) {
    const RowAt at = row_at(fit, row);
    out.push_back({.t_s = row.t_s,
                   .tag_id = tags[row.tag].id,
                   .antenna_m = row.tag_m.head<2>(),
                   .distance_m = at.predicted.distance_m,
                   .residual_m = at.residual_m,
                   .in_sight = fit.kernels[row.tag].shares(at.noise_share * at.residual_m).in_sight() *
                               at.value.seen_share});
  }
  return out;
}

// Standard deviation of a range, from the differences of residuals that follow each other within kNext_s:
// what blocks a range for longer is not in it. Zero where there are none.
double flicker_m(std::span<const FittedRange> rows) {
  constexpr double kNext_s = 2.0;
  std::map<model::NodeId, const FittedRange*> before;
  std::vector<double> differences_m;
  for (const FittedRange& row : rows) {
    const FittedRange*& last = before[row.tag_id];
    if (last != nullptr && row.t_s - last->t_s < kNext_s) {
      differences_m.push_back(std::abs(row.residual_m - last->residual_m));
    }
    last = &row;
  }
  return kSigmaOfMad * median(std::move(differences_m)) / std::numbers::sqrt2;
}

// Where the information hardly sees a direction, as z of an anchor at the tags' own height, the covariance
// goes on for ever; but no anchor is further off than its ranges are long. As one more observation of where
// it is, with that sigma an axis.
void stay_within(double sigma_m, Eigen::MatrixXd& covariance) {
  if (model::is_ablated(model::Mechanism::kCalibrationReach)) return;
  const Eigen::Matrix3d sum =
      covariance.topLeftCorner<3, 3>() + sigma_m * sigma_m * Eigen::Matrix3d::Identity();
  const Eigen::MatrixXd by_position = covariance.leftCols<3>();
  const Eigen::MatrixXd less = by_position * sum.ldlt().solve(by_position.transpose());
  if (less.allFinite()) covariance -= 0.5 * (less + less.transpose());
}

// The first part of the drive by itself gave another height than all of it: where they contradict each other,
// either may be as wrong as they are apart.
void admit_shift(double shift_m, double first_variance_m2, Eigen::MatrixXd& covariance) {
  if (model::is_ablated(model::Mechanism::kCalibrationShift)) return;
  const double variance_m2 = std::max(2.0 * covariance(2, 2), first_variance_m2);
  if (shift_m * shift_m > kHeightChiSquare * variance_m2) covariance(2, 2) += shift_m * shift_m;
}

// Whether the one is about as far below the tags as the other is above: what decides between sides tells so.
bool is_mirrored(const AnchorFit& first, const AnchorFit& whole, const TagSpread& spread) {
  const double tags_m = spread.center_m.z();
  const double mirrored_m = 2.0 * tags_m - whole.anchor(2);
  return std::abs(first.anchor(2) - mirrored_m) < 0.5 * std::abs(mirrored_m - whole.anchor(2));
}

std::vector<model::PairBias> pair_biases(const AnchorVector& anchor, const Eigen::MatrixXd& covariance,
                                         std::span<const model::Tag> tags) {
  std::vector<model::PairBias> out;
  for (std::size_t tag = 0; tag < tags.size(); ++tag) {
    const Eigen::Index beta = beta_index(tag);
    const Eigen::Index gamma = gamma_index(tag, tags.size());
    out.push_back({.tag_id = tags[tag].id,
                   .beta_m = anchor(beta),
                   .beta_sigma_m = std::sqrt(covariance(beta, beta)),
                   .gamma = anchor(gamma),
                   .gamma_sigma = std::sqrt(covariance(gamma, gamma))});
  }
  return out;
}

// A lever arm is told where it is known so much better than by hand.
constexpr double kRefinedShare = 0.5;

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

// The drive solved twice: its beginning for the verdict, and all of it.
struct Site {
  Association association;
  double held_out_from_s = 0.0;
  std::vector<AnchorFit> beginning;
  std::vector<AnchorFit> fits;
  SiteSight sight;
  PollTable polls;
  std::vector<AnchorPath> paths;         // of each anchor
  std::vector<AnchorEvidence> evidence;  // of each anchor
  std::vector<HeldOut> held_out;         // of each anchor
  DriveError error;
};

// What the poses of two drives can be off by, beside what the earlier calibration tells of its own.
constexpr double kFrameSigma_m = 0.1;

// None where it has none; a height that is not trusted decides nothing.
std::optional<EarlierPlace> earlier_place(const model::Calibration& earlier, model::NodeId id) {
  const model::AnchorCalibration* anchor = model::find_anchor(earlier, id);
  if (anchor == nullptr || !model::has_position(*anchor)) return std::nullopt;
  EarlierPlace out{.position_m = anchor->position_m,
                   .covariance_m2 = anchor->covariance.topLeftCorner<3, 3>()};
  out.covariance_m2.diagonal().array() += kFrameSigma_m * kFrameSigma_m;
  if (anchor->verdict != model::AnchorVerdict::kOk) out.covariance_m2(2, 2) += kWeakHeight_m * kWeakHeight_m;
  return out;
}

// Both other sides of each anchor, the fit moved where one is better; and what else its rows tell.
void explore(Site& site, const model::Calibration* earlier) {
  for (std::size_t i = 0; i < site.fits.size(); ++i) {
    AnchorFit& fit = site.fits[i];
    AnchorEvidence& evidence = site.evidence.emplace_back();
    if (fit.problem.rows.empty()) continue;
    evidence.spread = tag_spread(fit.problem.rows);
    if (fit.problem.position.surveyed) continue;
    // Where it was moved meanwhile, its earlier place is not that of the rows.
    std::optional<EarlierPlace> place;
    if (earlier != nullptr && site.paths[i].moved_at_s.empty()) {
      place = earlier_place(*earlier, site.association.anchors[i].id);
    }
    for (const auto& [axis, rival] :
         {std::pair{kAcrossLine, &evidence.side}, {kAcrossPlane, &evidence.mirror}}) {
      *rival = challenge(fit, evidence.spread, axis);
      if (!place) continue;
      const std::vector<Evidence> alone{gather_evidence(fit)};
      weigh_by_earlier(*place, score_inflation(alone).front(), fit, **rival);
    }
  }
}

// Poses that say of themselves that they may be off by as much as a move is long show none.
bool poses_show_moves(const Association& association) {
  if (model::is_ablated(model::Mechanism::kCalibrationMoves)) return false;
  return std::all_of(
      association.pose_spreads.begin(), association.pose_spreads.end(), [](const PoseSpread& spread) {
        return spread.covariance.topLeftCorner<2, 2>().trace() < 2.0 * kMovePose_m * kMovePose_m;
      });
}

void find_sight(Site& site) {
  if (!is_sight_wanted(site.polls, site.fits)) return;
  site.sight = solve_sight(site.polls, first_sight_model(site.polls, site.fits), site.fits);
}

Site solve_at_height(const Drive& drive, const Options& options, HeightSource height, bool find_moves) {
  Site site;
  site.association = associate(drive, height);
  SiteProblem problem{.association = &site.association,
                      .priors = usable_priors(drive.priors),
                      .known_anchors = drive.known_anchors};
  site.polls = tabulate_polls(site.association);
  bound_rows(site.association, site.polls, problem, options.most_anchor_ranges);
  site.held_out_from_s = held_out_from(site.association);
  problem.end_s = site.held_out_from_s;
  site.beginning = solve_site(problem, {});
  problem.end_s = std::numeric_limits<double>::infinity();
  site.fits = solve_site(problem, site.beginning);
  site.paths.resize(site.fits.size());
  if (is_within_reach(site.fits)) {
    find_sight(site);
    if (find_moves && poses_show_moves(site.association))
      site.paths = find_moved(site.polls, site.sight, site.fits);
  }
  explore(site, options.earlier);
  refine_site(site.fits, kLastRounds);
  return site;
}

bool has_moves(const Site& site) {
  return std::any_of(site.paths.begin(), site.paths.end(),
                     [](const AnchorPath& path) { return !path.moved_at_s.empty(); });
}

void look_again(Site& site, const model::Calibration* earlier) {
  if (!is_within_reach(site.fits) || has_moves(site)) return;
  if (model::is_ablated(model::Mechanism::kCalibrationAgain)) return;
  for (AnchorFit& fit : site.fits) {
    fit.problem.sight = nullptr;
    fit.anchor.conservativeResize(wall_index(fit.problem.tag_count));
  }
  site.sight = {};
  refine_site(site.fits, kLastRounds);
  find_sight(site);
  site.evidence.clear();
  explore(site, earlier);
  refine_site(site.fits, kLastRounds);
}

// The robot's height is its own or that of the ground: whichever explains the ranges better.
Site solve_at_best_height(const Drive& drive, const Options& options, bool find_moves) {
  Site site = solve_at_height(drive, options, HeightSource::kPose, find_moves);
  if (height_disagreement_m(drive) < kHeightDisagreement_m) return site;
  if (model::is_ablated(model::Mechanism::kCalibrationHeights)) return site;
  Site other = solve_at_height(drive, options, HeightSource::kSurface, find_moves);
  const auto cost = [](const Site& of) {
    return std::accumulate(of.fits.begin(), of.fits.end(), 0.0,
                           [](double sum, const AnchorFit& fit) { return sum + fit.cost; });
  };
  return cost(other) < cost(site) ? std::move(other) : std::move(site);
}

Site solve_drive(const Drive& drive, const Options& options, bool find_moves) {
  Site site = solve_at_best_height(drive, options, find_moves);
  // Before the poses are corrected by all ranges: what is held out stays so.
  for (std::size_t i = 0; i < site.fits.size(); ++i) {
    site.held_out.push_back(
        score_held_out(site.beginning[i], site.association.anchors[i].rows, site.held_out_from_s));
  }
  site.error = correct_drive(site.association, site.fits);
  return site;
}

// An anchor that goes so far and ends so near to another's place has its id.
constexpr double kJump_m = 2.0;
constexpr double kSamePlace_m = 0.5;

// The other anchor that was, or is, where this one has been since one of its moves.
std::optional<model::NodeId> find_stand_in(const Site& site, std::size_t anchor) {
  const std::vector<Eigen::Vector3d>& places_m = site.paths[anchor].places_m;
  for (std::size_t k = 1; k < places_m.size(); ++k) {
    if ((places_m[k] - places_m[k - 1]).norm() < kJump_m) continue;
    for (std::size_t other = 0; other < site.fits.size(); ++other) {
      if (other == anchor || site.fits[other].problem.rows.empty()) continue;
      std::vector<Eigen::Vector3d> others_m = site.paths[other].places_m;
      others_m.emplace_back(site.fits[other].anchor.head<3>());
      if (std::any_of(others_m.begin(), others_m.end(), [&](const Eigen::Vector3d& other_m) {
            return (other_m - places_m[k]).norm() < kSamePlace_m;
          })) {
        return site.association.anchors[other].id;
      }
    }
  }
  return std::nullopt;
}

std::optional<MoveEvidence> tell_moves(const Site& site, std::size_t anchor) {
  const AnchorPath& path = site.paths[anchor];
  if (path.moved_at_s.empty()) return std::nullopt;
  MoveEvidence out{.at_s = path.moved_at_s, .by_m = path.last_move_m};
  out.is_back = (path.places_m.back() - path.places_m.front()).norm() < kSamePlace_m;
  out.stand_in = find_stand_in(site, anchor);
  return out;
}

// With the survey's ranges between anchors, where there are any: moves the fits and their rivals.
std::vector<Eigen::MatrixXd> join_survey(const Drive& drive, Site& site, std::span<const double> inflation) {
  std::vector<model::NodeId> ids;
  for (const AnchorObservations& anchor : site.association.anchors) ids.push_back(anchor.id);
  const model::RangePriors priors = usable_priors(drive.priors);
  return join_links({site.fits, inflation, site.evidence, site.error},
                    gather_links(drive.anchor_ranges, ids, priors), priors);
}

// Those that were not chosen count too.
double count_ranges(const AnchorObservations& data) {
  return static_cast<double>(data.rows.size() + data.left_out);
}

// Medians of the anchors that have ranges.
struct Typical {
  double scale_m = 0.0;
  double ranges = 0.0;
};

Typical typical_anchor(const Site& site) {
  std::vector<double> scales_m;
  std::vector<double> ranges;
  for (std::size_t i = 0; i < site.fits.size(); ++i) {
    if (site.fits[i].problem.rows.empty()) continue;
    scales_m.push_back(mean_scale_m(site.fits[i]));
    ranges.push_back(count_ranges(site.association.anchors[i]));
  }
  return {.scale_m = median(std::move(scales_m)), .ranges = median(std::move(ranges))};
}

// Of one anchor, what its ranges say beside the solution.
void complete_evidence(const Site& site, std::size_t i, std::span<const FittedRange> fitted,
                       const Typical& typical, AnchorEvidence& out) {
  const AnchorFit& fit = site.fits[i];
  out.moved = tell_moves(site, i);
  out.twin_m = site.paths[i].twin_m;
  out.rows = fit.problem.rows.size();
  out.held_out_z = site.held_out[i].share_of_scale;
  double far = 0.0;
  double too_short = 0.0;
  if (!fitted.empty()) out.nearest_m = std::numeric_limits<double>::infinity();
  for (const FittedRange& row : fitted) {
    out.in_sight_share += row.in_sight;
    out.nearest_m = std::min(out.nearest_m, row.distance_m);
    if (row.residual_m > kFar_m) far += 1.0;
    if (row.residual_m < -kShort_m) too_short += 1.0;
  }
  const double n = std::max(1.0, static_cast<double>(fitted.size()));
  out.in_sight_share /= n;
  if (!site.sight.anchors.empty()) {
    out.sight = SightEvidence{.polls = site.sight.poll_shares[i],
                              .polls_are_told = site.polls.regular,
                              .wall_excess_m = site.sight.model.wall_prior.mean_m,
                              .far_share = far / n,
                              .short_share = too_short / n};
  }
  if (typical.scale_m > 0.0) {
    out.flicker = flicker_m(fitted) / typical.scale_m;
    out.scale_ratio = mean_scale_m(fit) / typical.scale_m;
  }
  if (typical.ranges > 0.0) out.count_ratio = count_ranges(site.association.anchors[i]) / typical.ranges;
}

// Of one anchor, `solved` with all that may be wrong beside it.
Eigen::MatrixXd widened_covariance(const Site& site, std::size_t i, const Eigen::MatrixXd& solved) {
  const AnchorFit& fit = site.fits[i];
  const AnchorEvidence& known = site.evidence[i];
  const std::size_t tags = fit.problem.tag_count;
  // The excess of walls is no part of the anchor.
  const Eigen::Index size = wall_index(tags);
  Eigen::MatrixXd out = solved.topLeftCorner(size, size);
  if (!site.sight.anchors.empty() || known.inflation > kHangingTogether) {
    if (const std::optional<Eigen::Matrix3d> jackknife = jackknife_covariance(fit)) {
      out += excess_of_jackknife(
          *jackknife, anchor_covariance(site.error.evidence[i], known.inflation).topLeftCorner(size, size));
    }
  }
  if (!fit.problem.rows.empty() && !fit.problem.position.surveyed)
    stay_within(kReachFactor * known.nearest_m, out);
  admit_blocking(known, tags, out);
  for (const std::optional<Rival>& rival : {known.mirror, known.side}) {
    if (rival) out.topLeftCorner<3, 3>() += rival_spread(*rival, fit, known.inflation);
  }
  const AnchorFit& first = site.beginning[i];
  if (site.sight.anchors.empty() && !known.moved && !fit.problem.position.surveyed &&
      2 * first.problem.rows.size() > fit.problem.rows.size() && !is_mirrored(first, fit, known.spread)) {
    admit_shift(fit.anchor(2) - first.anchor(2), site.held_out[i].height_variance_m2, out);
  }
  return out;
}

}  // namespace

Result calibrate(const Drive& drive, const Options& options) {
  Site site = solve_drive(drive, options, true);
  // Where the poses drift by as much as a move is long, anchors that seem to have moved have not.
  if (has_moves(site) && site.error.prior.wander.sigma_m > kMovePose_m)
    site = solve_drive(drive, options, false);
  DriveError& drive_error = site.error;
  if (!drive_error.body.empty() && !site.sight.anchors.empty()) {
    look_again(site, options.earlier);
    correct_further(site.association, site.fits, drive_error);
  }
  const std::vector<double> inflation = score_inflation(drive_error.evidence);
  const std::vector<Eigen::MatrixXd> covariance = join_survey(drive, site, inflation);
  const Typical typical = typical_anchor(site);

  Result result;
  const std::vector<model::Tag>& tags = site.association.tags;
  for (std::size_t i = 0; i < site.fits.size(); ++i) {
    const AnchorFit& fit = site.fits[i];
    const AnchorObservations& data = site.association.anchors[i];
    const std::vector<FittedRange>& fitted = result.fitted.emplace_back(look_at_rows(fit, tags));
    AnchorEvidence& known = site.evidence[i];
    known.inflation = inflation[i];
    complete_evidence(site, i, fitted, typical, known);

    model::AnchorCalibration& anchor = result.calibration.anchors.emplace_back();
    anchor.id = data.id;
    anchor.position_m = fit.anchor.head<3>();
    anchor.covariance = widened_covariance(site, i, covariance[i]);
    model::add_common_frame(anchor, drive_error.unseen_frame_covariance);
    anchor.pairs = pair_biases(fit.anchor, anchor.covariance, tags);
    // Ranges before the last move count as rejected, and those that are likelier NLOS than LOS.
    anchor.ranges_used = static_cast<std::size_t>(std::count_if(
        fitted.begin(), fitted.end(), [](const FittedRange& row) { return !(row.in_sight < 0.5); }));
    anchor.ranges_rejected = data.rejected + data.rows.size() - anchor.ranges_used;
    if (known.mirror) anchor.mirror_ratio = known.mirror->cost_ratio;
    anchor.held_out_rms_m = site.held_out[i].rms_m;
    anchor.held_out_robust_rms_m = site.held_out[i].robust_rms_m;
    judge_anchor(known, anchor);
    result.ranges_used += anchor.ranges_used;
    result.ranges_rejected += anchor.ranges_rejected;
  }
  result.calibration.tags = tag_calibrations(drive_error.body, tags);
  result.calibration.common_frame_covariance = drive_error.frame_covariance;
  result.calibration.range_delay_s = drive_error.range_delay_s;
  result.calibration.range_delay_sigma_s = drive_error.range_delay_sigma_s;
  result.calibration.range_noise = range_noise(site.fits);
  result.calibration.verdict = judge_site(result.calibration.anchors);
  return result;
}

}  // namespace groma::calibration
