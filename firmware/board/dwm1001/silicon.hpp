#pragma once

namespace groma::dwm1001 {

// Applies the workarounds and settings that the chip's revisions require early in start-up.
void prepare_silicon() noexcept;

}  // namespace groma::dwm1001
