// Why the processor began anew.
#pragma once

#include <optional>

#include "firmware/core/node/platform.hpp"

namespace groma::dwm1001 {

struct Reset {
  node::ResetReason reason = node::ResetReason::kPowerOn;
  std::optional<node::Fault> fault{};
};

// Once after boot: what it was is forgotten by this call.
[[nodiscard]] Reset take_reset() noexcept;

}  // namespace groma::dwm1001
