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
  std::string board;  // its folder's name in firmware/board; empty: an older image, which does not name it
  std::uint32_t git_hash = 0;
  std::size_t bytes = 0;  // of flash
};

// Reads an Intel HEX file. Throws io::DataError if it is missing, invalid, truncated, not an image of a Groma
// node, or would overwrite a node's configuration; io::PermissionError if it cannot be read.
[[nodiscard]] NodeImage read_node_image(const std::filesystem::path& path);

// Of the image of default_image_path().
inline constexpr const char* kDefaultBoard = "dwm1001";

// Throws io::DataError if the image names another board than `board`.
void require_board(const NodeImage& image, const std::string& board);

// build/dwm1001/groma-node.hex in the build tree of this program.
[[nodiscard]] std::filesystem::path default_image_path();

}  // namespace groma::provision
