// The slot map: which tag may poll in each slot, how long a node may rely on that, and how long the master
// reserves a slot for its tag (the slot's lease).
//
// Each beacon carries the map. docs/explanation/joining.md has the rules that keep two tags out of one slot
// although nodes may have outdated maps.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/frame.hpp"
#include "groma.pb.h"

namespace groma::mac {

// All in superframes.
inline constexpr std::uint32_t kMapGoodFor = 32;
inline constexpr std::uint32_t kLease = 64;
// The lease of a slot whose tag has never polled in it, if another tag asks.
inline constexpr std::uint32_t kFirstLease = 16;
// A master that hears no tag at all for this long is itself out of range. It revokes no slot, and restarts
// the leases when it hears a tag.
inline constexpr std::uint32_t kDeaf = 8;

class SlotMap {
 public:
  // Starts with the schedule's owners; all other slots are free. The schedule outlives this object.
  explicit SlotMap(const groma_Schedule& schedule) noexcept;

  // Returns to the schedule's owners.
  void reset() noexcept;

  // Of each slot: kBroadcast: the tags that the schedule assigns to the slot; kNobody: free.
  [[nodiscard]] std::span<const std::uint16_t> owners() const noexcept {
    return std::span(owners_).first(count_);
  }
  void fill(Beacon& beacon) const noexcept {
    beacon.slots = static_cast<std::uint8_t>(count_);
    beacon.owners = owners_;
  }
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

  // Superframe `number` is in progress. Steps of any size are allowed; a step back only changes the count.
  void advance(std::uint32_t number) noexcept;
  // This tag's POLL was heard in this slot.
  void hear(std::uint16_t tag, std::size_t slot) noexcept;
  // Follows the map of another node's beacon, unless a newer one of the same session is known. `adopted`:
  // this node follows the beacon's timeline from now on, so the beacon's count of superframes replaces the
  // former one.
  void take(const Beacon& beacon, bool adopted = false) noexcept;
  // At the master: revokes what has to be revoked, and fills its next beacon. A new master continues with its
  // map if it followed the beacon's session; otherwise it starts with the schedule's.
  void lead(Beacon& beacon) noexcept;
  // The last beacon was this node's own, not one of another node.
  [[nodiscard]] bool leads() const noexcept { return leads_; }

  enum class Claim : std::uint8_t {
    kHeld,     // it has a slot, still or again
    kGranted,  // it has a slot from the next beacon on
    kWait,     // it has to ask again later
  };
  // At the master: this tag asks for a slot, or reports its presence.
  Claim claim(std::uint16_t tag) noexcept;
  // At the master, once per superframe: revokes the slots of tags that were heard and then lost. If a tag
  // waits for a slot, also revokes those of tags that asked and never polled.
  void reclaim() noexcept;
  // At the master: this tag has stopped polling and gives up its slot. Does nothing if other tags of the
  // schedule share the slot.
  void leave(std::uint16_t tag) noexcept;

 private:
  struct Lease {
    std::uint16_t before = kNobody;  // the owner before it was revoked, which may have it back
    std::uint16_t unheard = 0;       // superframes since its tag was heard or it was assigned; saturates
    std::uint16_t vacant = 0;        // superframes since it became free; saturates
    bool heard = false;              // this node has heard its tag
    bool awaited = false;            // assigned on request; this node has not heard a POLL in it yet
  };

  [[nodiscard]] std::size_t scheduled_tags(std::size_t slot) const noexcept;
  // The slot's owner by the schedule alone.
  [[nodiscard]] std::uint16_t scheduled(std::size_t slot) const noexcept {
    return scheduled_tags(slot) != 0 ? kBroadcast : kNobody;
  }
  // `owner`, an entry of the map for this slot, admits the tag.
  [[nodiscard]] bool admits(std::uint16_t owner, std::size_t slot, std::uint16_t tag) const noexcept;
  [[nodiscard]] bool follows(std::uint64_t session) const noexcept { return known_ && session == session_; }
  void set(std::size_t slot, std::uint16_t owner) noexcept;
  void revoke(std::size_t slot) noexcept;
  void continue_leases() noexcept;

  const groma_Schedule* schedule_;
  std::size_t count_;
  std::array<std::uint16_t, kMaxTags> owners_{};
  std::array<Lease, kMaxTags> leases_{};
  bool known_ = false;
  bool leads_ = false;
  std::uint64_t session_ = 0;
  std::uint32_t origin_ = 0;  // superframe in which the master sent the map
  std::uint32_t now_ = 0;
  std::uint16_t quiet_ = 0;    // superframes since any tag was heard; saturates
  std::uint16_t unasked_ = 0;  // superframes since a tag asked and no slot was free; saturates
};

}  // namespace groma::mac
