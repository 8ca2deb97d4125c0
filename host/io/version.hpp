// Version of this program, as in files and streams.
#pragma once

#include <string_view>

namespace groma::io {

[[nodiscard]] std::string_view program_version();

}  // namespace groma::io
