// Anchor calibration from one drive, the first stage of the source paper: estimates anchor positions and pair
// biases (beta, gamma) with their covariance from ranges and the robot's own poses.
#pragma once

#include <cstddef>
#include <limits>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/drive.hpp"
#include "host/model/calibration.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

struct Options {
  // An earlier calibration of the site; must outlive the call. It only decides on which side of the tags an
  // anchor is where the drive leaves that open; nothing else of it enters the solution.
  const model::Calibration* earlier = nullptr;
  // Most ranges used per anchor; choose_measurements() selects them. The others still count as received.
  std::size_t most_anchor_ranges = std::numeric_limits<std::size_t>::max();
};

// One range at the solution.
struct FittedRange {
  double t_s = 0.0;
  model::NodeId tag_id = 0;
  Eigen::Vector2d antenna_m = Eigen::Vector2d::Zero();  // x and y, map
  double distance_m = 0.0;                              // antenna to anchor
  double residual_m = 0.0;                              // measured - predicted
  double los = 0.0;                                     // probability of LOS
  bool is_ignored = false;                              // its first path is too weak for a line of sight
};

struct Result {
  model::Calibration calibration;  // the caller fills in input_sha256 and program_version
  std::size_t ranges_used = 0;
  std::size_t ranges_rejected = 0;
  // One vector per anchor, in the order of calibration.anchors; each sorted by time.
  std::vector<std::vector<FittedRange>> fitted;
};

// Deterministic. Memory grows in proportion to the number of ranges. Bad data raises no exception: an anchor
// that cannot be calibrated comes back with a verdict that says so.
[[nodiscard]] Result calibrate(const Drive& drive, const Options& options = {});

}  // namespace groma::calibration
