// The image to be flashed, checked before anything is erased.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <string>

namespace groma::provision {

struct NodeImage {
  std::filesystem::path path;
  std::string version;
  std::uint32_t git_hash = 0;
  std::size_t bytes = 0;  // of flash
};

// Reads an Intel HEX file. Throws io::DataError if it is missing, invalid, truncated, not an image of a Groma
// node, or would overwrite a node's configuration; io::PermissionError if it cannot be read.
[[nodiscard]] NodeImage read_node_image(const std::filesystem::path& path);

// build/dwm1001/groma-node.hex in the build tree of this program.
[[nodiscard]] std::filesystem::path default_image_path();

}  // namespace groma::provision
