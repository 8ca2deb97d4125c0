// Strict, fast reading of comma-separated tables: columns by header name in any order, further columns
// allowed, CRLF and a byte order mark tolerated, blank lines and lines that begin with # left out.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <initializer_list>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/io/error.hpp"

namespace groma::io {

// Lines of a text, one by one, with what is blank or a comment left out.
class LineReader {
 public:
  explicit LineReader(std::string_view text) : rest_(text) {}

  // Goes to the next line, without its end; false when there is none.
  bool next();
  [[nodiscard]] std::string_view line() const { return line_; }
  [[nodiscard]] std::size_t number() const { return number_; }  // from 1

 private:
  std::string_view rest_;
  std::string_view line_;
  std::size_t number_ = 0;
};

// Number in a field; throws DataError at `place` unless the whole field is one finite number.
[[nodiscard]] double parse_number(std::string_view field, const FilePlace& place);
// The same for a whole number.
[[nodiscard]] std::int64_t parse_integer(std::string_view field, const FilePlace& place);

class CsvReader {
 public:
  enum class Presence { kRequired, kOptional };
  struct Column {
    std::string_view name;
    Presence presence = Presence::kRequired;
  };

  // Reads the header; `text` outlives the reader. Throws DataError if the text is empty or the header lacks
  // a required column or has a wanted one twice.
  CsvReader(std::filesystem::path path, std::string_view text, std::initializer_list<Column> columns);

  // Goes to the next row; false at the end. Throws DataError if its number of fields is not the header's.
  bool next();

  // Fields of this row, by the column's index in the constructor's list. Text, NaN and infinity throw
  // DataError with line and column.
  [[nodiscard]] double number(std::size_t column) const;
  [[nodiscard]] std::int64_t integer(std::size_t column) const;
  // None where the column is absent, or its field is empty or NaN: unknown.
  [[nodiscard]] std::optional<double> optional_number(std::size_t column) const;
  [[nodiscard]] std::optional<std::int64_t> optional_integer(std::size_t column) const;

  // False where the column is absent or its field is empty.
  [[nodiscard]] bool has(std::size_t column) const;

  // Place of the row, or of one of its fields.
  [[nodiscard]] FilePlace row_place() const { return {path_, lines_.number(), 0}; }
  [[nodiscard]] FilePlace place(std::size_t column) const;

 private:
  static constexpr std::size_t kAbsent = static_cast<std::size_t>(-1);

  std::filesystem::path path_;
  LineReader lines_;
  std::vector<std::string_view> names_;
  std::size_t header_fields_ = 0;
  std::vector<std::size_t> wanted_of_field_;  // index into fields_, or kAbsent
  std::vector<std::size_t> field_of_wanted_;  // index into the row, or kAbsent
  std::vector<std::string_view> fields_;      // of this row, in the order of the constructor's list
};

}  // namespace groma::io
