// The last texts of a stream in a fixed amount of memory, for clients that come later.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string_view>
#include <vector>

namespace groma::web {

class LineHistory {
 public:
  // Keeps at most this many bytes and texts, and none that is older than age_s. All memory is taken here.
  LineHistory(std::size_t bytes, std::size_t texts, double age_s);

  // now_s never decreases. Without the heap. An empty text, and one longer than all the memory, are left out.
  void push(std::string_view text, double now_s);

  // Texts are numbered from 0 on; those from begin() to end() are kept.
  [[nodiscard]] std::uint64_t begin() const noexcept { return begin_; }
  [[nodiscard]] std::uint64_t end() const noexcept { return end_; }
  // begin() <= number < end(). Valid until the next push().
  [[nodiscard]] std::string_view at(std::uint64_t number) const noexcept;

 private:
  struct Text {
    std::size_t offset = 0;
    std::size_t size = 0;
    double at_s = 0.0;
  };
  [[nodiscard]] const Text& text(std::uint64_t number) const noexcept {
    return texts_[number % texts_.size()];
  }
  // Drops the oldest texts as long as they lie within these bytes.
  void free(std::size_t offset, std::size_t size);

  std::vector<char> bytes_;
  std::vector<Text> texts_;  // number modulo size
  double age_s_;
  std::size_t next_ = 0;  // offset of the next text
  std::uint64_t begin_ = 0;
  std::uint64_t end_ = 0;
};

}  // namespace groma::web
