// The slot owners: the master's table, its copies at all other nodes, and the rule that a tag follows.
//
// Each beacon carries the table. A node may have an outdated one, because it missed beacons or heard a relay.
// Two rules still keep two tags out of one slot. A tag follows the newest table that it heard, and polls only
// while that table is at most kTableGoodFor superframes old. A slot that had an owner stays free for longer
// than that before it gets another one. (If a tag announces that it leaves, its slot is free at once, because
// the tag is silent already.)
//
// A new master continues with its copy. A slot that is free in the copy may have been assigned in a beacon
// that the copy missed, so it has to stay free for the same time.
//
// The master revokes a slot if it heard the slot's tag before and then not for kLease superframes. If a tag
// asks and no slot is free, it also revokes a slot whose tag it has not heard for as long (that tag may be
// out of its range). A revoked slot is free. A tag that is still there joins again and gets its slot back,
// unless it has been reassigned.
//
// One gap remains: a tag leaves and returns within kTableGoodFor, and a new master has missed both its
// leaving and the new owner. A tag that left therefore has to stay away for longer.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "groma.pb.h"

namespace groma::mac {

// All in superframes.
inline constexpr std::uint32_t kTableGoodFor = 32;
inline constexpr std::uint32_t kLease = 64;
// The lease of a slot whose tag has never polled in it, if another tag asks.
inline constexpr std::uint32_t kFirstLease = 16;
// A master that hears no tag at all for this long is itself out of range. It revokes no slot, and restarts
// the leases when it hears a tag.
inline constexpr std::uint32_t kDeaf = 8;

// The superframe in which the master sent the content of a beacon, direct or relayed.
[[nodiscard]] constexpr std::uint32_t origin_of(const Beacon& beacon) noexcept {
  return beacon.superframe - beacon.age;
}

// An anchor's slot table.
class SlotTable {
 public:
  // Starts with the schedule's owners; all other slots are free. The schedule outlives this object.
  explicit SlotTable(const groma_Schedule& schedule) noexcept;

  // Superframe `number` begins. Steps of any size are allowed; a step back only changes the count.
  void advance(std::uint32_t number) noexcept;

  // At a follower: copies the table of a beacon, unless a newer one of the same session is known.
  void copy(const Beacon& beacon) noexcept;
  // This node is now the master of `session`. It continues with its copy of that session, or starts with a
  // new table. Does nothing if it was the master already.
  void lead(std::uint64_t session) noexcept;

  // According to the table.
  [[nodiscard]] bool may_poll(std::uint16_t tag, std::size_t slot) const noexcept;
  [[nodiscard]] std::optional<std::size_t> slot_of(std::uint16_t tag) const noexcept;
  // The last call was lead(), not copy().
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

  void fill(Beacon& beacon) const noexcept;
  [[nodiscard]] std::span<const std::uint16_t> owners() const noexcept {
    return std::span(owners_).first(count_);
  }

 private:
  struct Use {
    std::uint16_t before = kNobody;  // the owner before it was revoked, which may have it back
    std::uint16_t unheard = 0;       // superframes since its tag was heard or it was assigned; saturates
    std::uint16_t vacant = 0;        // superframes since it became free; saturates
    bool heard = false;              // this node has heard its tag
    bool awaited = false;            // assigned on request; this node has not heard a POLL in it yet
  };

  void begin() noexcept;
  void set(std::size_t slot, std::uint16_t owner) noexcept;
  void revoke(std::size_t slot) noexcept;
  [[nodiscard]] bool belongs_to(std::uint16_t owner, std::size_t slot, std::uint16_t tag) const noexcept;
  [[nodiscard]] std::uint16_t by_schedule(std::size_t slot) const noexcept;

  const groma_Schedule* schedule_;
  std::size_t count_;
  std::array<std::uint16_t, kMaxTags> owners_{};
  std::array<Use, kMaxTags> uses_{};
  std::uint32_t now_ = 0;
  std::uint16_t quiet_ = 0;    // superframes since any tag was heard; saturates
  std::uint16_t unasked_ = 0;  // superframes since a tag asked and no slot was free; saturates
  std::uint64_t session_ = 0;
  std::uint32_t origin_ = 0;  // superframe in which the master sent the copied table
  bool copied_ = false;
  bool leads_ = false;
};

// A tag's slot lease: the slot that it may use.
class SlotLease {
 public:
  // `configured`: the slot that the schedule assigns to the tag.
  SlotLease(std::uint16_t tag, std::optional<std::size_t> configured) noexcept
      : tag_(tag), configured_(configured) {}

  // A beacon of the followed network.
  void take(const Beacon& beacon) noexcept;

  // Nothing if the tag has no slot, or if its table is too old for superframe `number`.
  [[nodiscard]] std::optional<std::size_t> slot(std::uint32_t number) const noexcept;
  // The tag has a table, but it is too old for superframe `number`.
  [[nodiscard]] bool outdated(std::uint32_t number) const noexcept {
    return known_ && number - origin_ > kTableGoodFor;
  }
  // The tag has a table, which gives it no slot.
  [[nodiscard]] bool homeless() const noexcept { return known_ && !slot_; }

 private:
  std::uint16_t tag_;
  std::optional<std::size_t> configured_;
  std::optional<std::size_t> slot_;
  bool known_ = false;
  std::uint32_t origin_ = 0;
  std::uint64_t session_ = 0;
};

}  // namespace groma::mac
