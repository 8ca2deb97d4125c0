#pragma once

#include "firmware/core/node/platform.hpp"

namespace groma::dwm1001 {

// How much of the stack has been used since the reset: what is no longer painted.
[[nodiscard]] node::StackUse stack_use() noexcept;

}  // namespace groma::dwm1001
