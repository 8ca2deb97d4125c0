#include "firmware/core/mac/slot_table.hpp"

#include <algorithm>
#include <limits>

namespace groma::mac {
namespace {

constexpr std::uint16_t kLong = std::numeric_limits<std::uint16_t>::max();
// A revoked slot stays free for longer than a table is valid.
constexpr std::uint16_t kVacantFor = kTableGoodFor + 1;

void age(std::uint16_t& superframes, std::uint32_t by) noexcept {
  superframes = static_cast<std::uint16_t>(std::min<std::uint32_t>(superframes + by, kLong));
}

// A beacon's content may be up to 255 superframes old, the largest `age`. If it seems older, the previously
// known superframe count was wrong.
bool is_late(std::uint32_t origin, std::uint32_t known) noexcept {
  constexpr std::uint32_t kOldest = 255;
  const std::uint32_t by = known - origin;
  return by != 0 && by <= kOldest;
}

}  // namespace

SlotTable::SlotTable(const groma_Schedule& schedule) noexcept
    : schedule_(&schedule),
      count_(std::min<std::size_t>(schedule.slots == 0 ? schedule.tag_ids_count : schedule.slots, kMaxTags)) {
  begin();
}

std::uint16_t SlotTable::by_schedule(std::size_t slot) const noexcept {
  for (std::size_t i = 0; i < schedule_->tag_ids_count; ++i) {
    if (configured_slot(*schedule_, schedule_->tag_ids[i]) == slot) return kBroadcast;
  }
  return kNobody;
}

void SlotTable::begin() noexcept {
  for (std::size_t slot = 0; slot < count_; ++slot) {
    owners_[slot] = by_schedule(slot);
    uses_[slot] = Use{.vacant = kLong};
  }
  copied_ = false;
  leads_ = false;
  unasked_ = kLong;
}

void SlotTable::set(std::size_t slot, std::uint16_t owner) noexcept {
  owners_[slot] = owner;
  uses_[slot] = Use{};
}

// The slot's former owner, or the schedule's tags, may have it back.
void SlotTable::revoke(std::size_t slot) noexcept {
  const std::uint16_t before = owners_[slot];
  set(slot, kNobody);
  uses_[slot].before = before;
}

void SlotTable::advance(std::uint32_t number) noexcept {
  const auto step = static_cast<std::int32_t>(number - now_);
  now_ = number;
  if (step <= 0) return;
  age(quiet_, static_cast<std::uint32_t>(step));
  age(unasked_, static_cast<std::uint32_t>(step));
  for (Use& use : uses_) {
    age(use.unheard, static_cast<std::uint32_t>(step));
    age(use.vacant, static_cast<std::uint32_t>(step));
  }
}

void SlotTable::copy(const Beacon& beacon) noexcept {
  const std::uint32_t origin = origin_of(beacon);
  const bool same_session = copied_ && beacon.session == session_;
  if (same_session && is_late(origin, origin_)) return;
  if (!same_session) begin();
  copied_ = true;
  leads_ = false;
  session_ = beacon.session;
  origin_ = origin;
  for (std::size_t slot = 0; slot < std::min<std::size_t>(count_, beacon.slots); ++slot) {
    const std::uint16_t owner = beacon.owners[slot];
    if (owner == owners_[slot]) continue;
    if (owner == kNobody) {
      revoke(slot);
    } else {
      set(slot, owner);
    }
  }
}

void SlotTable::lead(std::uint64_t session) noexcept {
  if (leads_ && session == session_) return;
  const bool goes_on = copied_ && session == session_;
  if (!goes_on) begin();
  leads_ = true;
  session_ = session;
  if (!goes_on) return;
  for (std::size_t slot = 0; slot < count_; ++slot) {
    Use& use = uses_[slot];
    use.before = kNobody;
    use.vacant = 0;
    use.unheard = 0;
    use.awaited = !use.heard && owners_[slot] != kNobody && owners_[slot] != kBroadcast;
  }
}

bool SlotTable::belongs_to(std::uint16_t owner, std::size_t slot, std::uint16_t tag) const noexcept {
  if (tag == kNobody || tag == kBroadcast) return false;
  return owner == tag || (owner == kBroadcast && configured_slot(*schedule_, tag) == slot);
}

bool SlotTable::may_poll(std::uint16_t tag, std::size_t slot) const noexcept {
  return slot < count_ && belongs_to(owners_[slot], slot, tag);
}

std::optional<std::size_t> SlotTable::slot_of(std::uint16_t tag) const noexcept {
  for (std::size_t slot = 0; slot < count_; ++slot) {
    if (may_poll(tag, slot)) return slot;
  }
  return std::nullopt;
}

void SlotTable::hear(std::uint16_t tag, std::size_t slot) noexcept {
  if (!may_poll(tag, slot)) return;
  if (quiet_ >= kDeaf) {
    for (Use& use : uses_) use.unheard = 0;
  }
  quiet_ = 0;
  uses_[slot].unheard = 0;
  uses_[slot].heard = true;
  uses_[slot].awaited = false;
}

SlotTable::Claim SlotTable::claim(std::uint16_t tag) noexcept {
  if (const auto slot = slot_of(tag)) {
    uses_[*slot].unheard = 0;
    return Claim::kHeld;
  }
  for (std::size_t slot = 0; slot < count_; ++slot) {
    const std::uint16_t before = uses_[slot].before;
    if (owners_[slot] != kNobody || !belongs_to(before, slot, tag)) continue;
    set(slot, before);
    return Claim::kHeld;
  }
  // Prefer slots that the schedule assigns to no tag.
  std::optional<std::size_t> free;
  bool coming = false;
  for (std::size_t slot = 0; slot < count_; ++slot) {
    if (owners_[slot] != kNobody) continue;
    if (uses_[slot].vacant < kVacantFor) {
      coming = true;
    } else if (!free || (by_schedule(*free) != kNobody && by_schedule(slot) == kNobody)) {
      free = slot;
    }
  }
  if (free) {
    set(*free, tag);
    uses_[*free].awaited = true;
    return Claim::kGranted;
  }
  unasked_ = 0;
  if (coming) return Claim::kWait;
  const auto unheard = [](const Use& a, const Use& b) { return a.unheard < b.unheard; };
  const auto longest = std::max_element(uses_.begin(), uses_.begin() + count_, unheard);
  if (longest != uses_.begin() + count_ && longest->unheard >= kLease) {
    revoke(static_cast<std::size_t>(longest - uses_.begin()));
  }
  return Claim::kWait;
}

void SlotTable::reclaim() noexcept {
  if (unasked_ <= kLease) {
    for (std::size_t slot = 0; slot < count_; ++slot) {
      if (uses_[slot].awaited && uses_[slot].unheard >= kFirstLease) revoke(slot);
    }
  }
  if (quiet_ >= kDeaf) return;
  for (std::size_t slot = 0; slot < count_; ++slot) {
    if (uses_[slot].heard && uses_[slot].unheard >= kLease) revoke(slot);
  }
}

void SlotTable::leave(std::uint16_t tag) noexcept {
  for (std::size_t slot = 0; slot < count_; ++slot) {
    if (!may_poll(tag, slot)) continue;
    if (owners_[slot] == kBroadcast) {
      std::size_t sharing = 0;
      for (std::size_t i = 0; i < schedule_->tag_ids_count; ++i) {
        sharing += configured_slot(*schedule_, schedule_->tag_ids[i]) == slot ? 1U : 0U;
      }
      if (sharing > 1) continue;
    }
    revoke(slot);
    uses_[slot].vacant = kLong;
  }
}

void SlotTable::fill(Beacon& beacon) const noexcept {
  beacon.slots = static_cast<std::uint8_t>(count_);
  beacon.owners = owners_;
}

void SlotLease::take(const Beacon& beacon) noexcept {
  const std::uint32_t origin = origin_of(beacon);
  if (known_ && beacon.session == session_ && is_late(origin, origin_)) return;
  known_ = true;
  session_ = beacon.session;
  origin_ = origin;
  slot_.reset();
  for (std::size_t slot = 0; slot < std::min<std::size_t>(beacon.slots, kMaxTags); ++slot) {
    const std::uint16_t owner = beacon.owners[slot];
    if (owner == tag_ || (owner == kBroadcast && configured_ == slot)) slot_ = slot;
  }
}

std::optional<std::size_t> SlotLease::slot(std::uint32_t number) const noexcept {
  if (!known_ || outdated(number)) return std::nullopt;
  return slot_;
}

}  // namespace groma::mac
