// The JOINs that a node has to send in the shared slots that are open to all, and the back-off between their
// repetitions.
//
// A node does not know which others want the slot, and cannot hear a collision. After each transmission it
// therefore draws one of the next open slots, from a window twice as large as before, until it knows that its
// frame came through or has repeated it often enough. The draw is a hash of the node, the purpose and the
// superframe: it needs no source of randomness, differs between nodes, and is equal in each replay.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>

#include "firmware/core/mac/frame.hpp"

namespace groma::mac {

// Purposes for which a node may have a JOIN pending, at most one each, in order of priority.
enum class Purpose : std::uint8_t { kLeave, kJoin, kPassOn, kAnnounce };
inline constexpr std::size_t kPurposes = 4;

struct Repetition {
  std::uint8_t first_window_log2 = 0;  // the first transmission is in one of 2^this open slots
  std::uint8_t last_window_log2 = 4;   // up to 15
  std::uint8_t times = 0;              // most transmissions; 0: until settle()
};

class OpenSlotQueue {
 public:
  explicit OpenSlotQueue(std::uint16_t id) noexcept : id_(id) {}

  // Requests transmissions of `join` from superframe `number` on. If its nonce is 0, each transmission gets
  // one of its own. If the purpose is pending already, only the JOIN is replaced.
  void want(Purpose purpose, const Join& join, const Repetition& repetition, std::uint32_t number) noexcept;
  // The JOIN came through, or is not needed any more.
  void settle(Purpose purpose) noexcept { at(purpose).pending = false; }
  [[nodiscard]] bool pending(Purpose purpose) const noexcept { return at(purpose).pending; }
  // The JOIN last wanted for this purpose.
  [[nodiscard]] const Join& join(Purpose purpose) const noexcept { return at(purpose).join; }

  // Call once for each superframe `number` whose open slot comes next. Returns what this node sends in it.
  [[nodiscard]] std::optional<Join> turn(std::uint32_t number) noexcept;
  // Returns a pending JOIN for a slot in which no other node sends; it need not be repeated.
  [[nodiscard]] std::optional<Join> take(Purpose purpose) noexcept;
  // The JOIN of turn() or take() was sent, or was too late for its slot: then it gets the next one.
  void on_sent(bool sent) noexcept;

 private:
  struct Pending {
    Join join{};
    bool pending = false;
    Repetition left{};       // from the next transmission on
    std::uint16_t wait = 0;  // open slots to skip
  };

  [[nodiscard]] Pending& at(Purpose purpose) noexcept { return pending_[static_cast<std::size_t>(purpose)]; }
  [[nodiscard]] const Pending& at(Purpose purpose) const noexcept {
    return pending_[static_cast<std::size_t>(purpose)];
  }
  // The open slots to skip, before superframe `number`, for the first window of what is left.
  [[nodiscard]] std::uint16_t draw(Purpose purpose, std::uint32_t number) const noexcept;
  void repeat_later(Purpose purpose, std::uint32_t number) noexcept;

  std::uint16_t id_;
  std::array<Pending, kPurposes> pending_{};
  std::optional<Purpose> under_way_;
};

}  // namespace groma::mac
