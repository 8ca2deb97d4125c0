// Version of this program, as in files and streams.
#pragma once

#include <string>
#include <string_view>

namespace groma::io {

[[nodiscard]] std::string_view program_version();
// With the commit: VERSION-HASH.
[[nodiscard]] std::string build_name();

}  // namespace groma::io
