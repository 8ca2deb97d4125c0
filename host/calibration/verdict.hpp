// What a driver is told of each anchor, and of the whole.
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/sight_chain.hpp"
#include "host/calibration/site_solver.hpp"
#include "host/model/calibration.hpp"

namespace groma::calibration {

// Fewer ranges say nothing of an anchor.
inline constexpr std::size_t kMinRanges = 30;
// Horizontal sigma that a filter can live with; beyond it the position is a hint and no more.
inline constexpr double kWeakSigma_m = 0.30;

// How an anchor was seen, where the site was solved with each row's sight.
struct SightEvidence {
  SightVector polls = SightVector::Zero();  // share of its polls in each state
  bool polls_are_told = false;              // replies that are missing count in it
  double wall_excess_m = 0.0;               // that walls add, as the site has it
  double far_share = 0.0;    // of its ranges that are too long, or too short, by more than walls and
  double short_share = 0.0;  // shadows make them
};

// That it was not in one place all the time.
struct MoveEvidence {
  std::vector<double> at_s;                              // of each move
  Eigen::Vector3d by_m = Eigen::Vector3d::Zero();        // the last one
  bool is_back = false;                                  // where it was at first
  std::optional<model::NodeId> stand_in = std::nullopt;  // an anchor whose place it had meanwhile or has now
};

// What is known of one anchor beside its solution.
struct AnchorEvidence {
  TagSpread spread;                       // of the antennas while they ranged to it
  std::size_t rows = 0;                   // ranges with a pose
  double nearest_m = 0.0;                 // closest antenna
  std::optional<Rival> mirror;            // across the plane of the tags
  std::optional<Rival> side;              // across the line of the drive
  double in_sight_share = 0.0;            // of its ranges, by the kernel
  std::optional<double> held_out_z;       // held-out residuals' scale over what the fit expects
  double scale_ratio = 1.0;               // its noise over the site's median
  double count_ratio = 1.0;               // its ranges over the site's median
  double inflation = 1.0;                 // of the score's scatter, by correlation in time
  double flicker = 1.0;                   // scatter from one range to the next over the site's noise
  std::optional<MoveEvidence> moved;      // during the drive
  std::optional<Eigen::Vector3d> twin_m;  // another place that it answers from
  std::optional<SightEvidence> sight;
};

// Whether its ranges, all or nearly all, are NLOS: they are then noisier than the others' and fewer get
// through, while the excess that they have in common passes for a bias.
[[nodiscard]] bool is_never_in_sight(const AnchorEvidence& evidence) noexcept;
[[nodiscard]] bool is_hardly_in_sight(const AnchorEvidence& evidence) noexcept;
// Whether more of its ranges are too long, or too short, than NLOS explains, as reflections are.
[[nodiscard]] bool contradicts_itself(const AnchorEvidence& evidence) noexcept;

// Fills verdict and advice from the anchor's covariance and the evidence.
void judge_anchor(const AnchorEvidence& evidence, model::AnchorCalibration& anchor);

[[nodiscard]] model::Verdict judge_site(std::span<const model::AnchorCalibration> anchors);

}  // namespace groma::calibration
