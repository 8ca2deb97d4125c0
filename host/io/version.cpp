#include "host/io/version.hpp"

#include "generated/groma_version.hpp"

namespace groma::io {

std::string_view program_version() {
  return kVersion;
}

}  // namespace groma::io
