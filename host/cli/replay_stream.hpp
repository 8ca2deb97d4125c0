// groma replay CAPTURE --stream FILE: repeats the pose lines of gromad.
#pragma once

#include <cstddef>
#include <filesystem>
#include <optional>

namespace groma::cli {

struct StreamOptions {
  std::filesystem::path capture;
  std::optional<std::size_t> section;  // from 1; none: all
  std::filesystem::path output;
  bool json = false;
};

// Writes the lines, prints what of the capture they are and whether they are those that went out; returns the
// exit code. Throws io::Error.
[[nodiscard]] int replay_stream(const StreamOptions& options);

}  // namespace groma::cli
