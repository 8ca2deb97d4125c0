// Back-off in the shared slots that are open to all.
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

namespace groma::mac {

// Purposes for which a node may have a frame pending, at most one each, in order of priority.
enum class Purpose : std::uint8_t { kLeave, kJoin, kPassOn, kAnnounce };
inline constexpr std::size_t kPurposes = 4;

struct Persistence {
  std::uint8_t first_window_log2 = 0;  // the first transmission is in one of 2^this open slots
  std::uint8_t last_window_log2 = 4;   // up to 15
  std::uint8_t times = 0;              // most transmissions; 0: until settle()
};

class Access {
 public:
  explicit Access(std::uint16_t id) noexcept : id_(id) {}

  // Requests transmissions from superframe `number` on. Does nothing if the purpose is pending already.
  void want(Purpose purpose, const Persistence& persistence, std::uint32_t number) noexcept;
  // The frame came through, or is not needed any more.
  void settle(Purpose purpose) noexcept { at(purpose).pending = false; }
  [[nodiscard]] bool pending(Purpose purpose) const noexcept {
    return pending_[static_cast<std::size_t>(purpose)].pending;
  }

  // Call once for each superframe `number` whose open slot comes next. Returns what this node sends in it.
  [[nodiscard]] std::optional<Purpose> turn(std::uint32_t number) noexcept;
  // The frame that turn() chose was too late for its slot: it gets the next one.
  void missed(Purpose purpose) noexcept;

 private:
  struct Pending {
    bool pending = false;
    std::uint8_t window_log2 = 0;
    std::uint8_t last_window_log2 = 0;
    std::uint8_t times_left = 0;  // 0: no bound
    std::uint16_t wait = 0;       // open slots to skip
  };

  [[nodiscard]] Pending& at(Purpose purpose) noexcept { return pending_[static_cast<std::size_t>(purpose)]; }
  [[nodiscard]] std::uint16_t draw(std::size_t purpose, std::uint32_t number,
                                   std::uint8_t window_log2) const noexcept;

  std::uint16_t id_;
  std::array<Pending, kPurposes> pending_{};
};

}  // namespace groma::mac
