// Which ranges of a pair were in sight, told from all of them.
#pragma once

#include <span>
#include <vector>

#include "host/filter/config.hpp"

namespace groma::smoother {

struct Residual {
  double t_s = 0.0;
  double error_m = 0.0;  // measured less predicted
  double sigma_m = 0.1;  // of a range in sight
};

// The probability of each of one pair's ranges, by time, that it was in sight: the gate's two states and
// kinds of error (host/filter/gate.hpp), by the forward-backward algorithm.
[[nodiscard]] std::vector<double> in_sight(std::span<const Residual> pair, const filter::GateConfig& config);

}  // namespace groma::smoother
