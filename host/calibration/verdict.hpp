// What a driver is told of each anchor, and of the whole.
#pragma once

#include <optional>
#include <span>

#include <Eigen/Core>

#include "host/calibration/initial_guess.hpp"
#include "host/calibration/rival.hpp"
#include "host/model/calibration.hpp"

namespace groma::calibration {

// What is known of one anchor beside its solution.
struct AnchorEvidence {
  TagSpread spread;                  // of the antennas while they ranged to it
  double nearest_m = 0.0;            // closest antenna
  std::optional<Rival> mirror;       // across the plane of the tags
  std::optional<Rival> side;         // across the line of the drive
  double in_sight_share = 0.0;       // of its ranges, by the kernel
  std::optional<double> held_out_z;  // held-out residuals' scale over what the fit expects
  double inflation = 1.0;            // of the score's scatter, by correlation in time
};

// Fills verdict and advice from the anchor's covariance and the evidence.
void judge_anchor(const AnchorEvidence& evidence, model::AnchorCalibration& anchor);

[[nodiscard]] model::Verdict judge_site(std::span<const model::AnchorCalibration> anchors);

}  // namespace groma::calibration
