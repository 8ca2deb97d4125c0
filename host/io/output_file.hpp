// Files out: whole, or not at all.
#pragma once

#include <filesystem>
#include <string_view>

namespace groma::io {

// Throws as write_file() would if it is plain already that it will fail: for before the long work.
void expect_writable(const std::filesystem::path& path);

// Replaces the file in one step: a temporary file beside it, flushed to the disk, then renamed, so that a
// reader, a crash or a full disk never meets half a file. What is no regular file (/dev/stdout) is written
// directly. Throws PathError (no such folder, or a folder itself), PermissionError or DeviceError; the old
// content is then untouched.
void write_file(const std::filesystem::path& path, std::string_view content);

// Makes the folder, and those above it, unless it is there. Throws as write_file().
void make_folder(const std::filesystem::path& path);

}  // namespace groma::io
