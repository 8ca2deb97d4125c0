// Ranges between anchors, fused with the drive's solution: one problem of all positions.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/site.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// Mean of all ranges between two anchors.
struct AnchorLink {
  std::size_t from = 0;  // indices of the anchors
  std::size_t to = 0;
  double range_m = 0.0;
  double variance_m2 = 0.0;  // of the mean, including the priors of such a pair's terms
};

// Leaves out ranges that are invalid, name an unknown anchor, or name one anchor twice.
[[nodiscard]] std::vector<AnchorLink> gather_links(std::span<const model::AnchorRange> ranges,
                                                   std::span<const model::NodeId> anchor_ids,
                                                   const model::RangePriors& priors);

// Gaussian estimate of all anchors. Each has its unknowns, position first; two anchors are correlated by the
// drive's error that they share: gain_a shared gain_b^T.
struct AnchorBelief {
  std::vector<AnchorVector> mean;
  std::vector<Eigen::MatrixXd> covariance;  // of each anchor, shared part included
  std::vector<Eigen::MatrixXd> gain;        // empty: nothing shared
  Eigen::MatrixXd shared;                   // covariance
};

// The estimate after the links, robust against NLOS links and linearized at the result. Dense in the
// positions, 3 per anchor; the other unknowns follow by regression.
[[nodiscard]] AnchorBelief fuse_links(const AnchorBelief& belief, std::span<const AnchorLink> links,
                                      const model::RangePriors& priors);

// Fuses the links, if there are any, with the drive's solutions: picks the side of each anchor, fuses, and
// linearizes the drive's ranges again from there. Moves the fits; updates their evidence and their mirror
// hypotheses across the tags' plane. Returns the covariance of each anchor's unknowns.
[[nodiscard]] std::vector<Eigen::MatrixXd> join_links(std::span<const model::AnchorRange> ranges,
                                                      const model::RangePriors& priors, Site& site);

}  // namespace groma::calibration
