#include "host/calibration/verdict.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <numbers>
#include <string>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

namespace groma::calibration {
namespace {

using model::AnchorVerdict;

constexpr std::size_t kMinRanges = 30;
// Sigmas that a filter can live with; beyond them the position is a hint and no more.
constexpr double kWeakSigma_m = 0.30;
// Sigmas also grow with the site: a sixtieth of the distance at which the anchor is used.
constexpr double kWeakSigmaShare = 1.0 / 60.0;
constexpr double kMinInSightShare = 0.3;
constexpr double kBlockedScaleRatio = 1.2;
constexpr double kBlockedCountRatio = 0.75;
// Excess that walls between an anchor and all of a drive share, and how it differs from place to place.
constexpr double kWallSigma_m = 0.5;
constexpr double kWallVariation_m = 0.25;
constexpr double kHeldOutLimit = 3.0;
constexpr std::size_t kMinAnchors = 3;

// The compass side on which the anchor sees the drive least: towards it, but never there.
std::string side_of(const Eigen::Vector3d& from_m, const Eigen::Vector3d& to_m) {
  static constexpr const char* kSides[] = {"+x", "+x+y", "+y", "-x+y", "-x", "-x-y", "-y", "+x-y"};
  const double angle_rad = std::atan2(to_m.y() - from_m.y(), to_m.x() - from_m.x());
  const long octant = std::lround(angle_rad / (0.25 * std::numbers::pi));
  return kSides[static_cast<std::size_t>((octant + 8) % 8)];
}

std::string metres(double value_m) {
  char text[32];
  std::snprintf(text, sizeof text, "%.1f m", value_m);
  return text;
}

// Where to drive to learn what is missing: near the anchor, and around it.
std::string drive_advice(const AnchorEvidence& evidence, const Eigen::Vector3d& anchor_m) {
  const double pass_m = std::max(2.0, std::min(3.0, 0.5 * evidence.nearest_m));
  return "pass within " + metres(pass_m) + " on its " + side_of(evidence.spread.center_m, anchor_m) +
         " side and turn there";
}

// Rivals within this of the best solution's negative log likelihood cannot be ruled out.
constexpr double kPlausibleExcess = 6.0;

bool is_plausible(const std::optional<Rival>& rival, double inflation) {
  return rival && rival->cost_excess < kPlausibleExcess * inflation;
}

}  // namespace

bool is_never_in_sight(const AnchorEvidence& evidence) noexcept {
  if (evidence.in_sight_share < kMinInSightShare) return true;
  return evidence.scale_ratio > kBlockedScaleRatio && evidence.count_ratio < kBlockedCountRatio;
}

void admit_wall(std::size_t tag_count, Eigen::MatrixXd& covariance) {
  const auto tags = static_cast<Eigen::Index>(tag_count);
  if (tags == 0) return;
  const Eigen::LDLT<Eigen::MatrixXd> biases(covariance.block(3, 3, tags, tags));
  const Eigen::VectorXd response =
      kWallSigma_m * covariance.middleCols(3, tags) * biases.solve(Eigen::VectorXd::Ones(tags));
  if (response.allFinite()) covariance += response * response.transpose();
  covariance.diagonal().head<3>().array() += kWallVariation_m * kWallVariation_m;
}

void judge_anchor(const AnchorEvidence& evidence, model::AnchorCalibration& anchor) {
  anchor.advice.clear();
  if (anchor.ranges_used < kMinRanges) {
    anchor.verdict = AnchorVerdict::kNoData;
    anchor.advice = anchor.ranges_used + anchor.ranges_rejected == 0
                        ? "no range at all: check that the anchor is powered and in the schedule"
                        : "too few ranges with a pose: drive where this anchor answers";
    return;
  }
  const Eigen::Matrix3d covariance = anchor.covariance.topLeftCorner<3, 3>();
  const double limit_m = std::max(kWeakSigma_m, kWeakSigmaShare * evidence.nearest_m);
  const double sigma_xy_m = std::sqrt(
      std::max(0.0, covariance.topLeftCorner<2, 2>().selfadjointView<Eigen::Lower>().eigenvalues()(1)));
  const double sigma_z_m = std::sqrt(std::max(0.0, covariance(2, 2)));

  if (is_never_in_sight(evidence)) {
    anchor.verdict = AnchorVerdict::kNeverInSight;
    anchor.advice = "its ranges come through something: drive where it is in sight, or move it";
    return;
  }
  if (sigma_xy_m > limit_m || is_plausible(evidence.side, evidence.inflation)) {
    anchor.verdict = AnchorVerdict::kWeak;
    anchor.advice = drive_advice(evidence, anchor.position_m);
    return;
  }
  if (evidence.held_out_z && *evidence.held_out_z > kHeldOutLimit) {
    anchor.verdict = AnchorVerdict::kWeak;
    anchor.advice =
        "the end of the drive contradicts its beginning: drive again, and look whether the anchor moved";
    return;
  }
  if (sigma_z_m > limit_m || is_plausible(evidence.mirror, evidence.inflation)) {
    anchor.verdict = AnchorVerdict::kWeakZ;
    anchor.advice = is_plausible(evidence.mirror, evidence.inflation)
                        ? "above or below the tags cannot be told: measure its height, or " +
                              drive_advice(evidence, anchor.position_m)
                        : "height uncertain: " + drive_advice(evidence, anchor.position_m);
    return;
  }
  anchor.verdict = AnchorVerdict::kOk;
}

model::Verdict judge_site(std::span<const model::AnchorCalibration> anchors) {
  const auto carries = [](const model::AnchorCalibration& anchor) {
    return anchor.verdict == AnchorVerdict::kOk || anchor.verdict == AnchorVerdict::kWeakZ;
  };
  const auto good = static_cast<std::size_t>(std::count_if(anchors.begin(), anchors.end(), carries));
  if (good == 0) return model::Verdict::kUnusable;
  const bool all_ok = std::all_of(anchors.begin(), anchors.end(), [](const model::AnchorCalibration& anchor) {
    return anchor.verdict == AnchorVerdict::kOk;
  });
  return all_ok && good >= kMinAnchors ? model::Verdict::kUsable : model::Verdict::kWarnings;
}

}  // namespace groma::calibration
