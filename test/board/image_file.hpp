// Files of the images of all boards, which the preset dwm1001 builds.
#pragma once

#include <filesystem>
#include <string>

#include "test/support/shipped_image.hpp"

namespace groma::test {

inline constexpr const char* kShippedImage = "groma-node";
inline constexpr const char* kBareBoardImage = "groma-node-nrf52832_dw1000";

// extension: ".elf" or ".hex". The preset builds all images or none: GROMA_NEEDS_SHIPPED_IMAGE() serves for
// each.
inline std::filesystem::path image_file(const std::string& image, const std::string& extension) {
  return shipped_image(extension).replace_filename(image + extension);
}

}  // namespace groma::test
