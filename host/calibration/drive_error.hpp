// What the drive itself has wrong, and all anchors share: the robot's poses wander slowly about the truth,
// the ranges may be stamped late, and antennas are not quite where and what they are said to be. Solved
// together with every anchor.
#pragma once

#include <vector>

#include <Eigen/Core>

#include "host/calibration/association.hpp"
#include "host/calibration/shared_unknowns.hpp"
#include "host/calibration/site_solver.hpp"
#include "host/calibration/uncertainty.hpp"

namespace groma::calibration {

// What the robot's body does to the ranges of one tag.
struct BodyError {
  BodyVector mean = BodyVector::Zero();
  BodyMatrix covariance = BodyMatrix::Zero();
};

struct DriveError {
  double range_delay_s = 0.0;  // taken off where the ranges show it clearly; told in any case
  double range_delay_sigma_s = 0.0;
  std::vector<BodyError> body;     // of each tag; empty where the ranges do not show it clearly
  std::vector<Evidence> evidence;  // of each fit as it comes back
  // What the error's remaining uncertainty adds to each anchor's covariance, in the order of the fits.
  std::vector<Eigen::MatrixXd> added_covariance;
  // What relates the anchors: covariance of what they share, and by how much each anchor's unknowns answer to
  // it. Empty where nothing was corrected.
  Eigen::MatrixXd shared_covariance;
  std::vector<Eigen::MatrixXd> shared_gain;
  // Of the shift and turn (x, y, z, yaw about the map's origin) that all poses share, and what of it no range
  // can tell: that is not in what is added to the anchors. Both zero where an anchor was surveyed: the survey
  // makes the frame then.
  Eigen::Matrix4d frame_covariance = Eigen::Matrix4d::Zero();
  Eigen::Matrix4d unseen_frame_covariance = Eigen::Matrix4d::Zero();
  // What is believed, and what has been taken off the rows.
  SharedUnknowns unknowns;
  SharedPrior prior;
  Eigen::VectorXd shared_mean;
};

// Estimates the error, moves the antennas of the association's rows (which the fits refer to) to where they
// were by it and takes their patterns off the ranges, and moves the fits with them.
[[nodiscard]] DriveError correct_drive(Association& association, std::vector<AnchorFit>& fits);
// The same from where that ended, after the fits' rows have been looked at anew: what is believed stays.
void correct_further(Association& association, std::vector<AnchorFit>& fits, DriveError& drive_error);

}  // namespace groma::calibration
