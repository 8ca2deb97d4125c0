// Strict, fast reader of comma-separated tables. Columns are found by header name in any order; further
// columns are allowed, CRLF and a byte order mark are tolerated, blank lines and lines that begin with # are
// skipped.
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

// Of UTF-8, which some programs write before a text.
inline constexpr std::string_view kByteOrderMark = "\xef\xbb\xbf";

// Iterates over the lines of a text; skips blank lines and comments.
class LineReader {
 public:
  explicit LineReader(std::string_view text) : rest_(text) {}

  // Advances to the next line, which excludes its line end; false at the end of the text.
  bool next();
  [[nodiscard]] std::string_view line() const { return line_; }
  [[nodiscard]] std::size_t number() const { return number_; }  // from 1

 private:
  std::string_view rest_;
  std::string_view line_;
  std::size_t number_ = 0;
};

// The number in a field. Throws DataError at `place` unless the whole field is one finite number.
[[nodiscard]] double parse_number(std::string_view field, const FilePlace& place);
// The whole number in a field. Throws DataError at `place` unless the field is one.
[[nodiscard]] std::int64_t parse_integer(std::string_view field, const FilePlace& place);

class CsvReader {
 public:
  enum class Presence { kRequired, kOptional };
  struct Column {
    std::string_view name;
    Presence presence = Presence::kRequired;
  };

  // Reads the header; `text` has to outlive the reader. Throws DataError if the text is empty, if the header
  // lacks a required column, or if one of `columns` occurs twice.
  CsvReader(std::filesystem::path path, std::string_view text, std::initializer_list<Column> columns);

  // Advances to the next row; false at the end. Throws DataError if its number of fields differs from the
  // header's.
  bool next();

  // A field of the current row; `column` is the index in the constructor's list. Text, NaN and infinity throw
  // DataError with line and column.
  [[nodiscard]] double number(std::size_t column) const;
  [[nodiscard]] std::int64_t integer(std::size_t column) const;
  // None (unknown) if the column is absent or its field is empty; optional_number() also for NaN.
  [[nodiscard]] std::optional<double> optional_number(std::size_t column) const;
  [[nodiscard]] std::optional<std::int64_t> optional_integer(std::size_t column) const;

  // The field as it is; empty if the column is absent.
  [[nodiscard]] std::string_view text(std::size_t column) const;

  // False if the column is absent or its field is empty.
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
  std::vector<std::string_view> fields_;      // of the current row, in the order of the constructor's list
};

}  // namespace groma::io
