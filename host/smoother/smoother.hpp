// Batch smoother of a recorded drive: the maximum a posteriori poses given all odometry, ranges and the
// calibration. It is not causal and serves as a benchmark for the filter.
//
// The model is the filter's (docs/explanation/filter.md), as one least-squares problem. The unknowns are a
// pose at each odometry sample, and, common to all samples, the odometry's scale and yaw-rate bias, the delay
// and the parameters of the calibration. Each range has the weight that the filter's gate gave it; the noise
// of ranges and odometry is what the filter had found. Gauss-Newton with block elimination: time and memory
// are linear in the number of samples.
//
// A slow range bias acts on the ranges of its pair alike, the error of an anchor on all of its ranges while
// its direction stays: they are part of the noise, times the number of ranges that share them. With the model
// schmidt these are anchors with verdict ok, and lever arms and frame are considered: they stay as
// calibrated, and their uncertainty is in the covariance. With joint, anchors, lever arms and frame are
// estimated.
#pragma once

#include <cstddef>
#include <vector>

#include "host/filter/replay.hpp"
#include "host/model/types.hpp"

namespace groma::smoother {

// A range that counts, with its LOS probability by the filter's gate.
struct WeightedRange {
  model::RangeSample range;
  double weight = 0.0;
};

struct Result {
  std::vector<model::PlanarEstimate> rows;  // one for each odometry sample from the start on
  double scale_error = 0.0;
  double yaw_rate_bias_radps = 0.0;
  double range_delay_s = 0.0;
  double odometry_delay_s = 0.0;
  std::vector<WeightedRange> ranges;
  double ranges_los = 0.0;    // sum of their weights
  filter::Counters counters;  // of the filter run that initializes it
  int rounds = 0;
  bool converged = false;  // the last round moved no pose by more than a millimetre
};

// Inputs as for filter::replay(), whose result is the initial estimate. Any model but joint is treated as
// schmidt. The result has no rows if there are fewer than two odometry samples or replay() finds no pose.
[[nodiscard]] Result smooth(const filter::Run& run, const filter::ReplayOptions& options);

}  // namespace groma::smoother
