// What can go wrong at a file: each kind is an exception of its own, and each message names the place and
// says what to do.
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

// "path:line:column", as compilers print it, without the parts that are unknown.
[[nodiscard]] std::string to_string(const FilePlace& place);

class Error : public std::runtime_error {
 public:
  // The message is "place: problem; remedy".
  Error(const FilePlace& place, std::string_view problem, std::string_view remedy);
};

// Data that cannot be read.
class DataError : public Error {
  using Error::Error;
};

// A configuration, or another YAML file, that is not as it has to be.
class ConfigError : public Error {
  using Error::Error;
};

// A file that may not be read or written.
class PermissionError : public Error {
  using Error::Error;
};

// A place to write to that does not exist, or is no file.
class PathError : public Error {
  using Error::Error;
};

// A device that fails or is full.
class DeviceError : public Error {
  using Error::Error;
};

// Text of a file as it may stand in a message: short, and printable whatever it holds.
[[nodiscard]] std::string shown(std::string_view text);

}  // namespace groma::io
