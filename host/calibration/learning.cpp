#include "host/calibration/learning.hpp"

#include <algorithm>
#include <cmath>

namespace groma::calibration {
namespace {

// What the verdict asks for (verdict.cpp), at least.
constexpr double kNeededRanges = 30.0;
constexpr double kNeededSigma_m = 0.30;
constexpr double kAlmost = 0.99;
// Of one anchor in a step: of those that a robot measures where it stands for long, most tell nothing new.
constexpr std::size_t kMostAnchorRanges = 4000;

Drive drive_of(const DriveStore::Samples& samples, const LearningInput& input) {
  Drive drive;
  drive.ranges = samples.ranges;
  drive.poses = samples.poses;
  drive.tags = input.tags;
  drive.surface = &input.surface;
  drive.priors = input.priors;
  return drive;
}

}  // namespace

LearningStep learn(const LearningInput& input) {
  LearningStep step;
  if (input.places) {
    step.samples = input.places->samples();
    step.learnt = calibrate(drive_of(step.samples, input), {.most_anchor_ranges = kMostAnchorRanges});
    step.learnt->fitted.clear();
  }
  if (input.live.anchors.empty() || input.recent.segments() < kMinRecheckSegments) return step;
  const DriveStore::Samples samples = input.recent.samples();
  model::Calibration recent = calibrate(drive_of(samples, input), {.earlier = &input.live}).calibration;
  // What is hardly heard, or through a wall, says nothing of where the anchor is.
  std::erase_if(recent.anchors, [](const model::AnchorCalibration& anchor) {
    return anchor.verdict == model::AnchorVerdict::kNoData ||
           anchor.verdict == model::AnchorVerdict::kNeverInSight;
  });
  step.rechecked = compare(input.live, recent).anchors;
  return step;
}

bool carries(const model::AnchorCalibration& anchor) noexcept {
  return model::has_position(anchor) && model::is_usable(anchor.verdict);
}

double coverage(const model::AnchorCalibration& anchor) {
  if (carries(anchor)) return 1.0;
  if (!model::has_position(anchor)) return 0.0;
  double share = std::min(kAlmost, static_cast<double>(anchor.ranges_used) / kNeededRanges);
  const double variance_m2 = std::max(anchor.covariance(0, 0), anchor.covariance(1, 1));
  if (variance_m2 > 0.0) share = std::min(share, kNeededSigma_m * kNeededSigma_m / variance_m2);
  return share;
}

}  // namespace groma::calibration
