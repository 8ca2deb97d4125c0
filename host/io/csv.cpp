#include "host/io/csv.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <system_error>
#include <utility>

namespace groma::io {

namespace {

std::string_view trimmed(std::string_view text) {
  const auto blank = [](char c) { return c == ' ' || c == '\t' || c == '\r'; };
  while (!text.empty() && blank(text.front())) text.remove_prefix(1);
  while (!text.empty() && blank(text.back())) text.remove_suffix(1);
  return text;
}

// Removes the first field and its comma from a line, and returns the field. `more`: whether another follows.
std::string_view take_field(std::string_view& line, bool& more) {
  const std::size_t comma = line.find(',');
  more = comma != std::string_view::npos;
  const std::string_view field = line.substr(0, comma);
  line = more ? line.substr(comma + 1) : std::string_view();
  return field;
}

template <typename Number>
std::errc parse_whole(std::string_view field, Number& value) {
  const char* const end = field.data() + field.size();
  const auto [last, error] = std::from_chars(field.data(), end, value);
  if (error != std::errc()) return error;
  return last == end ? std::errc() : std::errc::invalid_argument;
}

// from_chars does not accept a leading plus.
std::string_view without_plus(std::string_view field) {
  return field.size() > 1 && field.front() == '+' && field[1] != '-' ? field.substr(1) : field;
}

}  // namespace

bool LineReader::next() {
  while (!rest_.empty()) {
    const std::size_t end = rest_.find('\n');
    line_ = rest_.substr(0, end);
    rest_ = end == std::string_view::npos ? std::string_view() : rest_.substr(end + 1);
    ++number_;
    if (number_ == 1 && line_.starts_with(kByteOrderMark)) line_.remove_prefix(kByteOrderMark.size());
    if (!line_.empty() && line_.back() == '\r') line_.remove_suffix(1);
    const std::size_t first = line_.find_first_not_of(" \t\r");
    if (first != std::string_view::npos && line_[first] != '#') return true;
  }
  line_ = {};
  return false;
}

double parse_number(std::string_view field, const FilePlace& place) {
  const std::string_view text = without_plus(trimmed(field));
  double value = 0.0;
  const std::errc error = parse_whole(text, value);
  if (error == std::errc::result_out_of_range) {
    throw DataError(place, fmt::format("{} is out of range", shown(text)),
                    "write a number that fits a double");
  }
  if (error != std::errc()) {
    throw DataError(place,
                    text.empty() ? "the field is empty" : fmt::format("{} is not a number", shown(text)),
                    "write a number such as 1.25, or remove the row");
  }
  if (!std::isfinite(value)) {
    throw DataError(place, fmt::format("{} is not a finite number", shown(text)), "remove the row");
  }
  return value;
}

std::int64_t parse_integer(std::string_view field, const FilePlace& place) {
  const std::string_view text = without_plus(trimmed(field));
  std::int64_t value = 0;
  if (parse_whole(text, value) != std::errc()) {
    throw DataError(
        place, text.empty() ? "the field is empty" : fmt::format("{} is not a whole number", shown(text)),
        "write a whole number, or remove the row");
  }
  return value;
}

CsvReader::CsvReader(std::filesystem::path path, std::string_view text, std::initializer_list<Column> columns)
    : path_(std::move(path)),
      lines_(text),
      field_of_wanted_(columns.size(), kAbsent),
      fields_(columns.size()) {
  for (const Column& column : columns) names_.push_back(column.name);
  std::string wanted;
  for (const Column& column : columns) {
    if (column.presence == Presence::kRequired)
      wanted += (wanted.empty() ? "" : ",") + std::string(column.name);
  }
  if (!lines_.next()) {
    throw DataError({path_, 1, 0}, "the file is empty",
                    fmt::format("its first line has to be the header {}", wanted));
  }

  std::string_view line = lines_.line();
  bool more = true;
  while (more) {
    const char* const begin = line.data();
    const std::string_view name = trimmed(take_field(line, more));
    const auto found = std::find(names_.begin(), names_.end(), name);
    std::size_t index = kAbsent;
    if (found != names_.end()) {
      index = static_cast<std::size_t>(found - names_.begin());
      if (field_of_wanted_[index] != kAbsent) {
        throw DataError({path_, lines_.number(), static_cast<std::size_t>(begin - lines_.line().data()) + 1},
                        fmt::format("column {} occurs twice", name), "keep one of them");
      }
      field_of_wanted_[index] = header_fields_;
    }
    wanted_of_field_.push_back(index);
    ++header_fields_;
  }

  std::size_t index = 0;
  for (const Column& column : columns) {
    if (column.presence == Presence::kRequired && field_of_wanted_[index] == kAbsent) {
      throw DataError({path_, lines_.number(), 1}, fmt::format("column {} is missing", column.name),
                      fmt::format("the header has to name {}", wanted));
    }
    ++index;
  }
}

bool CsvReader::next() {
  if (!lines_.next()) return false;
  std::string_view line = lines_.line();
  std::size_t count = 0;
  bool more = true;
  while (more) {
    const std::string_view field = take_field(line, more);
    if (count < header_fields_ && wanted_of_field_[count] != kAbsent)
      fields_[wanted_of_field_[count]] = field;
    ++count;
  }
  if (count != header_fields_) {
    throw DataError({path_, lines_.number(), lines_.line().size() + 1},
                    fmt::format("the row has {} fields, the header {}", count, header_fields_),
                    "complete the row, or remove it");
  }
  return true;
}

double CsvReader::number(std::size_t column) const {
  const std::string_view field = fields_[column];
  double value = 0.0;
  // Common case first: constructing the place would allocate.
  if (parse_whole(field, value) == std::errc() && std::isfinite(value)) return value;
  return parse_number(field, place(column));
}

std::int64_t CsvReader::integer(std::size_t column) const {
  const std::string_view field = fields_[column];
  std::int64_t value = 0;
  if (parse_whole(field, value) == std::errc()) return value;
  return parse_integer(field, place(column));
}

std::optional<double> CsvReader::optional_number(std::size_t column) const {
  if (!has(column)) return std::nullopt;
  double value = 0.0;
  if (parse_whole(trimmed(fields_[column]), value) == std::errc() && std::isnan(value)) return std::nullopt;
  return number(column);
}

std::optional<std::int64_t> CsvReader::optional_integer(std::size_t column) const {
  if (!has(column)) return std::nullopt;
  return integer(column);
}

std::string_view CsvReader::text(std::size_t column) const {
  return has(column) ? fields_[column] : std::string_view{};
}

bool CsvReader::has(std::size_t column) const {
  return field_of_wanted_[column] != kAbsent && !trimmed(fields_[column]).empty();
}

FilePlace CsvReader::place(std::size_t column) const {
  const std::string_view field = fields_[column];
  const std::size_t blanks = std::min(field.find_first_not_of(" \t\r"), field.size());
  const auto offset = static_cast<std::size_t>(field.data() - lines_.line().data());
  return {path_, lines_.number(), offset + blanks + 1};
}

}  // namespace groma::io
