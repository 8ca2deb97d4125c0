// The image to be flashed, looked at before anything is erased for it.
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

// Reads an Intel HEX file. Throws io::DataError where it is missing, is no such file, is cut short, is no
// image of a Groma node, or would overwrite a node's configuration; io::PermissionError.
[[nodiscard]] NodeImage read_node_image(const std::filesystem::path& path);

// build/dwm1001/groma-node.hex of the build tree that this program was built in.
[[nodiscard]] std::filesystem::path default_image_path();

}  // namespace groma::provision
