// Reads a page of docs/reference, so that a test can compare it with the code.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

namespace groma::reference {

using Bytes = std::vector<std::uint8_t>;

// A table; cells are trimmed and without backticks.
struct Table {
  std::string heading;  // the nearest above it
  std::vector<std::string> columns;
  std::vector<std::vector<std::string>> rows;
};

class Page {
 public:
  // `name`: of the file in docs/reference. A page that cannot be read is empty, and fails a test.
  explicit Page(const std::string& name);

  [[nodiscard]] const std::vector<Table>& tables() const noexcept { return tables_; }
  // The table with this first and last column, under the heading or, without one, anywhere. An empty table
  // and a failed test if there is not exactly one.
  [[nodiscard]] Table table(std::string_view first, std::string_view last,
                            std::string_view heading = {}) const;
  // The indented lines under the heading, without the indentation.
  [[nodiscard]] std::vector<std::string> indented(std::string_view heading) const;
  // The bytes of the fenced block that follows "Example `name`", without the comments after semicolons.
  [[nodiscard]] Bytes example(std::string_view name) const;
  // The page contains the text, on one line.
  [[nodiscard]] bool contains(std::string_view text) const;

 private:
  std::vector<std::string> lines_;
  std::vector<Table> tables_;
};

// A file of the source tree, by lines; a failed test if it cannot be read.
[[nodiscard]] std::vector<std::string> lines_of(const std::string& path);

[[nodiscard]] std::string trimmed(std::string_view text);
// The first number of the text, decimal or 0x...; a failed test if the text does not begin with one.
[[nodiscard]] double number(const std::string& text);
// Bytes of two hexadecimal digits each, separated by blanks.
[[nodiscard]] Bytes bytes_in(std::string_view hex);
// The little-endian number in at most eight bytes.
[[nodiscard]] std::uint64_t little_endian(const Bytes& bytes);

}  // namespace groma::reference
