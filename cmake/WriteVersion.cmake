# cmake -DVERSION=... -DGIT=... -DSOURCE_DIR=... -DHEADER=... -P WriteVersion.cmake
set(hash "")
if(GIT)
  execute_process(
    COMMAND ${GIT} rev-parse --short=8 HEAD
    WORKING_DIRECTORY ${SOURCE_DIR}
    OUTPUT_VARIABLE hash
    OUTPUT_STRIP_TRAILING_WHITESPACE
    ERROR_QUIET
  )
endif()
string(SUBSTRING "${hash}" 0 8 hash)
if(NOT hash MATCHES "^[0-9a-f]+$")
  set(hash 0)
endif()
file(
  WRITE ${HEADER}
  "#pragma once

#include <cstdint>

namespace groma {

inline constexpr char kVersion[] = \"${VERSION}\";
// The first 32 bits of the commit's hash; 0: built outside a repository.
inline constexpr std::uint32_t kGitHash = 0x${hash};

}  // namespace groma
"
)
