#include "host/io/version.hpp"

namespace groma::io {

std::string_view program_version() {
  return GROMA_VERSION;
}

}  // namespace groma::io
