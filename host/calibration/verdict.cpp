#include "host/calibration/verdict.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <numbers>
#include <string>
#include <utility>

#include <Eigen/Eigenvalues>

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

struct Opinion {
  AnchorVerdict verdict = AnchorVerdict::kOk;
  std::string advice;
  bool says_where = false;  // to drive: drive_advice() is in it
};

std::string times_of(const MoveEvidence& moved) {
  std::string out;
  for (const double t_s : moved.at_s) {
    char text[32];
    std::snprintf(text, sizeof text, "%s%.0f", out.empty() ? "t_s = " : " and ", t_s);
    out += text;
  }
  return out;
}

// `is_placed`: the ranges after the last move determine where it is now.
Opinion judge_move(const MoveEvidence& moved, bool is_placed) {
  const std::string unplaced = is_placed ? "" : "; its later ranges do not determine its position well";
  if (moved.stand_in) {
    const std::string where = "the place of anchor " + std::to_string(*moved.stand_in);
    if (moved.is_back) {
      return {AnchorVerdict::kWeak, "answered from " + where + " between " + times_of(moved) +
                                        ": check whether their ids were swapped, and drive again" + unplaced};
    }
    return {AnchorVerdict::kMoved, "answers from " + where + " since about " + times_of(moved) +
                                       ": check whether their ids are swapped, and drive again" + unplaced};
  }
  const char* request = moved.by_m.norm() > kFarMove_m ? "check that it is fixed and that no other has its id"
                                                       : "check that it is fixed";
  return {AnchorVerdict::kMoved, "was moved during the drive, about " + times_of(moved) +
                                     (moved.at_s.size() > 1 ? ", last by " : ", by ") +
                                     metres(moved.by_m.norm()) + " to its " +
                                     side_of(Eigen::Vector3d::Zero(), moved.by_m) + " side: " + request +
                                     ", and drive again" + unplaced};
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
  if (evidence.duplicate_m) {
    return Opinion{AnchorVerdict::kWeak, "answers from two places, " +
                                             metres((*evidence.duplicate_m - anchor.position_m).norm()) +
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
  if (evidence.moved) {
    AnchorEvidence since = evidence;
    since.moved.reset();
    since.held_out.share_of_scale.reset();
    judge_anchor(since, anchor);
    if (anchor.verdict == AnchorVerdict::kNoData) return;
    opinion = judge_move(*evidence.moved, model::is_usable(anchor.verdict));
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
