// Ranges between anchors, joined with what the drive told of each: one problem of all positions.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/drive_error.hpp"
#include "host/calibration/verdict.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// All ranges between two anchors, as one.
struct AnchorLink {
  std::size_t from = 0;  // indices of the anchors
  std::size_t to = 0;
  double range_m = 0.0;
  double variance_m2 = 0.0;  // of the mean, with what is believed of beta and gamma of such a pair
};

// Ranges that name anchors which are not among these, or an anchor twice, or are no ranges, are left out.
[[nodiscard]] std::vector<AnchorLink> gather_links(std::span<const model::AnchorRange> ranges,
                                                   std::span<const model::NodeId> anchor_ids,
                                                   const model::RangePriors& priors);

// Gaussian belief in all anchors: of each its unknowns, position first; between two of them what they share
// of the drive's error, gain_a shared gain_b^T.
struct AnchorBelief {
  std::vector<AnchorVector> mean;
  std::vector<Eigen::MatrixXd> covariance;  // of each alone, the shared part included
  std::vector<Eigen::MatrixXd> gain;        // empty: nothing shared
  Eigen::MatrixXd shared;                   // covariance
};

// The belief after the links, which bend with the anchors' places and may be blocked: linearized at the
// result. Dense in the positions, 3 an anchor; the rest follows by regression.
[[nodiscard]] AnchorBelief fuse_links(const AnchorBelief& belief, std::span<const AnchorLink> links,
                                      const model::RangePriors& priors);

// Joins the links to the drive's solutions: picks the side of each anchor, fuses, and linearizes the drive's
// ranges again from there. Moves the fits; their evidence and their rivals across the tags' plane follow.
struct LinkedSite {
  std::span<AnchorFit> fits;
  std::span<const double> inflation;
  std::span<AnchorEvidence> known;
  DriveError& error;
};
// Covariance of each anchor's unknowns.
[[nodiscard]] std::vector<Eigen::MatrixXd> join_links(const LinkedSite& site,
                                                      std::span<const AnchorLink> links,
                                                      const model::RangePriors& priors);

}  // namespace groma::calibration
