// LOS probabilities of the ranges of a pair, from all of them.
#pragma once

#include <span>
#include <vector>

#include "host/filter/config.hpp"

namespace groma::smoother {

struct Residual {
  double t_s = 0.0;
  double error_m = 0.0;  // measured minus predicted
  double sigma_m = 0.1;  // of a LOS range
};

// LOS probability of each range of one pair, sorted by time: forward-backward algorithm on the gate's two
// states and error densities (host/filter/gate.hpp).
[[nodiscard]] std::vector<double> los_probabilities(std::span<const Residual> pair,
                                                    const filter::GateConfig& config);

}  // namespace groma::smoother
