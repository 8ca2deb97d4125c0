// Anchor calibration from one drive: positions, pair biases and their covariance from ranges and the
// robot's own poses.
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
  // An earlier calibration of the site; outlives the call. Where the drive leaves open on which side of the
  // tags an anchor is, the one decides on which it was; nothing else of it goes into the solution.
  const model::Calibration* earlier = nullptr;
  // Of one anchor at most so many ranges are used, chosen by choose_measurements(). Of the others it still
  // counts that they came.
  std::size_t most_anchor_ranges = std::numeric_limits<std::size_t>::max();
};

// A range as the solution sees it.
struct FittedRange {
  double t_s = 0.0;
  model::NodeId tag_id = 0;
  Eigen::Vector2d antenna_m = Eigen::Vector2d::Zero();  // x and y, map
  double distance_m = 0.0;                              // antenna to anchor
  double residual_m = 0.0;                              // measured less predicted
  double in_sight = 0.0;                                // probability that nothing stood between
};

struct Result {
  model::Calibration calibration;  // input_sha256 and program_version left to the caller
  std::size_t ranges_used = 0;
  std::size_t ranges_rejected = 0;
  // In the order of the calibration's anchors, each anchor's by time.
  std::vector<std::vector<FittedRange>> fitted;
};

// Deterministic; allocates in proportion to the number of ranges; throws nothing on data: what cannot be
// calibrated comes back marked so.
[[nodiscard]] Result calibrate(const Drive& drive, const Options& options = {});

}  // namespace groma::calibration
