// What a driver is told of each anchor, and of the whole.
#pragma once

#include <cstddef>
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
  double scale_ratio = 1.0;          // its noise over the site's median
  double count_ratio = 1.0;          // its ranges over the site's median
  double inflation = 1.0;            // of the score's scatter, by correlation in time
};

// Whether its ranges, all or nearly all, come through something: they are then noisier than the others' and
// fewer get through, while the excess that they have in common passes for a bias.
[[nodiscard]] bool is_never_in_sight(const AnchorEvidence& evidence) noexcept;

// What a wall can add to each bias of an anchor that is never in sight, and what follows of it for position
// and range-dependent biases. The covariance: (position, beta, gamma) of tag_count tags.
void admit_wall(std::size_t tag_count, Eigen::MatrixXd& covariance);

// Fills verdict and advice from the anchor's covariance and the evidence.
void judge_anchor(const AnchorEvidence& evidence, model::AnchorCalibration& anchor);

[[nodiscard]] model::Verdict judge_site(std::span<const model::AnchorCalibration> anchors);

}  // namespace groma::calibration
