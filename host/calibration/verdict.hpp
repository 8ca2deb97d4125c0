// What a driver is told of each anchor, and of the whole.
#pragma once

#include <optional>
#include <span>

#include <Eigen/Core>

#include "host/calibration/initial_guess.hpp"
#include "host/model/calibration.hpp"

namespace groma::calibration {

// A solution on another side of the tags that explains the ranges too.
struct Rival {
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  double cost_excess = 0.0;  // its negative log likelihood over the best one's, correlation regarded
  double cost_ratio = 0.0;   // the best one's cost over its, 0..1; cost: over that of perfect ranges
};

// What is known of one anchor beside its solution.
struct AnchorEvidence {
  TagSpread spread;                  // of the antennas while they ranged to it
  double nearest_m = 0.0;            // closest antenna
  std::optional<Rival> mirror;       // across the plane of the tags
  std::optional<Rival> side;         // across the line of the drive
  double in_sight_share = 0.0;       // of its ranges, by the kernel
  std::optional<double> held_out_z;  // held-out residuals' scale over what the fit expects
  bool surveyed = false;
};

// Rivals within this of the best solution's negative log likelihood cannot be ruled out.
inline constexpr double kPlausibleExcess = 6.0;

// Fills verdict and advice from the anchor's covariance and the evidence.
void judge_anchor(const AnchorEvidence& evidence, model::AnchorCalibration& anchor);

[[nodiscard]] model::Verdict judge_site(std::span<const model::AnchorCalibration> anchors);

}  // namespace groma::calibration
