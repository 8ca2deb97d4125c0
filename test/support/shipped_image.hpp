// Files of the DWM1001 image that the preset dwm1001 builds, for tests that need it.
#pragma once

#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>
#include <string>

namespace groma::test {

// The test program has to define GROMA_SOURCE_DIR; the environment variable GROMA_IMAGE_FOLDER names another
// folder. extension: ".elf" or ".hex".
inline std::filesystem::path shipped_image(const std::string& extension) {
  const char* folder = std::getenv("GROMA_IMAGE_FOLDER");
  const auto built = std::filesystem::path(GROMA_SOURCE_DIR) / "build/dwm1001";
  return (folder != nullptr ? std::filesystem::path(folder) : built) / ("groma-node" + extension);
}

}  // namespace groma::test

// At the start of a test: skips the test if there is no image, or fails if GROMA_REQUIRE_IMAGE is set.
#define GROMA_NEEDS_SHIPPED_IMAGE()                                                                    \
  do {                                                                                                 \
    if (std::filesystem::exists(groma::test::shipped_image(".elf")) &&                                 \
        std::filesystem::exists(groma::test::shipped_image(".hex"))) {                                 \
      break;                                                                                           \
    }                                                                                                  \
    const std::string message = "no " + groma::test::shipped_image(".hex").string() +                  \
                                ": run scripts/setup firmware, cmake --preset dwm1001, cmake --build " \
                                "--preset dwm1001";                                                    \
    if (std::getenv("GROMA_REQUIRE_IMAGE") != nullptr) {                                               \
      FAIL() << message;                                                                               \
    }                                                                                                  \
    GTEST_SKIP() << message;                                                                           \
  } while (false)
