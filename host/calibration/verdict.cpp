#include "host/calibration/verdict.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <map>
#include <numbers>
#include <string>
#include <utility>

#include <Eigen/Eigenvalues>

#include "host/calibration/calibrate.hpp"
#include "host/calibration/site.hpp"

namespace groma::calibration {
namespace {

using model::AnchorVerdict;

// All limits of this file are by hand: no test or campaign determines them beyond those named here.
// The second with LOS states: ranges then come through obstacles.
constexpr double kWeakSigmaZ_m = 0.20;
constexpr double kNlosWeakSigmaZ_m = 0.15;
// Largest horizontal sigma of an anchor with more than this share of its ranges ignored: those that are left
// come from one side of an obstacle, and their errors are alike. Campaign `demo-anchors` (simulated): without
// it one of 212 anchors with verdict ok is off by 0.17 m.
constexpr double kHalfHidden = 0.25;
constexpr double kHalfHiddenWeakSigma_m = 0.05;
// Limits of the sigmas grow with the distance to the nearest antenna: a sixtieth of it, one degree.
constexpr double kWeakSigmaShare = 1.0 / 60.0;
// Without missed polls. The two ratios came with simulated/indoor (an independent simulator):
// RecordedRun.IndoorSimulationMarksAnchorsWithoutLineOfSight. No other reason is known.
constexpr double kMinLosShare = 0.3;
constexpr double kNlosScaleRatio = 1.2;
constexpr double kNlosCountRatio = 0.75;
// LOS share of the polls below which an anchor is never, or hardly ever, in LOS:
// NlosSite.MarksAnchorsWithoutLineOfSight.
constexpr double kNeverLos = 0.10;
constexpr double kHardlyLos = 0.30;
// Shares of ranges too long or too short for NLOS, above which the ranges contradict each other; above
// kTwoAnchors (both together) two anchors may have one id: NlosSite.OutliersAndCollisionsAreNotNlos,
// DuplicateId.IsNeverTrusted.
constexpr double kFarLimit = 0.06;
constexpr double kShortLimit = 0.03;
constexpr double kTwoAnchors = 0.4;
// A duplicate id: more ranges than the site's median, with more scatter from one to the next than noise:
// DuplicateId.IsNeverTrusted.
constexpr double kDuplicateFlicker = 2.5;
constexpr double kDuplicateCountRatio = 1.3;
constexpr double kHeldOutLimit = 3.0;  // times the predicted rms
// A longer move suggests a duplicate id: few anchors are carried this far while a robot drives by.
constexpr double kFarMove_m = 3.0;
constexpr std::ptrdiff_t kMinAnchors = 3;  // geometry: a position in the plane needs three ranges

// By hand. A MAD of 10 residuals (efficiency 0.37) has a relative sigma of 1/sqrt(2 * 10 * 0.37) = 0.37.
constexpr std::size_t kMinHeldOut = 10;
// A solution with a larger horizontal sigma does not predict new ranges: over such distances its
// linearization fails. By hand: over 0.5 m, spheres of 2.5 m depart from their tangent planes by 0.05 m.
constexpr double kOpenSigma_m = 0.5;
// Residuals beyond what short and long NLOS explain. By hand; NlosSite.OutliersAndCollisionsAreNotNlos and
// DuplicateId.IsNeverTrusted hold with them.
constexpr double kFar_m = 1.5;
constexpr double kShort_m = 0.3;
// An anchor that moves at least this far, to this close to another's place, has swapped ids with it.
// By hand; the SwappedIds tests hold with them.
constexpr double kJump_m = 2.0;
constexpr double kSamePlace_m = 0.5;

constexpr double kOctant_rad = 0.25 * std::numbers::pi;

// Octant of the direction from one point to the other, counterclockwise from +x: 0 to 7. From the drive's
// center to the anchor: the side that the drive covers least.
std::size_t octant_of(const Eigen::Vector3d& from_m, const Eigen::Vector3d& to_m) {
  const double angle_rad = std::atan2(to_m.y() - from_m.y(), to_m.x() - from_m.x());
  return static_cast<std::size_t>((std::lround(angle_rad / kOctant_rad) + 8) % 8);
}

std::string side_of(const Eigen::Vector3d& from_m, const Eigen::Vector3d& to_m) {
  static constexpr const char* kSides[] = {"+x", "+x+y", "+y", "-x+y", "-x", "-x-y", "-y", "+x-y"};
  return kSides[octant_of(from_m, to_m)];
}

std::string metres(double value_m) {
  char text[32];
  std::snprintf(text, sizeof text, "%.1f m", value_m);
  return text;
}

// How near to pass an anchor to improve the estimate.
double pass_m(const AnchorEvidence& evidence) {
  return std::max(2.0, std::min(3.0, 0.5 * evidence.nearest_m));
}

// Where to drive to improve the estimate: near the anchor, on its far side.
std::string drive_advice(const AnchorEvidence& evidence, const Eigen::Vector3d& anchor_m) {
  char place[48];
  std::snprintf(place, sizeof place, "(%.1f, %.1f)", anchor_m.x(), anchor_m.y());
  return "pass within " + metres(pass_m(evidence)) + " of " + place + ", on its " +
         side_of(evidence.spread.center_m, anchor_m) + " side, and turn there";
}

// The same place on the map.
Eigen::Vector2d place_to_pass(const AnchorEvidence& evidence, const Eigen::Vector3d& anchor_m) {
  const double angle_rad = kOctant_rad * static_cast<double>(octant_of(evidence.spread.center_m, anchor_m));
  return anchor_m.head<2>() + pass_m(evidence) * Eigen::Vector2d(std::cos(angle_rad), std::sin(angle_rad));
}

// A mirror hypothesis within this of the best solution's negative log likelihood cannot be ruled out: odds of
// 400 to 1, by hand. DegenerateDrive.InAStraightLineLeavesTheSideOpen and WithOneTagMarksHeights hold.
constexpr double kPlausibleExcess = 6.0;

bool is_plausible(const std::optional<MirrorHypothesis>& mirror, double inflation) {
  return mirror && mirror->cost_excess < kPlausibleExcess * inflation;
}

double mean_scale_m(const AnchorFit& fit) {
  double sum_m = 0.0;
  for (const RobustKernel& kernel : fit.kernels) sum_m += kernel.shape().scale_m;
  return sum_m / std::max<double>(1.0, static_cast<double>(fit.kernels.size()));
}

// Includes ranges that choose_measurements() left out.
double count_ranges(const AnchorObservations& data) {
  return static_cast<double>(data.rows.size() + data.left_out);
}

// Standard deviation of a range, m, from differences of consecutive residuals within kNext_s: NLOS that lasts
// longer does not count. Zero if there are none.
double flicker_m(std::span<const FittedRange> rows) {
  constexpr double kNext_s = 2.0;  // by hand: shorter than a short NLOS episode, some 3 s (los_chain.cpp)
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

// Another anchor whose place, at any time, this one took by one of its moves.
std::optional<model::NodeId> find_stand_in(const Site& site, std::size_t anchor) {
  const std::vector<Eigen::Vector3d>& places_m = site.evidence[anchor].path.places_m;
  for (std::size_t k = 1; k < places_m.size(); ++k) {
    if ((places_m[k] - places_m[k - 1]).norm() < kJump_m) continue;
    for (std::size_t other = 0; other < site.fits.size(); ++other) {
      if (other == anchor || site.fits[other].problem.rows.empty()) continue;
      std::vector<Eigen::Vector3d> others_m = site.evidence[other].path.places_m;
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

// Distances, LOS share and out-of-bounds residuals of one anchor's ranges.
void judge_rows(const Site& site, std::size_t i, std::span<const FittedRange> fitted, AnchorEvidence& out) {
  double judged = 0.0;
  double far = 0.0;
  double too_short = 0.0;
  if (!fitted.empty()) out.nearest_m = std::numeric_limits<double>::infinity();
  for (const FittedRange& row : fitted) {
    out.los_share += row.los;
    out.nearest_m = std::min(out.nearest_m, row.distance_m);
    if (row.is_ignored) continue;
    judged += 1.0;
    if (row.residual_m > kFar_m) far += 1.0;
    if (row.residual_m < -kShort_m) too_short += 1.0;
  }
  const double n = std::max(1.0, static_cast<double>(fitted.size()));
  out.los_share /= n;
  out.ignored_share = fitted.empty() ? 0.0 : 1.0 - judged / n;
  if (!site.has_los_states()) return;
  out.los_states = LosEvidence{.polls = site.los_states.poll_shares[i],
                               .counts_missed = site.polls.regular,
                               .excess_m = site.los_states.model.excess_prior.mean_m,
                               .far_share = far / std::max(1.0, judged),
                               .short_share = too_short / std::max(1.0, judged)};
}

struct Opinion {
  AnchorVerdict verdict = AnchorVerdict::kOk;
  std::string advice;
  bool says_where = false;  // to drive: drive_advice() is in it
};

std::string times_of(const AnchorPath& path) {
  std::string out;
  for (const double t_s : path.moved_at_s) {
    char text[32];
    std::snprintf(text, sizeof text, "%s%.0f", out.empty() ? "t_s = " : " and ", t_s);
    out += text;
  }
  return out;
}

// `is_placed`: the ranges after the last move determine where it is now.
Opinion judge_move(const AnchorEvidence& evidence, bool is_placed) {
  const AnchorPath& path = evidence.path;
  const std::string unplaced = is_placed ? "" : "; its later ranges do not determine its position well";
  if (evidence.stand_in) {
    const std::string where = "the place of anchor " + std::to_string(*evidence.stand_in);
    if ((path.places_m.back() - path.places_m.front()).norm() < kSamePlace_m) {
      return {AnchorVerdict::kWeak, "answered from " + where + " between " + times_of(path) +
                                        ": check whether their ids were swapped, and drive again" + unplaced};
    }
    return {AnchorVerdict::kMoved, "answers from " + where + " since about " + times_of(path) +
                                       ": check whether their ids are swapped, and drive again" + unplaced};
  }
  const char* request = path.last_move_m.norm() > kFarMove_m
                            ? "check that it is fixed and that no other has its id"
                            : "check that it is fixed";
  return {AnchorVerdict::kMoved, "was moved during the drive, about " + times_of(path) +
                                     (path.moved_at_s.size() > 1 ? ", last by " : ", by ") +
                                     metres(path.last_move_m.norm()) + " to its " +
                                     side_of(Eigen::Vector3d::Zero(), path.last_move_m) +
                                     " side: " + request + ", and drive again" + unplaced};
}

// Of an anchor whose position the ranges determine: whether they can.
std::optional<Opinion> judge_unsurveyed(const AnchorEvidence& evidence,
                                        const model::AnchorCalibration& anchor) {
  const std::string where = drive_advice(evidence, anchor.position_m);
  if (is_hardly_los(evidence))
    return Opinion{AnchorVerdict::kWeak, "hardly ever in line of sight: " + where, true};
  if (contradicts_itself(evidence)) {
    if (evidence.los_states->far_share + evidence.los_states->short_share > kTwoAnchors) {
      return Opinion{
          AnchorVerdict::kWeak,
          "most of its ranges contradict the others: check whether two anchors have this id; else " + where,
          true};
    }
    return Opinion{AnchorVerdict::kWeak, "its ranges contradict each other, as reflections do: " + where,
                   true};
  }
  return std::nullopt;
}

// Of an anchor whose position is known: whether its ranges contradict that. Reflections only lengthen them.
std::optional<Opinion> judge_survey(const AnchorEvidence& evidence) {
  if (!evidence.los_states || !(evidence.los_states->short_share > kShortLimit)) return std::nullopt;
  return Opinion{
      AnchorVerdict::kWeak,
      "its ranges are too short for its surveyed position: check that position, and whether two anchors "
      "have this id"};
}

// From number and quality of the ranges; none if these are in order.
std::optional<Opinion> judge_ranges(const AnchorEvidence& evidence, const model::AnchorCalibration& anchor) {
  const std::size_t all = anchor.ranges_used + anchor.ranges_rejected;
  const bool never_los = evidence.rows >= kMinRanges && is_never_los(evidence);
  if (anchor.ranges_used < kMinRanges && !never_los) {
    return Opinion{AnchorVerdict::kNoData,
                   all == 0 ? "no range at all: check that the anchor is powered and in the schedule"
                            : "too few ranges with a pose: drive where this anchor answers"};
  }
  if (never_los) {
    return Opinion{AnchorVerdict::kNeverLos,
                   "its line of sight is nearly always blocked: drive where it is clear, or move it"};
  }
  if (evidence.path.duplicate_m) {
    return Opinion{AnchorVerdict::kWeak, "answers from two places, " +
                                             metres((*evidence.path.duplicate_m - anchor.position_m).norm()) +
                                             " apart: check whether two anchors have this id"};
  }
  std::optional<Opinion> opinion =
      evidence.surveyed ? judge_survey(evidence) : judge_unsurveyed(evidence, anchor);
  if (opinion) return opinion;
  if (evidence.flicker > kDuplicateFlicker && evidence.count_ratio > kDuplicateCountRatio) {
    return Opinion{AnchorVerdict::kWeak,
                   "its ranges differ from one to the next: check whether two anchors answer to this id"};
  }
  return std::nullopt;
}

Opinion judge_position(const AnchorEvidence& evidence, const model::AnchorCalibration& anchor) {
  const Eigen::Matrix3d covariance = anchor.covariance.topLeftCorner<3, 3>();
  const double by_distance_m = kWeakSigmaShare * evidence.nearest_m;
  const double sigma_xy_m = horizontal_sigma_m(covariance);
  const double sigma_z_m = std::sqrt(std::max(0.0, covariance(2, 2)));
  const std::string advice = drive_advice(evidence, anchor.position_m);
  const double weak_sigma_m =
      evidence.ignored_share > kHalfHidden ? kHalfHiddenWeakSigma_m : std::max(kWeakSigma_m, by_distance_m);
  if (sigma_xy_m > weak_sigma_m || is_plausible(evidence.side, evidence.inflation)) {
    return {AnchorVerdict::kWeak, advice, true};
  }
  // Reflections at the end of the drive say nothing against a survey.
  const bool is_reflected = evidence.surveyed && contradicts_itself(evidence);
  if (!is_reflected && evidence.held_out.share_of_scale.value_or(0.0) > kHeldOutLimit) {
    return {AnchorVerdict::kWeak,
            "the end of the drive contradicts its beginning: drive again, and check whether it was moved"};
  }
  if (is_plausible(evidence.mirror, evidence.inflation)) {
    return {AnchorVerdict::kWeakZ, "it may be above or below the tags: measure its height, or " + advice,
            true};
  }
  if (sigma_z_m > std::max(evidence.los_states ? kNlosWeakSigmaZ_m : kWeakSigmaZ_m, by_distance_m)) {
    return {AnchorVerdict::kWeakZ, "height uncertain: " + advice, true};
  }
  return {};
}

}  // namespace

HeldOut score_held_out(const AnchorFit& first, std::span<const Observation> later) {
  std::vector<double> absolute_m;
  double square_m2 = 0.0;
  double scale_m = 0.0;
  const Eigen::MatrixXd covariance = first.problem.position.surveyed
                                         ? anchor_covariance(gather_evidence(first), 1.0)
                                         : rough_covariance(first);
  for (const Observation& row : later) {
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

std::vector<FittedRange> fitted_ranges(const AnchorFit& fit, std::span<const model::Tag> tags) {
  std::vector<FittedRange> out;
  out.reserve(fit.problem.rows.size());
  for (const Observation& row : fit.problem.rows) {
    const RowAt at = row_at(fit, row);
    out.push_back(
        {.t_s = row.t_s,
         .tag_id = tags[row.tag].id,
         .antenna_m = row.tag_m.head<2>(),
         .distance_m = at.predicted.distance_m,
         .residual_m = at.residual_m,
         .los = fit.kernels[row.tag].shares(at.noise_share * at.residual_m).los() * at.value.los_count,
         .is_ignored =
             fit.problem.los_states != nullptr && is_ignored(fit.problem.los_states->rows[row.index])});
  }
  return out;
}

void gather_anchor_evidence(Site& site, std::span<const std::vector<FittedRange>> fitted) {
  // Medians over the anchors that have ranges.
  std::vector<double> scales_m;
  std::vector<double> ranges;
  for (std::size_t i = 0; i < site.fits.size(); ++i) {
    if (site.fits[i].problem.rows.empty()) continue;
    scales_m.push_back(mean_scale_m(site.fits[i]));
    ranges.push_back(count_ranges(site.association.anchors[i]));
  }
  const double typical_scale_m = median(std::move(scales_m));
  const double typical_ranges = median(std::move(ranges));
  for (std::size_t i = 0; i < site.fits.size(); ++i) {
    AnchorEvidence& out = site.evidence[i];
    out.inflation = site.fits[i].inflation;
    out.stand_in = find_stand_in(site, i);
    out.surveyed = site.fits[i].problem.position.surveyed;
    out.rows = site.fits[i].problem.rows.size();
    judge_rows(site, i, fitted[i], out);
    if (typical_scale_m > 0.0) {
      out.flicker = flicker_m(fitted[i]) / typical_scale_m;
      out.scale_ratio = mean_scale_m(site.fits[i]) / typical_scale_m;
    }
    if (typical_ranges > 0.0) out.count_ratio = count_ranges(site.association.anchors[i]) / typical_ranges;
  }
}

double horizontal_sigma_m(const Eigen::Matrix3d& covariance_m2) {
  return std::sqrt(
      std::max(0.0, covariance_m2.topLeftCorner<2, 2>().selfadjointView<Eigen::Lower>().eigenvalues()(1)));
}

bool is_hardly_los(const AnchorEvidence& evidence) noexcept {
  return evidence.los_states && evidence.los_states->counts_missed &&
         evidence.los_states->polls(kLos) < kHardlyLos;
}

bool contradicts_itself(const AnchorEvidence& evidence) noexcept {
  return evidence.los_states &&
         (evidence.los_states->far_share > kFarLimit || evidence.los_states->short_share > kShortLimit);
}

bool is_never_los(const AnchorEvidence& evidence) noexcept {
  if (evidence.los_states && evidence.los_states->counts_missed) {
    return evidence.los_states->polls(kLos) < kNeverLos;
  }
  if (evidence.los_share < kMinLosShare) return true;
  return evidence.scale_ratio > kNlosScaleRatio && evidence.count_ratio < kNlosCountRatio;
}

void judge_anchor(const AnchorEvidence& evidence, model::AnchorCalibration& anchor) {
  std::optional<Opinion> opinion;
  if (evidence.path.has_moved()) {
    AnchorEvidence since = evidence;
    since.path.moved_at_s.clear();
    since.held_out.share_of_scale.reset();
    judge_anchor(since, anchor);
    if (anchor.verdict == AnchorVerdict::kNoData) return;
    opinion = judge_move(evidence, model::is_usable(anchor.verdict));
  } else {
    opinion = judge_ranges(evidence, anchor);
    if (!opinion) opinion = judge_position(evidence, anchor);
  }
  anchor.verdict = opinion->verdict;
  anchor.advice = std::move(opinion->advice);
  anchor.drive_to_m.reset();
  if (opinion->says_where) anchor.drive_to_m = place_to_pass(evidence, anchor.position_m);
}

model::Verdict judge_site(std::span<const model::AnchorCalibration> anchors) {
  const auto good = std::count_if(anchors.begin(), anchors.end(), [](const model::AnchorCalibration& anchor) {
    return model::is_usable(anchor.verdict);
  });
  if (good == 0) return model::Verdict::kUnusable;
  const bool all_ok = std::all_of(anchors.begin(), anchors.end(), [](const model::AnchorCalibration& anchor) {
    return anchor.verdict == AnchorVerdict::kOk;
  });
  return all_ok && good >= kMinAnchors ? model::Verdict::kUsable : model::Verdict::kWarnings;
}

}  // namespace groma::calibration
