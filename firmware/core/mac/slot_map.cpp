#include "firmware/core/mac/slot_map.hpp"

#include <algorithm>

#include "firmware/core/mac/superframe.hpp"

namespace groma::mac {
namespace {

// A beacon's content may be up to 255 superframes old, the largest `age`. If it seems older, the previously
// known superframe count was wrong.
bool is_late(std::uint32_t origin, std::uint32_t known) noexcept {
  constexpr std::uint32_t kOldest = 255;
  const std::uint32_t by = known - origin;
  return by != 0 && by <= kOldest;
}

std::span<const std::uint16_t> tags_of(const groma_Schedule& schedule) noexcept {
  return std::span(schedule.tag_ids).first(schedule.tag_ids_count);
}

}  // namespace

SlotMap::SlotMap(const groma_Schedule& schedule) noexcept
    : schedule_(&schedule),
      count_(std::min<std::size_t>(schedule.slots == 0 ? schedule.tag_ids_count : schedule.slots, kMaxTags)) {
  reset();
}

void SlotMap::reset() noexcept {
  for (std::size_t slot = 0; slot < count_; ++slot) owners_[slot] = scheduled(slot);
  known_ = false;
}

void SlotMap::take(const Beacon& beacon, bool adopted) noexcept {
  const std::uint32_t origin = origin_of(beacon);
  if (known_ && !adopted && beacon.session == session_ && is_late(origin, origin_)) return;
  known_ = true;
  session_ = beacon.session;
  origin_ = origin;
  std::copy_n(beacon.owners.begin(), std::min<std::size_t>(count_, beacon.slots), owners_.begin());
}

void SlotMap::fill(Beacon& beacon) const noexcept {
  beacon.slots = static_cast<std::uint8_t>(count_);
  beacon.owners = owners_;
}

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

}  // namespace groma::mac
