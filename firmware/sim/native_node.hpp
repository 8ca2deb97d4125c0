// A node whose firmware runs compiled in: the platform it asks for, made of the chip model and a clock.
#pragma once

#include <memory>

#include "firmware/sim/network.hpp"

namespace groma::sim {

// Attached to the medium, without power until spec.power_on.
[[nodiscard]] std::unique_ptr<NodeHost> make_native_node(const NodeSpec& spec, Medium& medium);

}  // namespace groma::sim
