// When a node sends in the shared slots that are open to all.
//
// Nobody knows who else wants the slot, and nobody hears a collision. So each draws its turn: after each
// sending, one of the next open slots, of twice as many as before, until what it sent is seen to have come
// through or has been repeated often enough. The draw is a hash of the node, the purpose and the superframe:
// it needs no source of chance, differs between nodes, and is the same in each replay.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>

namespace groma::mac {

// What a node may have pending in the open slots, one of each; the first comes first.
enum class Purpose : std::uint8_t { kLeave, kJoin, kPassOn, kAnnounce };
inline constexpr std::size_t kPurposes = 4;

struct Persistence {
  std::uint8_t first_window_log2 = 0;  // the first sending is in one of so many open slots
  std::uint8_t last_window_log2 = 4;   // up to 15
  std::uint8_t times = 0;              // it is sent at most; 0: until it is settled
};

class Access {
 public:
  explicit Access(std::uint16_t id) noexcept : id_(id) {}

  // From superframe `number` on. Nothing where that is pending already.
  void want(Purpose purpose, const Persistence& persistence, std::uint32_t number) noexcept;
  // It came through, or is not wanted any more.
  void settle(Purpose purpose) noexcept { at(purpose).pending = false; }
  [[nodiscard]] bool pending(Purpose purpose) const noexcept {
    return pending_[static_cast<std::size_t>(purpose)].pending;
  }

  // The next open slot is that of superframe `number`: what this node sends in it. Called once for each.
  [[nodiscard]] std::optional<Purpose> turn(std::uint32_t number) noexcept;
  // What turn() gave was too late for its slot: the next one is its turn again.
  void missed(Purpose purpose) noexcept;

 private:
  struct Pending {
    bool pending = false;
    std::uint8_t window_log2 = 0;
    std::uint8_t last_window_log2 = 0;
    std::uint8_t times_left = 0;  // 0: no bound
    std::uint16_t wait = 0;       // open slots to be left to others
  };

  [[nodiscard]] Pending& at(Purpose purpose) noexcept { return pending_[static_cast<std::size_t>(purpose)]; }
  [[nodiscard]] std::uint16_t draw(std::size_t purpose, std::uint32_t number,
                                   std::uint8_t window_log2) const noexcept;

  std::uint16_t id_;
  std::array<Pending, kPurposes> pending_{};
};

}  // namespace groma::mac
