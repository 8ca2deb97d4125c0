// The ring of a recording: a folder of logs, 00000001.glog and so on, of which the oldest make room for the
// newest. Each begins with a section and a snapshot, so that it can be read by itself.
#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "host/io/descriptor.hpp"

namespace groma::io {

// The logs of a ring, the oldest first; none if the folder does not exist.
[[nodiscard]] std::vector<std::filesystem::path> ring_files(const std::filesystem::path& folder);

class LogRing {
 public:
  // Makes the folder if it is missing, and locks the ring for this program. max_bytes: of all files together,
  // if none exceeds file_bytes() by more than a second of input. Throws PathError, PermissionError or
  // DeviceError (another program records there, the disk is full).
  LogRing(std::filesystem::path folder, std::uint64_t max_bytes);

  // Where the next file is to begin.
  [[nodiscard]] std::uint64_t file_bytes() const noexcept { return max_bytes_ / 8; }

  // Removes the oldest files to make room, and creates the next one. Throws as the constructor does.
  [[nodiscard]] Descriptor open_next();

 private:
  std::filesystem::path folder_;
  std::uint64_t max_bytes_;
  Descriptor lock_;
};

// The newest files that hold at least this much of recorded time, or all, as one log: files that continue the
// one before become one section with it. Empty if there are none. Throws as read_file() does.
[[nodiscard]] std::string last_of_ring(const std::filesystem::path& folder, double last_s);

}  // namespace groma::io
