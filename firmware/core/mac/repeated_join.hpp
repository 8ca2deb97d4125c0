// A JOIN that a node has to send in the shared slots that are open to all, and the back-off between its
// repetitions.
//
// After each transmission a node draws one of the next open slots, from a window twice as large as before,
// until it knows that its frame came through or has repeated it often enough
// (docs/explanation/joining.md#back-off-in-the-open-slots).
#pragma once

#include <algorithm>
#include <cstdint>
#include <optional>
#include <utility>

#include "firmware/core/mac/control_channel.hpp"
#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/hash.hpp"

namespace groma::mac {

struct Repetition {
  std::uint8_t first_window_log2 = 0;  // the first transmission is in one of 2^this open slots
  std::uint8_t last_window_log2 = 4;   // up to 15
  std::uint8_t times = 0;              // most transmissions; 0: until settle()
};

class RepeatedJoin {
 public:
  // `salt`: different for each of a node's JOINs, so that they draw different slots.
  explicit RepeatedJoin(std::uint16_t id, std::uint32_t salt) noexcept
      : id_(id), salt_(salt * 0x9E37'79B9U) {}

  // Requests transmissions of `join` from superframe `number` on. If its nonce is 0, each transmission gets
  // one of its own. If one is pending already, only the JOIN is replaced.
  void want(const Join& join, const Repetition& repetition, std::uint32_t number) noexcept {
    join_ = join;
    if (std::exchange(pending_, true)) return;
    left_ = repetition;
    wait_ = draw(number);
  }
  // The JOIN came through, or is not needed any more.
  void settle() noexcept { pending_ = false; }
  [[nodiscard]] bool pending() const noexcept { return pending_; }
  // The JOIN last wanted.
  [[nodiscard]] const Join& join() const noexcept { return join_; }

  // Call once for each superframe `number` whose open slot comes next. Returns what this node sends in it.
  [[nodiscard]] std::optional<ControlChannel::Outgoing> turn(std::uint32_t number) noexcept {
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
  // Returns the pending JOIN for a slot in which no other node sends; it need not be repeated.
  [[nodiscard]] std::optional<ControlChannel::Outgoing> take() noexcept {
    if (!std::exchange(pending_, false)) return std::nullopt;
    under_way_ = true;
    return ControlChannel::Outgoing{.body = join_};
  }
  // The JOIN of turn() or take() was sent, or was too late for its slot: then it gets the next one.
  void on_sent(bool sent) noexcept {
    if (!std::exchange(under_way_, false) || sent) return;
    if (!std::exchange(pending_, true)) {
      left_.times = 1;
    } else if (left_.times > 0) {
      ++left_.times;
    }
    wait_ = 0;
  }

 private:
  // The open slots to skip, before superframe `number`, for the first window of what is left.
  [[nodiscard]] std::uint16_t draw(std::uint32_t number) const noexcept {
    const std::uint32_t h = mix(number ^ (std::uint32_t{id_} << 16 | std::uint32_t{id_} >> 3) ^ salt_);
    return static_cast<std::uint16_t>(h & ((1U << left_.first_window_log2) - 1U));
  }

  std::uint16_t id_;
  std::uint32_t salt_;
  Join join_{};
  bool pending_ = false;
  bool under_way_ = false;
  Repetition left_{};       // from the next transmission on
  std::uint16_t wait_ = 0;  // open slots to skip
};

}  // namespace groma::mac
