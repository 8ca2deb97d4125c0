// What commands say: results to standard output, complaints and warnings to standard error.
#pragma once

#include <cstddef>
#include <string>
#include <string_view>
#include <vector>

namespace groma::cli {

// To standard output as it is.
void say(std::string_view text);
// Throws io::DeviceError if what was said cannot be written.
void flush_output();

// "groma: text" to standard error.
void complain(std::string_view text);

// Columns of text, right-aligned but for the first, with a line of titles.
class Table {
 public:
  explicit Table(std::vector<std::string> titles) : rows_{std::move(titles)} {}
  // As many cells as there are titles.
  void add(std::vector<std::string> cells) { rows_.push_back(std::move(cells)); }
  // Ends with a new line; the last column is left-aligned if `text_last`.
  [[nodiscard]] std::string format(bool text_last = false) const;

 private:
  std::vector<std::vector<std::string>> rows_;
};

}  // namespace groma::cli
