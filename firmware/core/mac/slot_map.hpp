// The slot map: which tag may poll in each slot, and how long a node may rely on that.
//
// Each beacon carries the map. A node may have an outdated one, because it missed beacons or heard a relay.
// Two rules still keep two tags out of one slot. Each node follows the newest map that it heard, and a tag
// polls only while that map is at most kMapGoodFor superframes old. The master keeps a slot that had an owner
// free for longer than that before another tag gets it (slot_leases.hpp).
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/frame.hpp"
#include "groma.pb.h"

namespace groma::mac {

// In superframes.
inline constexpr std::uint32_t kMapGoodFor = 32;

class SlotMap {
 public:
  // Starts with the schedule's owners; all other slots are free. The schedule outlives this object.
  explicit SlotMap(const groma_Schedule& schedule) noexcept;

  // Returns to the schedule's owners.
  void reset() noexcept;
  // Copies the map of a beacon, unless a newer one of the same session is known. `adopted`: this node follows
  // the beacon's timeline from now on, so the beacon's count of superframes replaces the former one.
  void take(const Beacon& beacon, bool adopted = false) noexcept;
  void fill(Beacon& beacon) const noexcept;

  // Of each slot: kBroadcast: the tags that the schedule assigns to the slot; kNobody: free.
  [[nodiscard]] std::span<const std::uint16_t> owners() const noexcept {
    return std::span(owners_).first(count_);
  }
  [[nodiscard]] std::size_t count() const noexcept { return count_; }
  // At the master, until the next beacon carries it.
  void set(std::size_t slot, std::uint16_t owner) noexcept { owners_[slot] = owner; }
  // Number of tags that the schedule assigns to the slot.
  [[nodiscard]] std::size_t scheduled_tags(std::size_t slot) const noexcept;
  // The slot's owner by the schedule alone.
  [[nodiscard]] std::uint16_t scheduled(std::size_t slot) const noexcept {
    return scheduled_tags(slot) != 0 ? kBroadcast : kNobody;
  }

  // `owner`, an entry of the map for this slot, admits the tag.
  [[nodiscard]] bool admits(std::uint16_t owner, std::size_t slot, std::uint16_t tag) const noexcept;
  [[nodiscard]] bool may_poll(std::uint16_t tag, std::size_t slot) const noexcept {
    return slot < count_ && admits(owners_[slot], slot, tag);
  }
  [[nodiscard]] std::optional<std::size_t> slot_of(std::uint16_t tag) const noexcept;
  // As slot_of(), but nothing if the map is not known or too old for polling in superframe `number`.
  [[nodiscard]] std::optional<std::size_t> valid_slot_of(std::uint16_t tag,
                                                         std::uint32_t number) const noexcept;
  // The tag that may poll in this slot, or kNobody; if several may, the schedule's first.
  [[nodiscard]] std::uint16_t owner_of(std::size_t slot) const noexcept;

  // The map is known, but too old for polling in superframe `number`.
  [[nodiscard]] bool outdated(std::uint32_t number) const noexcept {
    return known_ && number - origin_ > kMapGoodFor;
  }

 private:
  const groma_Schedule* schedule_;
  std::size_t count_;
  std::array<std::uint16_t, kMaxTags> owners_{};
  bool known_ = false;
  std::uint64_t session_ = 0;
  std::uint32_t origin_ = 0;  // superframe in which the master sent the map
};

}  // namespace groma::mac
