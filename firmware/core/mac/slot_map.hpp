// The slot map: which tag may poll in each slot, how long a node may rely on that, and how long the master
// reserves a slot for its tag (the slot's lease).
//
// Each beacon carries the map. docs/explanation/joining.md has the rules that keep two tags out of one slot
// although nodes may have outdated maps.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>
#include <utility>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/superframe.hpp"
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
  explicit SlotMap(const groma_Schedule& schedule) noexcept
      : schedule_(&schedule), count_(std::min(slot_count_of(schedule), kMaxTags)) {
    reset();
  }

  // Returns to the schedule's owners.
  void reset() noexcept {
    for (std::size_t slot = 0; slot < count_; ++slot) owners_[slot] = scheduled(slot);
    leases_.fill(Lease{.vacant = kLong});
    known_ = leads_ = false;
    unasked_ = kLong;
  }

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
  [[nodiscard]] std::optional<std::size_t> slot_of(std::uint16_t tag) const noexcept {
    for (std::size_t slot = 0; slot < count_; ++slot) {
      if (may_poll(tag, slot)) return slot;
    }
    return std::nullopt;
  }
  // As slot_of(), but nothing if the map is not known or too old for polling in superframe `number`.
  [[nodiscard]] std::optional<std::size_t> valid_slot_of(std::uint16_t tag,
                                                         std::uint32_t number) const noexcept {
    return known_ && !outdated(number) ? slot_of(tag) : std::nullopt;
  }
  // The tag that may poll in this slot, or kNobody; if several may, the schedule's first.
  [[nodiscard]] std::uint16_t owner_of(std::size_t slot) const noexcept {
    if (owners_[slot] != kBroadcast) return owners_[slot];
    const auto tags = tags_of(*schedule_);
    const auto owner =
        std::find_if(tags.begin(), tags.end(), [=, this](std::uint16_t tag) { return may_poll(tag, slot); });
    return owner == tags.end() ? kNobody : *owner;
  }
  // The map is known, but too old for polling in superframe `number`.
  [[nodiscard]] bool outdated(std::uint32_t number) const noexcept {
    return known_ && number - origin_ > kMapGoodFor;
  }

  // Superframe `number` is in progress. Steps of any size are allowed; a step back only changes the count.
  void advance(std::uint32_t number) noexcept {
    const std::int32_t step = since(number, now_);
    now_ = number;
    if (step <= 0) return;
    const auto age = [step](std::uint16_t& superframes) {
      superframes =
          static_cast<std::uint16_t>(std::min<std::int64_t>(std::int64_t{superframes} + step, kLong));
    };
    age(quiet_);
    age(unasked_);
    for (Lease& lease : leases_) {
      age(lease.unheard);
      age(lease.vacant);
    }
  }
  // This tag's POLL was heard in this slot.
  void hear(std::uint16_t tag, std::size_t slot) noexcept {
    if (!may_poll(tag, slot)) return;
    if (quiet_ >= kDeaf) {
      for (Lease& lease : leases_) lease.unheard = 0;
    }
    quiet_ = 0;
    leases_[slot].unheard = 0;
    leases_[slot].heard = true;
    leases_[slot].awaited = false;
  }
  // Follows the map of another node's beacon, unless a newer one of the same session is known. `adopted`:
  // this node follows the beacon's timeline from now on, so the beacon's count of superframes replaces the
  // former one.
  void take(const Beacon& beacon, bool adopted = false) noexcept {
    const std::uint32_t origin = origin_of(beacon);
    advance(beacon.superframe);
    leads_ = false;
    if (!follows(beacon.session)) {
      reset();
    } else if (!adopted && is_late(origin, origin_)) {
      return;
    }
    for (std::size_t slot = 0; slot < std::min<std::size_t>(count_, beacon.slots); ++slot) {
      const std::uint16_t owner = beacon.owners[slot];
      if (owner == owners_[slot]) continue;
      owner == kNobody ? revoke(slot) : set(slot, owner);
    }
    known_ = true;
    session_ = beacon.session;
    origin_ = origin;
  }
  // At the master: revokes what has to be revoked, and fills its next beacon. A new master continues with its
  // map if it followed the beacon's session; otherwise it starts with the schedule's.
  void lead(Beacon& beacon) noexcept {
    advance(beacon.superframe);
    if (!follows(beacon.session)) {
      reset();
    } else if (!leads_) {
      continue_leases();
    }
    reclaim();
    fill(beacon);
    known_ = leads_ = true;
    session_ = beacon.session;
    origin_ = beacon.superframe;
  }
  // The last beacon was this node's own, not one of another node.
  [[nodiscard]] bool leads() const noexcept { return leads_; }

  enum class Claim : std::uint8_t {
    kHeld,     // it has a slot, still or again
    kGranted,  // it has a slot from the next beacon on
    kWait,     // it has to ask again later
  };
  // At the master: this tag asks for a slot, or reports its presence.
  Claim claim(std::uint16_t tag) noexcept {
    if (const auto slot = slot_of(tag)) {
      leases_[*slot].unheard = 0;
      return Claim::kHeld;
    }
    // Prefer slots that the schedule assigns to no tag.
    std::optional<std::size_t> free;
    bool coming = false;
    for (std::size_t slot = 0; slot < count_; ++slot) {
      if (owners_[slot] != kNobody) continue;
      if (const std::uint16_t before = leases_[slot].before; admits(before, slot, tag)) {
        set(slot, before);
        return Claim::kHeld;
      }
      if (leases_[slot].vacant < kVacantFor) {
        coming = true;
      } else if (!free || (scheduled(*free) != kNobody && scheduled(slot) == kNobody)) {
        free = slot;
      }
    }
    if (free) {
      set(*free, tag);
      leases_[*free].awaited = true;
      return Claim::kGranted;
    }
    unasked_ = 0;
    if (coming) return Claim::kWait;
    const auto leases = std::span(leases_).first(count_);
    const auto unheard = [](const Lease& a, const Lease& b) { return a.unheard < b.unheard; };
    const auto longest = std::max_element(leases.begin(), leases.end(), unheard);
    if (longest != leases.end() && longest->unheard >= kLease) {
      revoke(static_cast<std::size_t>(longest - leases.begin()));
    }
    return Claim::kWait;
  }
  // At the master, once per superframe: revokes the slots of tags that were heard and then lost. If a tag
  // waits for a slot, also revokes those of tags that asked and never polled.
  void reclaim() noexcept {
    for (std::size_t slot = 0; slot < count_; ++slot) {
      const Lease& lease = leases_[slot];
      const bool never_polled = unasked_ <= kLease && lease.awaited && lease.unheard >= kFirstLease;
      const bool lost = quiet_ < kDeaf && lease.heard && lease.unheard >= kLease;
      if (never_polled || lost) revoke(slot);
    }
  }
  // At the master: this tag has stopped polling and gives up its slot. Does nothing if other tags of the
  // schedule share the slot.
  void leave(std::uint16_t tag) noexcept {
    for (std::size_t slot = 0; slot < count_; ++slot) {
      const bool shared = owners_[slot] == kBroadcast && scheduled_tags(slot) > 1;
      if (!may_poll(tag, slot) || shared) continue;
      revoke(slot);
      leases_[slot].vacant = kLong;
    }
  }

 private:
  static constexpr std::uint16_t kLong = std::numeric_limits<std::uint16_t>::max();
  // A revoked slot stays free for longer than a map is valid.
  static constexpr std::uint16_t kVacantFor = kMapGoodFor + 1;

  struct Lease {
    std::uint16_t before = kNobody;  // the owner before it was revoked, which may have it back
    std::uint16_t unheard = 0;       // superframes since its tag was heard or it was assigned; saturates
    std::uint16_t vacant = 0;        // superframes since it became free; saturates
    bool heard = false;              // this node has heard its tag
    bool awaited = false;            // assigned on request; this node has not heard a POLL in it yet
  };

  [[nodiscard]] std::size_t scheduled_tags(std::size_t slot) const noexcept {
    const auto tags = tags_of(*schedule_);
    return static_cast<std::size_t>(std::count_if(tags.begin(), tags.end(), [=, this](std::uint16_t tag) {
      return configured_slot(*schedule_, tag) == slot;
    }));
  }
  // The slot's owner by the schedule alone.
  [[nodiscard]] std::uint16_t scheduled(std::size_t slot) const noexcept {
    return scheduled_tags(slot) != 0 ? kBroadcast : kNobody;
  }
  // `owner`, an entry of the map for this slot, admits the tag.
  [[nodiscard]] bool admits(std::uint16_t owner, std::size_t slot, std::uint16_t tag) const noexcept {
    if (tag == kNobody || tag == kBroadcast) return false;
    return owner == tag || (owner == kBroadcast && configured_slot(*schedule_, tag) == slot);
  }
  // A beacon's content may be up to 255 superframes old, the largest `age`. If it seems older, the previously
  // known superframe count was wrong.
  [[nodiscard]] static bool is_late(std::uint32_t origin, std::uint32_t known) noexcept {
    constexpr std::uint32_t kOldest = 255;
    const std::uint32_t by = known - origin;
    return by != 0 && by <= kOldest;
  }
  [[nodiscard]] bool follows(std::uint64_t session) const noexcept { return known_ && session == session_; }
  void set(std::size_t slot, std::uint16_t owner) noexcept {
    owners_[slot] = owner;
    leases_[slot] = {};
  }
  // The slot's former owner, or the schedule's tags, may have it back.
  void revoke(std::size_t slot) noexcept {
    leases_[slot] = {.before = std::exchange(owners_[slot], kNobody)};
  }
  void continue_leases() noexcept {
    for (std::size_t slot = 0; slot < count_; ++slot) {
      const bool assigned = owners_[slot] != kNobody && owners_[slot] != kBroadcast;
      Lease& lease = leases_[slot];
      lease = {.heard = lease.heard, .awaited = assigned && !lease.heard};
    }
  }

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
