// Version of this program, as files and streams carry it.
#pragma once

#include <string_view>

namespace groma::io {

[[nodiscard]] std::string_view program_version();

}  // namespace groma::io
