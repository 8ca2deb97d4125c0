#include "firmware/core/mac/open_slot_queue.hpp"

#include <algorithm>
#include <utility>

#include "firmware/core/mac/hash.hpp"

namespace groma::mac {

std::uint16_t OpenSlotQueue::draw(Purpose purpose, std::uint32_t number) const noexcept {
  const std::uint32_t h = mix(number ^ (std::uint32_t{id_} << 16 | std::uint32_t{id_} >> 3) ^
                              static_cast<std::uint32_t>(purpose) * 0x9E37'79B9U);
  return static_cast<std::uint16_t>(h & ((1U << at(purpose).left.first_window_log2) - 1U));
}

void OpenSlotQueue::want(Purpose purpose, const Join& join, const Repetition& repetition,
                         std::uint32_t number) noexcept {
  Pending& p = at(purpose);
  p.join = join;
  if (p.pending) return;
  p.pending = true;
  p.left = repetition;
  p.wait = draw(purpose, number);
}

std::optional<Join> OpenSlotQueue::turn(std::uint32_t number) noexcept {
  under_way_.reset();
  for (std::size_t i = 0; i < kPurposes; ++i) {
    Pending& p = pending_[i];
    if (!p.pending) continue;
    if (p.wait > 0) {
      --p.wait;
    } else if (!under_way_) {
      under_way_ = static_cast<Purpose>(i);
      repeat_later(*under_way_, number);
    }
  }
  if (!under_way_) return std::nullopt;
  Join join = at(*under_way_).join;
  // Unique for each request and node.
  if (join.nonce == 0) join.nonce = std::uint64_t{id_} << 32 | number;
  return join;
}

void OpenSlotQueue::repeat_later(Purpose purpose, std::uint32_t number) noexcept {
  Pending& p = at(purpose);
  if (p.left.times == 1) {
    p.pending = false;
    return;
  }
  if (p.left.times > 1) --p.left.times;
  p.left.first_window_log2 =
      std::min(static_cast<std::uint8_t>(p.left.first_window_log2 + 1), p.left.last_window_log2);
  p.wait = draw(purpose, number);
}

std::optional<Join> OpenSlotQueue::take(Purpose purpose) noexcept {
  if (!pending(purpose)) return std::nullopt;
  settle(purpose);
  under_way_ = purpose;
  return join(purpose);
}

void OpenSlotQueue::on_sent(bool sent) noexcept {
  const auto purpose = std::exchange(under_way_, std::nullopt);
  if (sent || !purpose) return;
  Pending& p = at(*purpose);
  if (!p.pending) {
    p.pending = true;
    p.left.times = 1;
  } else if (p.left.times > 0) {
    ++p.left.times;
  }
  p.wait = 0;
}

}  // namespace groma::mac
