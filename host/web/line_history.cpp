#include "host/web/line_history.hpp"

#include <algorithm>

namespace groma::web {

LineHistory::LineHistory(std::size_t bytes, std::size_t texts, double age_s)
    : bytes_(bytes), texts_(texts), age_s_(age_s) {}

std::string_view LineHistory::at(std::uint64_t number) const noexcept {
  return {bytes_.data() + text(number).offset, text(number).size};
}

void LineHistory::push(std::string_view text_to_keep, double now_s) {
  while (begin_ < end_ && text(begin_).at_s < now_s - age_s_) ++begin_;
  const std::size_t size = text_to_keep.size();
  if (size == 0 || size > bytes_.size()) return;
  if (next_ + size > bytes_.size()) {  // each text is in one piece
    free(next_, bytes_.size() - next_);
    next_ = 0;
  }
  free(next_, size);
  if (end_ - begin_ == texts_.size()) ++begin_;
  std::copy(text_to_keep.begin(), text_to_keep.end(), bytes_.begin() + static_cast<std::ptrdiff_t>(next_));
  texts_[end_ % texts_.size()] = {next_, size, now_s};
  ++end_;
  next_ += size;
}

// Texts lie in the order of their numbers, so that those in the way are the oldest.
void LineHistory::free(std::size_t offset, std::size_t size) {
  while (begin_ < end_ && text(begin_).offset < offset + size &&
         text(begin_).offset + text(begin_).size > offset)
    ++begin_;
}

}  // namespace groma::web
