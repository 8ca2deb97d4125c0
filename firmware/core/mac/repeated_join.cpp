#include "firmware/core/mac/repeated_join.hpp"

#include <algorithm>
#include <utility>

#include "firmware/core/mac/hash.hpp"

namespace groma::mac {

std::uint16_t RepeatedJoin::draw(std::uint32_t number) const noexcept {
  const std::uint32_t h = mix(number ^ (std::uint32_t{id_} << 16 | std::uint32_t{id_} >> 3) ^ salt_);
  return static_cast<std::uint16_t>(h & ((1U << left_.first_window_log2) - 1U));
}

void RepeatedJoin::want(const Join& join, const Repetition& repetition, std::uint32_t number) noexcept {
  join_ = join;
  if (std::exchange(pending_, true)) return;
  left_ = repetition;
  wait_ = draw(number);
}

std::optional<ControlChannel::Outgoing> RepeatedJoin::turn(std::uint32_t number) noexcept {
  if (!pending_) return std::nullopt;
  if (wait_ > 0) {
    --wait_;
    return std::nullopt;
  }
  under_way_ = true;
  pending_ = left_.times != 1;
  if (left_.times > 1) --left_.times;
  if (left_.first_window_log2 < left_.last_window_log2) ++left_.first_window_log2;
  wait_ = draw(number);
  Join join = join_;
  // Unique for each request and node.
  if (join.nonce == 0) join.nonce = std::uint64_t{id_} << 32 | number;
  return ControlChannel::Outgoing{.body = join};
}

std::optional<ControlChannel::Outgoing> RepeatedJoin::take() noexcept {
  if (!std::exchange(pending_, false)) return std::nullopt;
  under_way_ = true;
  return ControlChannel::Outgoing{.body = join_};
}

void RepeatedJoin::on_sent(bool sent) noexcept {
  if (!std::exchange(under_way_, false) || sent) return;
  if (!std::exchange(pending_, true)) {
    left_.times = 1;
  } else if (left_.times > 0) {
    ++left_.times;
  }
  wait_ = 0;
}

}  // namespace groma::mac
