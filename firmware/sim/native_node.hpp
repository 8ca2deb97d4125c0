// A node whose firmware is compiled for the host. Its platform consists of the chip model and a clock.
#pragma once

#include <memory>

#include "firmware/sim/network.hpp"

namespace groma::sim {

// Attaches the node to the medium; unpowered until spec.power_on.
[[nodiscard]] std::unique_ptr<NodeHost> make_native_node(const NodeSpec& spec, Medium& medium);

}  // namespace groma::sim
