#pragma once

#include "firmware/core/node/platform.hpp"

namespace groma::cortex_m4 {

// The stack's size and its use since the reset: the part that no longer holds kStackPaint.
[[nodiscard]] node::StackUse stack_use() noexcept;

}  // namespace groma::cortex_m4
