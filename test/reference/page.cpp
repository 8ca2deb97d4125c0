#include "test/reference/page.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>
#include <fstream>
#include <sstream>

namespace groma::reference {
namespace {

std::vector<std::string> cells_of(const std::string& line) {
  std::vector<std::string> cells;
  std::string cell;
  for (const char c : line.substr(1)) {
    if (c == '|') {
      cells.push_back(trimmed(cell));
      cell.clear();
    } else if (c != '`') {
      cell += c;
    }
  }
  return cells;
}

bool starts_with(const std::string& line, std::string_view start) {
  return std::string_view(line).substr(0, start.size()) == start;
}

std::string heading_in(const std::string& line) {
  return trimmed(line.substr(line.find_first_not_of('#')));
}

}  // namespace

std::string trimmed(std::string_view text) {
  const auto begin = text.find_first_not_of(' ');
  if (begin == std::string_view::npos) return {};
  return std::string(text.substr(begin, text.find_last_not_of(' ') - begin + 1));
}

std::vector<std::string> lines_of(const std::string& path) {
  std::ifstream file(std::string(GROMA_SOURCE_DIR) + "/" + path);
  EXPECT_TRUE(file.is_open()) << path;
  std::vector<std::string> lines;
  for (std::string line; std::getline(file, line);) lines.push_back(line);
  return lines;
}

double number(const std::string& text) {
  char* end = nullptr;
  const double value = std::strtod(text.c_str(), &end);
  EXPECT_NE(end, text.c_str()) << "no number: " << text;
  return value;
}

Bytes bytes_in(std::string_view hex) {
  Bytes bytes;
  std::istringstream words{std::string(hex)};
  for (std::string word; words >> word;) {
    EXPECT_EQ(word.size(), 2U) << hex;
    bytes.push_back(static_cast<std::uint8_t>(std::strtoul(word.c_str(), nullptr, 16)));
  }
  return bytes;
}

std::uint64_t little_endian(const Bytes& bytes) {
  std::uint64_t value = 0;
  for (std::size_t i = 0; i < bytes.size(); ++i) value |= std::uint64_t{bytes[i]} << (8 * i);
  return value;
}

Page::Page(const std::string& name) : lines_(lines_of("docs/reference/" + name)) {
  std::string heading;
  bool fenced = false;
  bool in_table = false;
  for (const std::string& line : lines_) {
    if (starts_with(line, "```")) fenced = !fenced;
    if (!fenced && starts_with(line, "#")) heading = heading_in(line);
    const bool row = !fenced && starts_with(line, "|");
    if (row && !in_table) {
      tables_.push_back({heading, cells_of(line), {}});
    } else if (row && !starts_with(line, "|---")) {
      tables_.back().rows.push_back(cells_of(line));
      EXPECT_EQ(tables_.back().rows.back().size(), tables_.back().columns.size()) << line;
    }
    in_table = row;
  }
}

Table Page::table(std::string_view first, std::string_view last, std::string_view heading) const {
  const auto fits = [&](const Table& table) {
    return table.columns.front() == first && table.columns.back() == last &&
           (heading.empty() || table.heading == heading);
  };
  const auto count = std::count_if(tables_.begin(), tables_.end(), fits);
  EXPECT_EQ(count, 1) << first << " ... " << last << ", under " << heading;
  return count == 1 ? *std::find_if(tables_.begin(), tables_.end(), fits) : Table{};
}

std::vector<std::string> Page::indented(std::string_view heading) const {
  std::vector<std::string> found;
  bool inside = false;
  bool fenced = false;
  for (const std::string& line : lines_) {
    if (starts_with(line, "```")) fenced = !fenced;
    if (!fenced && starts_with(line, "#")) inside = heading_in(line) == heading;
    if (inside && !fenced && starts_with(line, "    ")) found.push_back(trimmed(line));
  }
  EXPECT_FALSE(found.empty()) << heading;
  return found;
}

Bytes Page::example(std::string_view name) const {
  const std::string title = "Example `" + std::string(name) + "`:";
  const auto line = std::find_if(lines_.begin(), lines_.end(),
                                 [&](const std::string& text) { return starts_with(text, title); });
  const auto is_fence = [](const std::string& text) { return starts_with(text, "```"); };
  const auto begin = std::find_if(line, lines_.end(), is_fence);
  EXPECT_NE(begin, lines_.end()) << title;
  if (begin == lines_.end()) return {};
  std::string hex;
  for (auto i = begin + 1; i != lines_.end() && !is_fence(*i); ++i) hex += i->substr(0, i->find(';')) + " ";
  return bytes_in(hex);
}

bool Page::contains(std::string_view text) const {
  return std::any_of(lines_.begin(), lines_.end(),
                     [&](const std::string& line) { return line.find(text) != std::string::npos; });
}

}  // namespace groma::reference
