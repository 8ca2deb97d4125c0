// Atomic output files.
#pragma once

#include <filesystem>
#include <string_view>

namespace groma::io {

// Throws as write_file() if writing would certainly fail. Call it before long computations.
void expect_writable(const std::filesystem::path& path);

// Replaces the file atomically: writes a temporary file beside it, flushes it to the disk and renames it, so
// that neither a reader nor a crash nor a full disk leaves a partial file. A non-regular file (/dev/stdout)
// is written directly. Throws PathError (no such folder, or a folder itself), PermissionError or DeviceError;
// the old content then remains.
void write_file(const std::filesystem::path& path, std::string_view content);

// Removes the temporary files that write_file() left beside `path` in processes that were killed.
void remove_left_files(const std::filesystem::path& path) noexcept;

// Creates the folder and its parents if they do not exist. Throws as write_file().
void make_folder(const std::filesystem::path& path);

}  // namespace groma::io
