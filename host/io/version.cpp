#include "host/io/version.hpp"

#include <fmt/format.h>

#include "generated/groma_version.hpp"

namespace groma::io {

std::string_view program_version() {
  return kVersion;
}

std::string build_name() {
  return fmt::format("{}-{:08x}", kVersion, kGitHash);
}

}  // namespace groma::io
