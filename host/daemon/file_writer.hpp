// Writes one file at a time, in a thread that may wait for the disk.
#pragma once

#include <filesystem>
#include <future>
#include <optional>
#include <string>

namespace groma::daemon {

class FileWriter {
 public:
  // A file is being written.
  [[nodiscard]] bool busy() const;
  // Waits for the file; returns its error, empty if it was written; nothing if there was no file.
  [[nodiscard]] std::optional<std::string> finish();
  // As io::write_file(). The file before has to be finished.
  void start(std::filesystem::path path, std::string text);

 private:
  std::future<std::string> error_;
};

}  // namespace groma::daemon
