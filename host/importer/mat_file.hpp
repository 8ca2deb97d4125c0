// Arrays of MAT files, as MATLAB and its like write them.
#pragma once

#include <filesystem>
#include <string>

namespace groma::importer {

// A matrix of real numbers as text: a row a line, blanks between the numbers, which are exact. Throws
// io::PermissionError, or io::DataError (no MAT file, no such array, or it is no matrix of real numbers).
[[nodiscard]] std::string read_mat_array(const std::filesystem::path& path, const std::string& name);

}  // namespace groma::importer
