// A recorded drive in the light of all of it: the poses that odometry, ranges and calibration together make
// most likely. It sees what comes later, as no filter can: what a filter reaches is to be measured by it.
//
// The model is the filter's (docs/explanation/filter.md), in one least-squares problem: a pose at each
// odometry row, the slow error of each pair there, and beside them the odometry's scale and yaw-rate bias,
// the delay and the parameters of the calibration. Whether a range was in sight is told by all ranges of its
// pair, earlier and later. Gauss-Newton over rows, block by block: time and memory grow with their number.
//
// As schmidt, anchors marked ok, lever arms and frame stay as calibrated, and what they may be off by is in
// the covariance; as joint, all is solved for.
#pragma once

#include <cstddef>
#include <vector>

#include "host/filter/replay.hpp"
#include "host/model/types.hpp"

namespace groma::smoother {

struct Result {
  std::vector<model::PlanarEstimate> rows;  // one for each odometry row from the start on
  double scale_error = 0.0;
  double yaw_rate_bias_radps = 0.0;
  double range_delay_s = 0.0;
  double odometry_delay_s = 0.0;
  std::size_t ranges_seen = 0;
  double ranges_in_sight = 0.0;  // sum of their probabilities
  filter::Counters counters;     // of the filter that it begins with
  int rounds = 0;
  bool converged = false;  // the last round moved no pose by more than a millimetre
};

// As filter::replay(), and begins with what that finds; any model but joint is taken for schmidt. No rows
// where there are fewer than two of odometry.
[[nodiscard]] Result smooth(const filter::Run& run, const filter::ReplayOptions& options);

}  // namespace groma::smoother
