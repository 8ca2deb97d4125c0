// The error that ends a simulation: the firmware misused its hardware.
#pragma once

#include <stdexcept>

namespace groma::sim {

// For example an access to a register that is not modelled. The text names the address or register.
struct SimulationError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

}  // namespace groma::sim
