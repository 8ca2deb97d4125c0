#include "firmware/core/mac/slot_leases.hpp"

#include <algorithm>
#include <limits>
#include <optional>
#include <span>

namespace groma::mac {
namespace {

constexpr std::uint16_t kLong = std::numeric_limits<std::uint16_t>::max();
// A revoked slot stays free for longer than a map is valid.
constexpr std::uint16_t kVacantFor = kMapGoodFor + 1;

void age(std::uint16_t& superframes, std::uint32_t by) noexcept {
  superframes = static_cast<std::uint16_t>(std::min<std::uint32_t>(superframes + by, kLong));
}

}  // namespace

void SlotLeases::restart() noexcept {
  for (std::size_t slot = 0; slot < map_.count(); ++slot) {
    leases_[slot] = Lease{.owner = map_.scheduled(slot), .vacant = kLong};
  }
  followed_ = false;
  leads_ = false;
  unasked_ = kLong;
}

void SlotLeases::set(std::size_t slot, std::uint16_t owner) noexcept {
  map_.set(slot, owner);
  leases_[slot] = Lease{.owner = owner};
}

// The slot's former owner, or the schedule's tags, may have it back.
void SlotLeases::revoke(std::size_t slot) noexcept {
  const std::uint16_t before = leases_[slot].owner;
  set(slot, kNobody);
  leases_[slot].before = before;
}

void SlotLeases::advance(std::uint32_t number) noexcept {
  const auto step = static_cast<std::int32_t>(number - now_);
  now_ = number;
  if (step <= 0) return;
  age(quiet_, static_cast<std::uint32_t>(step));
  age(unasked_, static_cast<std::uint32_t>(step));
  for (Lease& lease : leases_) {
    age(lease.unheard, static_cast<std::uint32_t>(step));
    age(lease.vacant, static_cast<std::uint32_t>(step));
  }
}

void SlotLeases::follow(std::uint64_t session) noexcept {
  if (!followed_ || session != session_) restart();
  followed_ = true;
  leads_ = false;
  session_ = session;
  for (std::size_t slot = 0; slot < map_.count(); ++slot) {
    const std::uint16_t owner = map_.owners()[slot];
    if (owner == leases_[slot].owner) continue;
    if (owner == kNobody) {
      revoke(slot);
    } else {
      set(slot, owner);
    }
  }
}

void SlotLeases::lead(std::uint64_t session) noexcept {
  if (leads_ && session == session_) return;
  const bool goes_on = followed_ && session == session_;
  if (!goes_on) {
    map_.reset();
    restart();
  }
  leads_ = true;
  session_ = session;
  if (!goes_on) return;
  for (std::size_t slot = 0; slot < map_.count(); ++slot) {
    Lease& lease = leases_[slot];
    lease.before = kNobody;
    lease.vacant = 0;
    lease.unheard = 0;
    lease.awaited = !lease.heard && lease.owner != kNobody && lease.owner != kBroadcast;
  }
}

void SlotLeases::hear(std::uint16_t tag, std::size_t slot) noexcept {
  if (!map_.may_poll(tag, slot)) return;
  if (quiet_ >= kDeaf) {
    for (Lease& lease : leases_) lease.unheard = 0;
  }
  quiet_ = 0;
  leases_[slot].unheard = 0;
  leases_[slot].heard = true;
  leases_[slot].awaited = false;
}

SlotLeases::Claim SlotLeases::claim(std::uint16_t tag) noexcept {
  if (const auto slot = map_.slot_of(tag)) {
    leases_[*slot].unheard = 0;
    return Claim::kHeld;
  }
  for (std::size_t slot = 0; slot < map_.count(); ++slot) {
    const std::uint16_t before = leases_[slot].before;
    if (leases_[slot].owner != kNobody || !map_.admits(before, slot, tag)) continue;
    set(slot, before);
    return Claim::kHeld;
  }
  // Prefer slots that the schedule assigns to no tag.
  std::optional<std::size_t> free;
  bool coming = false;
  for (std::size_t slot = 0; slot < map_.count(); ++slot) {
    if (leases_[slot].owner != kNobody) continue;
    if (leases_[slot].vacant < kVacantFor) {
      coming = true;
    } else if (!free || (map_.scheduled(*free) != kNobody && map_.scheduled(slot) == kNobody)) {
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
  const auto leases = std::span(leases_).first(map_.count());
  const auto unheard = [](const Lease& a, const Lease& b) { return a.unheard < b.unheard; };
  const auto longest = std::max_element(leases.begin(), leases.end(), unheard);
  if (longest != leases.end() && longest->unheard >= kLease) {
    revoke(static_cast<std::size_t>(longest - leases.begin()));
  }
  return Claim::kWait;
}

void SlotLeases::reclaim() noexcept {
  for (std::size_t slot = 0; slot < map_.count(); ++slot) {
    const Lease& lease = leases_[slot];
    const bool never_polled = unasked_ <= kLease && lease.awaited && lease.unheard >= kFirstLease;
    const bool lost = quiet_ < kDeaf && lease.heard && lease.unheard >= kLease;
    if (never_polled || lost) revoke(slot);
  }
}

void SlotLeases::leave(std::uint16_t tag) noexcept {
  for (std::size_t slot = 0; slot < map_.count(); ++slot) {
    const bool shared = leases_[slot].owner == kBroadcast && map_.scheduled_tags(slot) > 1;
    if (!map_.may_poll(tag, slot) || shared) continue;
    revoke(slot);
    leases_[slot].vacant = kLong;
  }
}

}  // namespace groma::mac
