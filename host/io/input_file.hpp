// Whole files into memory, and the digest that tells later which files they were.
#pragma once

#include <filesystem>
#include <map>
#include <string>
#include <string_view>

namespace groma::io {

// A pipe is read to its end, too. Throws DataError (missing, a folder, unreadable, a pipe that nobody writes
// to, no regular file and longer than 64 MiB) or PermissionError.
[[nodiscard]] std::string read_file(const std::filesystem::path& path);

// Hexadecimal SHA-256.
[[nodiscard]] std::string sha256(std::string_view bytes);

// Reads files and remembers their digests.
class InputFiles {
 public:
  // As read_file(); a file that was provided is taken from there.
  [[nodiscard]] std::string read(const std::filesystem::path& path);

  // The text of a file that is not on the disk by itself.
  void provide(const std::filesystem::path& path, std::string text);

  // One digest of all files read so far: what `sha256sum FILES | sha256sum` prints, with the files' bare
  // names in alphabetical order. Files of the same name count once.
  [[nodiscard]] std::string digest() const;

 private:
  std::map<std::string, std::string> digest_by_name_;
  std::map<std::filesystem::path, std::string> provided_;
};

}  // namespace groma::io
