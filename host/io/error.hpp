// Errors of files. Each kind has its own exception; each message names the place and says what to do.
#pragma once

#include <cstddef>
#include <filesystem>
#include <stdexcept>
#include <string>
#include <string_view>

namespace groma::io {

// A place in a file; line and column count from 1, 0 is unknown.
struct FilePlace {
  std::filesystem::path path;
  std::size_t line = 0;
  std::size_t column = 0;
};

// "path:line:column", as compilers print it, without unknown parts.
[[nodiscard]] std::string to_string(const FilePlace& place);

class Error : public std::runtime_error {
 public:
  // The message is "place: problem; remedy".
  Error(const FilePlace& place, std::string_view problem, std::string_view remedy);

  [[nodiscard]] const FilePlace& place() const noexcept { return place_; }

 private:
  FilePlace place_;
};

// Data that cannot be read.
class DataError : public Error {
  using Error::Error;
};

// A configuration or another YAML file with invalid content.
class ConfigError : public Error {
  using Error::Error;
};

// A file that this user may not read or write.
class PermissionError : public Error {
  using Error::Error;
};

// An output path whose folder does not exist, or that is not a file.
class PathError : public Error {
  using Error::Error;
};

// A device that fails or is full.
class DeviceError : public Error {
  using Error::Error;
};

// Text of a file for a message: at most 40 characters, with non-printable ones escaped.
[[nodiscard]] std::string escaped(std::string_view text);
// The same in quotes.
[[nodiscard]] std::string shown(std::string_view text);

}  // namespace groma::io
