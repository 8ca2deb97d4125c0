// Selection among too many ranges: a subset that determines an anchor about as well as all of them do.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/model/anchor_parameters.hpp"

namespace groma::calibration {

// What a range contributes to the anchor's position, independent of its value.
struct RangeGeometry {
  double t_s = 0.0;
  std::size_t tag = 0;
  Eigen::Vector3d direction = Eigen::Vector3d::Zero();  // unit vector from anchor to antenna, map frame
  double distance_m = 0.0;
  double mirrored_m = 0.0;  // distance from the antenna to the mirror position
  double sigma_m = 0.1;     // default as in model::RangePriors
};

// All ranges of one anchor.
struct AnchorGeometry {
  std::span<const RangeGeometry> ranges;  // by time
  std::size_t tag_count = 0;
  model::RangePriors priors;
  double mirror_offset_m = 0.0;  // from the anchor to the mirror position; zero: there is none
};

// At most `budget` of the ranges, as ascending indices. A quarter of the budget is spread evenly over each
// tag's time, so that NLOS and moves remain visible. The others are taken greedily: each time one that lowers
// the dilution about as much as any can (97 %), given those taken before. The dilution is the trace of the
// position's covariance, with the pairs' biases at their priors, plus the uncertainty of the anchor's side of
// the tags. Values of ranges do not matter: NLOS ranges are neither preferred nor avoided. O(n log n) for n
// ranges plus little for each range taken; deterministic.
[[nodiscard]] std::vector<std::size_t> choose_measurements(const AnchorGeometry& anchor, std::size_t budget);

}  // namespace groma::calibration
