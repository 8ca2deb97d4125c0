// Reads whole files into memory, and computes a digest that identifies them.
#pragma once

#include <filesystem>
#include <map>
#include <string>
#include <string_view>
#include <utility>

namespace groma::io {

// Also reads a pipe, up to its end. Throws DataError (missing, a folder, unreadable, a pipe without a writer,
// or a non-regular file longer than 64 MiB) or PermissionError.
[[nodiscard]] std::string read_file(const std::filesystem::path& path);

// Like read_file(), for a configuration: throws ConfigError where the file does not exist.
[[nodiscard]] std::string read_configuration(const std::filesystem::path& path);

// Hexadecimal SHA-256.
[[nodiscard]] std::string sha256(std::string_view bytes);

// Reads files and stores their digests.
class InputFiles {
 public:
  using Texts = std::map<std::filesystem::path, std::string>;

  InputFiles() = default;
  // Keeps the texts that it reads; those given take precedence over the disk.
  explicit InputFiles(Texts given) : provided_(std::move(given)), keeps_texts_(true) {}

  // Like read_file(); a provided text takes precedence over the disk.
  [[nodiscard]] std::string read(const std::filesystem::path& path);

  // Sets the text of a file that does not exist on the disk.
  void provide(const std::filesystem::path& path, std::string text);
  // The texts given, provided and kept.
  [[nodiscard]] const Texts& texts() const noexcept { return provided_; }

  // One digest of all files read so far, equal to that of `sha256sum FILES | sha256sum` with the bare file
  // names in alphabetical order. Files with the same name count once.
  [[nodiscard]] std::string digest() const;

 private:
  std::map<std::string, std::string> digest_by_name_;
  Texts provided_;
  bool keeps_texts_ = false;
};

}  // namespace groma::io
