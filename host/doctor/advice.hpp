// What to do in each state of gromad.
#pragma once

#include <string_view>

namespace groma::doctor {

// For a person; empty if there is nothing to do. state, reason: as in POSE and STATUS; the reason may be
// empty.
[[nodiscard]] std::string_view advice_on(std::string_view state, std::string_view reason) noexcept;

}  // namespace groma::doctor
