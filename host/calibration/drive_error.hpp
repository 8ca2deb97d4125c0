// What the drive itself has wrong, and all anchors share: the robot's poses wander slowly about the truth,
// and the ranges may be stamped late. Solved together with every anchor.
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/association.hpp"
#include "host/calibration/site_solver.hpp"
#include "host/calibration/uncertainty.hpp"

namespace groma::calibration {

// The belief in the poses' error before any range is seen: in x, in y (map) and in yaw, each with an
// exponential correlation over correlation_s; zero means that the poses are exact.
struct WanderPrior {
  double sigma_m = 0.0;
  double sigma_yaw_rad = 0.0;
  double correlation_s = 20.0;
};

struct DriveError {
  WanderPrior wander;          // as the ranges make it likeliest
  double range_delay_s = 0.0;  // zero where the ranges do not show one clearly
  double range_delay_sigma_s = 0.0;
  std::vector<Evidence> evidence;  // of each fit as it comes back
  // What the error's remaining uncertainty adds to each anchor's covariance, in the order of the fits.
  std::vector<Eigen::MatrixXd> added_covariance;
  // Of the shift and turn (x, y, z, yaw about the map's origin) that all poses share.
  Eigen::Matrix4d frame_covariance = Eigen::Matrix4d::Zero();
};

// Estimates the error, moves the antennas of the association's rows (which the fits refer to) to where they
// were by it, and the fits with them.
[[nodiscard]] DriveError correct_drive(Association& association, std::vector<AnchorFit>& fits,
                                       const model::RangePriors& priors);

}  // namespace groma::calibration
