// The slot leases: how long the master reserves each slot of its slot map, and for which tag. Back-ups follow
// the leases too, so that they can continue them.
//
// The master revokes a slot if it heard the slot's tag before and then not for kLease superframes. If a tag
// asks and no slot is free, it also revokes a slot whose tag it has not heard for as long (that tag may be
// out of its range). A revoked slot is free. A tag that is still there joins again and gets its slot back,
// unless it has been reassigned. A slot that had an owner stays free for longer than kMapGoodFor before
// another tag gets it. (If a tag announces that it leaves, its slot is free at once, because the tag is
// silent already.)
//
// A new master continues with its map. A slot that is free in it may have been assigned in a beacon that this
// node missed, so it has to stay free for the same time.
//
// One gap remains: a tag leaves and returns within kMapGoodFor, and a new master has missed both its leaving
// and the new owner. A tag that left therefore has to stay away for longer.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "firmware/core/mac/slot_map.hpp"

namespace groma::mac {

// All in superframes.
inline constexpr std::uint32_t kLease = 64;
// The lease of a slot whose tag has never polled in it, if another tag asks.
inline constexpr std::uint32_t kFirstLease = 16;
// A master that hears no tag at all for this long is itself out of range. It revokes no slot, and restarts
// the leases when it hears a tag.
inline constexpr std::uint32_t kDeaf = 8;

class SlotLeases {
 public:
  // `map`, this node's slot map, outlives this object. The owner of the map copies the beacons of others to
  // it; this object changes it at the master.
  explicit SlotLeases(SlotMap& map) noexcept : map_(map) { restart(); }

  // Superframe `number` begins. Steps of any size are allowed; a step back only changes the count.
  void advance(std::uint32_t number) noexcept;

  // At a follower of `session`: the map may have changed.
  void follow(std::uint64_t session) noexcept;
  // This node is now the master of `session`. It continues with its map if it followed that session;
  // otherwise it starts with the schedule's. Does nothing if it was the master already.
  void lead(std::uint64_t session) noexcept;
  // The last call was lead(), not follow().
  [[nodiscard]] bool leads() const noexcept { return leads_; }
  // This tag's POLL was heard in this slot.
  void hear(std::uint16_t tag, std::size_t slot) noexcept;

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
    std::uint16_t owner = kNobody;   // in the map; the rest is about it
    std::uint16_t before = kNobody;  // the owner before it was revoked, which may have it back
    std::uint16_t unheard = 0;       // superframes since its tag was heard or it was assigned; saturates
    std::uint16_t vacant = 0;        // superframes since it became free; saturates
    bool heard = false;              // this node has heard its tag
    bool awaited = false;            // assigned on request; this node has not heard a POLL in it yet
  };

  void restart() noexcept;
  void set(std::size_t slot, std::uint16_t owner) noexcept;
  void revoke(std::size_t slot) noexcept;

  SlotMap& map_;
  std::array<Lease, kMaxTags> leases_{};
  std::uint32_t now_ = 0;
  std::uint16_t quiet_ = 0;    // superframes since any tag was heard; saturates
  std::uint16_t unasked_ = 0;  // superframes since a tag asked and no slot was free; saturates
  std::uint64_t session_ = 0;
  bool followed_ = false;  // this node has followed `session_`
  bool leads_ = false;
};

}  // namespace groma::mac
