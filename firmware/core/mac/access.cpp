#include "firmware/core/mac/access.hpp"

#include <algorithm>

#include "firmware/core/mac/hash.hpp"

namespace groma::mac {

std::uint16_t Access::draw(std::size_t purpose, std::uint32_t number,
                           std::uint8_t window_log2) const noexcept {
  const std::uint32_t h = mix(number ^ (std::uint32_t{id_} << 16 | std::uint32_t{id_} >> 3) ^
                              static_cast<std::uint32_t>(purpose) * 0x9E37'79B9U);
  return static_cast<std::uint16_t>(h & ((1U << window_log2) - 1U));
}

void Access::want(Purpose purpose, const Persistence& persistence, std::uint32_t number) noexcept {
  Pending& p = at(purpose);
  if (p.pending) return;
  p = {.pending = true,
       .window_log2 = persistence.first_window_log2,
       .last_window_log2 = persistence.last_window_log2,
       .times_left = persistence.times,
       .wait = draw(static_cast<std::size_t>(purpose), number, persistence.first_window_log2)};
}

std::optional<Purpose> Access::turn(std::uint32_t number) noexcept {
  std::optional<Purpose> sent;
  for (std::size_t i = 0; i < kPurposes; ++i) {
    Pending& p = pending_[i];
    if (!p.pending) continue;
    if (p.wait > 0) {
      --p.wait;
      continue;
    }
    if (sent) continue;
    sent = static_cast<Purpose>(i);
    if (p.times_left == 1) {
      p.pending = false;
      continue;
    }
    if (p.times_left > 1) --p.times_left;
    p.window_log2 = std::min<std::uint8_t>(static_cast<std::uint8_t>(p.window_log2 + 1), p.last_window_log2);
    p.wait = draw(i, number, p.window_log2);
  }
  return sent;
}

void Access::missed(Purpose purpose) noexcept {
  Pending& p = at(purpose);
  if (!p.pending) {
    p.pending = true;
    p.times_left = 1;
  } else if (p.times_left > 0) {
    ++p.times_left;
  }
  p.wait = 0;
}

}  // namespace groma::mac
