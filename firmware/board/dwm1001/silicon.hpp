#pragma once

namespace groma::dwm1001 {

// Early in start-up: what the chip's revisions want from firmware before anything else.
void prepare_silicon() noexcept;

}  // namespace groma::dwm1001
