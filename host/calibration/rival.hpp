// Solutions on the other side of the tags: a robot on a floor hardly tells above from below, on a straight
// line hardly left from right.
#pragma once

#include <Eigen/Core>

#include "host/calibration/initial_guess.hpp"
#include "host/calibration/site_solver.hpp"

namespace groma::calibration {

// The best solution on the other side.
struct Rival {
  AnchorVector anchor;
  double cost_excess = 0.0;  // negative log likelihood over the solution's, as of independent residuals; >= 0
  double cost_ratio = 1.0;   // the solution's cost over its, 0..1; a cost counts from that of perfect ranges
};

// Looks for the other side along one axis; where it explains the ranges better, the fit moves there and its
// former place is the rival. The fit must have rows.
[[nodiscard]] Rival challenge(AnchorFit& fit, const TagSpread& spread, int axis);

// Where an anchor was by an earlier calibration.
struct EarlierPlace {
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Matrix3d covariance_m2 = Eigen::Matrix3d::Identity();  // that of the drives' frames included
};
// Lets the earlier place decide between both sides, as far as an anchor that may have been moved allows: the
// excess becomes that of ranges and place together, over `inflation` independent; below zero both change
// parts.
void weigh_by_earlier(const EarlierPlace& earlier, double inflation, AnchorFit& fit, Rival& rival);

// The spread that a rival adds to the position's covariance: as were it the truth with the probability that
// its excess, over `inflation`, leaves it.
[[nodiscard]] Eigen::Matrix3d rival_spread(const Rival& rival, const AnchorFit& fit, double inflation);

}  // namespace groma::calibration
