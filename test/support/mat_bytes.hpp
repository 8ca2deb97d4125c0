// A MAT file of level 4 (MATLAB, "MAT-File Format", appendix), written without a library.
#pragma once

#include <bit>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

namespace groma::test {

// An array of doubles; `rows` have one length. Arrays follow each other in a file.
[[nodiscard]] inline std::string mat_array(std::string_view name,
                                           const std::vector<std::vector<double>>& rows) {
  std::string bytes;
  const auto put = [&](std::uint64_t value, int size) {
    for (int i = 0; i < size; ++i) bytes += static_cast<char>(value >> (8 * i) & 0xFF);
  };
  put(0, 4);  // little-endian, doubles, a full matrix
  put(rows.size(), 4);
  put(rows.front().size(), 4);
  put(0, 4);  // real
  put(name.size() + 1, 4);
  bytes += name;
  bytes += '\0';
  for (std::size_t column = 0; column < rows.front().size(); ++column)
    for (const std::vector<double>& row : rows) put(std::bit_cast<std::uint64_t>(row[column]), 8);
  return bytes;
}

}  // namespace groma::test
