// What ends a simulation: the firmware did what its hardware would not bear.
#pragma once

#include <stdexcept>

namespace groma::sim {

// An access to a register that is not modelled, and the like. The text names the place.
struct SimulationError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

}  // namespace groma::sim
