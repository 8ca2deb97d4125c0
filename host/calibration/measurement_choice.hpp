// Which of too many ranges to keep: those that together see an anchor about as well as all of them do.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/model/types.hpp"

namespace groma::calibration {

// What a range tells of where the anchor is, whatever its value.
struct RangeGeometry {
  double t_s = 0.0;
  std::size_t tag = 0;
  Eigen::Vector3d direction = Eigen::Vector3d::Zero();  // unit vector from anchor to antenna, map frame
  double distance_m = 0.0;
  double mirrored_m = 0.0;  // the antenna's distance from the other side of the tags
  double sigma_m = 0.1;
};

// All ranges of one anchor.
struct AnchorGeometry {
  std::span<const RangeGeometry> ranges;  // by time
  std::size_t tag_count = 0;
  model::ScalarPrior beta_m;  // of each pair
  model::ScalarPrior gamma;
  double mirror_offset_m = 0.0;  // from the anchor to the other side; zero: there is none
};

// At most `budget` of the ranges, as ascending indices. A quarter of the budget is spread evenly over each
// tag's time, so that blocked sight and moves can still be seen. The others are taken one by one: each time
// one that lowers the position's dilution about as much as any can (97 %) beside those taken before. The
// dilution is the trace of the position's covariance, with the pairs' biases unknown but for their priors and
// what is open of the side that the anchor is on. Values of ranges have no say: blocked ones are neither
// sought nor shunned. Takes n log n for n ranges and little for each one taken; deterministic.
[[nodiscard]] std::vector<std::size_t> choose_measurements(const AnchorGeometry& anchor, std::size_t budget);

}  // namespace groma::calibration
