// Scenarios that are compiled into programs: ../scenarios.
#pragma once

#include "firmware/sim/world/scenario.hpp"

namespace groma::sim {

// That of `groma demo`.
[[nodiscard]] Scenario paper_hall();
// Those of `groma reproduce`: the source paper's two experiments.
[[nodiscard]] Scenario paper_warehouse();
[[nodiscard]] Scenario paper_forklift();

}  // namespace groma::sim
