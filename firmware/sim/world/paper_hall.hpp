// The scenario of `groma demo`, compiled into the program: scenarios/paper_hall.yaml.
#pragma once

#include "firmware/sim/world/scenario.hpp"

namespace groma::sim {

[[nodiscard]] Scenario paper_hall();

}  // namespace groma::sim
