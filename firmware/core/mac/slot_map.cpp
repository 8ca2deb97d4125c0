#include "firmware/core/mac/slot_map.hpp"

#include <algorithm>
#include <limits>
#include <utility>

#include "firmware/core/mac/superframe.hpp"

namespace groma::mac {
namespace {

constexpr std::uint16_t kLong = std::numeric_limits<std::uint16_t>::max();
// A revoked slot stays free for longer than a map is valid.
constexpr std::uint16_t kVacantFor = kMapGoodFor + 1;

// A beacon's content may be up to 255 superframes old, the largest `age`. If it seems older, the previously
// known superframe count was wrong.
bool is_late(std::uint32_t origin, std::uint32_t known) noexcept {
  constexpr std::uint32_t kOldest = 255;
  const std::uint32_t by = known - origin;
  return by != 0 && by <= kOldest;
}

}  // namespace

SlotMap::SlotMap(const groma_Schedule& schedule) noexcept
    : schedule_(&schedule), count_(std::min(slot_count_of(schedule), kMaxTags)) {
  reset();
}

void SlotMap::reset() noexcept {
  for (std::size_t slot = 0; slot < count_; ++slot) owners_[slot] = scheduled(slot);
  leases_.fill(Lease{.vacant = kLong});
  known_ = leads_ = false;
  unasked_ = kLong;
}

// ---- the map --------------------------------------------------------------------------------------------

std::size_t SlotMap::scheduled_tags(std::size_t slot) const noexcept {
  const auto tags = tags_of(*schedule_);
  return static_cast<std::size_t>(std::count_if(tags.begin(), tags.end(), [=, this](std::uint16_t tag) {
    return configured_slot(*schedule_, tag) == slot;
  }));
}

bool SlotMap::admits(std::uint16_t owner, std::size_t slot, std::uint16_t tag) const noexcept {
  if (tag == kNobody || tag == kBroadcast) return false;
  return owner == tag || (owner == kBroadcast && configured_slot(*schedule_, tag) == slot);
}

std::optional<std::size_t> SlotMap::slot_of(std::uint16_t tag) const noexcept {
  for (std::size_t slot = 0; slot < count_; ++slot) {
    if (may_poll(tag, slot)) return slot;
  }
  return std::nullopt;
}

std::optional<std::size_t> SlotMap::valid_slot_of(std::uint16_t tag, std::uint32_t number) const noexcept {
  return known_ && !outdated(number) ? slot_of(tag) : std::nullopt;
}

std::uint16_t SlotMap::owner_of(std::size_t slot) const noexcept {
  if (owners_[slot] != kBroadcast) return owners_[slot];
  const auto tags = tags_of(*schedule_);
  const auto owner =
      std::find_if(tags.begin(), tags.end(), [=, this](std::uint16_t tag) { return may_poll(tag, slot); });
  return owner == tags.end() ? kNobody : *owner;
}

// ---- the leases -----------------------------------------------------------------------------------------

void SlotMap::set(std::size_t slot, std::uint16_t owner) noexcept {
  owners_[slot] = owner;
  leases_[slot] = {};
}

// The slot's former owner, or the schedule's tags, may have it back.
void SlotMap::revoke(std::size_t slot) noexcept {
  leases_[slot] = {.before = std::exchange(owners_[slot], kNobody)};
}

void SlotMap::advance(std::uint32_t number) noexcept {
  const std::int32_t step = since(number, now_);
  now_ = number;
  if (step <= 0) return;
  const auto age = [step](std::uint16_t& superframes) {
    superframes = static_cast<std::uint16_t>(std::min<std::int64_t>(std::int64_t{superframes} + step, kLong));
  };
  age(quiet_);
  age(unasked_);
  for (Lease& lease : leases_) {
    age(lease.unheard);
    age(lease.vacant);
  }
}

void SlotMap::hear(std::uint16_t tag, std::size_t slot) noexcept {
  if (!may_poll(tag, slot)) return;
  if (quiet_ >= kDeaf) {
    for (Lease& lease : leases_) lease.unheard = 0;
  }
  quiet_ = 0;
  leases_[slot].unheard = 0;
  leases_[slot].heard = true;
  leases_[slot].awaited = false;
}

void SlotMap::take(const Beacon& beacon, bool adopted) noexcept {
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

void SlotMap::continue_leases() noexcept {
  for (std::size_t slot = 0; slot < count_; ++slot) {
    const bool assigned = owners_[slot] != kNobody && owners_[slot] != kBroadcast;
    Lease& lease = leases_[slot];
    lease = {.heard = lease.heard, .awaited = assigned && !lease.heard};
  }
}

void SlotMap::lead(Beacon& beacon) noexcept {
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

SlotMap::Claim SlotMap::claim(std::uint16_t tag) noexcept {
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

void SlotMap::reclaim() noexcept {
  for (std::size_t slot = 0; slot < count_; ++slot) {
    const Lease& lease = leases_[slot];
    const bool never_polled = unasked_ <= kLease && lease.awaited && lease.unheard >= kFirstLease;
    const bool lost = quiet_ < kDeaf && lease.heard && lease.unheard >= kLease;
    if (never_polled || lost) revoke(slot);
  }
}

void SlotMap::leave(std::uint16_t tag) noexcept {
  for (std::size_t slot = 0; slot < count_; ++slot) {
    const bool shared = owners_[slot] == kBroadcast && scheduled_tags(slot) > 1;
    if (!may_poll(tag, slot) || shared) continue;
    revoke(slot);
    leases_[slot].vacant = kLong;
  }
}

}  // namespace groma::mac
