// The reason of the last reset.
#pragma once

#include <optional>

#include "firmware/core/node/platform.hpp"

namespace groma::nrf52832 {

struct Reset {
  node::ResetReason reason = node::ResetReason::kPowerOn;
  std::optional<node::Fault> fault{};
};

// Returns the reason and clears it. Call once after boot.
[[nodiscard]] Reset take_reset() noexcept;

}  // namespace groma::nrf52832
