// Escapes text for HTML and SVG.
#pragma once

#include <string>
#include <string_view>

namespace groma::report {

[[nodiscard]] std::string escaped(std::string_view text);

}  // namespace groma::report
