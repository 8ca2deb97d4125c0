#include "firmware/core/mac/membership.hpp"

#include <algorithm>
#include <span>

#include "firmware/core/mac/superframe.hpp"

namespace groma::mac {
namespace {

// A tag without a slot asks at once, then ever less often, until it has one.
constexpr Repetition kAsk{.first_window_log2 = 0, .last_window_log2 = 4};
constexpr Repetition kAnnounceLeaving{.first_window_log2 = 0, .last_window_log2 = 4, .times = 4};
// All anchors may start at once, and most are polled before their turn comes.
constexpr std::uint32_t kBeforeAnnouncing = 3;  // superframes
constexpr Repetition kAnnounce{.first_window_log2 = 2, .last_window_log2 = 5, .times = 3};
constexpr Repetition kPassOn{.first_window_log2 = 1, .last_window_log2 = 4, .times = 2};

constexpr Repetition kRemind{.first_window_log2 = 4, .last_window_log2 = 4, .times = 1};
constexpr std::uint32_t kRemindEach = 256;  // superframes

// In superframes: after this time the tag has repeated its request itself.
constexpr std::uint32_t kPassedOnWithin = 32;

}  // namespace

// ---- the tag --------------------------------------------------------------------------------------------

TagMembership::TagMembership(std::uint16_t id, const groma_Schedule& schedule, const SlotMap& slots,
                             std::uint16_t lender) noexcept
    : id_(id),
      owner_(lender != kNobody ? lender : id),
      slots_(slots),
      anchors_(anchors_of(schedule)),
      join_(id, 1) {}

void TagMembership::leave() noexcept {
  if (leaving_) return;
  leaving_ = true;
  join_.settle();
  join_.want({.origin = id_, .tag = true, .leaving = true}, kAnnounceLeaving, 0);
}

void TagMembership::on_control(const Frame& frame, std::uint32_t /*number*/, bool /*leading*/) noexcept {
  // Only a JOIN heard directly shows that the anchor is in range.
  const auto* join = std::get_if<Join>(&frame.body);
  if (join == nullptr || join->tag || join->leaving || join->origin != frame.source) return;
  (void)anchors_.announce(join->origin);
}

void TagMembership::on_beacon(const Frame& frame, const Beacon& beacon) noexcept {
  anchors_.hear(frame.source);
  const bool homeless = !slots_.slot_of(owner_);
  if (leaving_ ? homeless : !homeless || borrows()) {
    join_.settle();
  } else if (!leaving_) {
    join_.want({.origin = id_, .tag = true, .wants_slot = true}, kAsk, beacon.superframe);
  }
}

// ---- the anchor -----------------------------------------------------------------------------------------

AnchorMembership::AnchorMembership(std::uint16_t id, const groma_Schedule& schedule, SlotMap& slots) noexcept
    : id_(id),
      beaconer_(rank_of(schedule, id).has_value()),
      listed_(std::count(schedule.anchor_ids, schedule.anchor_ids + schedule.anchor_ids_count, id) != 0),
      slots_(slots),
      announcement_(id, 3),
      relayed_(id, 2) {}

void AnchorMembership::on_poll(std::uint16_t tag, std::size_t slot, bool named) noexcept {
  slots_.hear(tag, slot);
  // The polling tag knows this anchor. Other tags in range will soon learn of it as well.
  if (!named || !listed_) return;
  announcing_ = Announcing::kDone;
  announcement_.settle();
}

void AnchorMembership::announce(std::uint32_t number) noexcept {
  if (announcing_ == Announcing::kNotYet) {
    announcing_ = Announcing::kSoon;
    next_announcement_ = number + kBeforeAnnouncing;
  }
  const bool first = announcing_ == Announcing::kSoon;
  if (!first && listed_) return;
  const std::uint32_t ahead = next_announcement_ - number;
  if (ahead != 0 && ahead <= (first ? kBeforeAnnouncing : kRemindEach)) return;
  announcement_.want({.origin = id_}, first ? kAnnounce : kRemind, number);
  announcing_ = Announcing::kDone;
  next_announcement_ = number + kRemindEach;
}

std::optional<ControlChannel::Outgoing> AnchorMembership::open_slot(std::uint32_t number) noexcept {
  announce(number);
  if (number - passed_on_since_ > kPassedOnWithin) relayed_.settle();
  auto request = relayed_.turn(number);
  return request ? request : announcement_.turn(number);
}

std::optional<ControlChannel::Outgoing> AnchorMembership::own_turn(std::uint32_t number) noexcept {
  if (number - passed_on_since_ > kPassedOnWithin) return std::nullopt;
  return relayed_.take();
}

void AnchorMembership::on_control(const Frame& frame, std::uint32_t number, bool leading) noexcept {
  const auto* join = std::get_if<Join>(&frame.body);
  if (join == nullptr || !join->tag) return;
  if (leading) {
    if (!slots_.leads()) return;  // not before its first beacon
    slots_.advance(number);
    if (join->leaving) {
      slots_.leave(join->origin);
    } else if (join->wants_slot) {
      (void)slots_.claim(join->origin);
    }
  } else if (beaconer_ && (join->leaving || join->wants_slot)) {
    consider_passing_on(frame, *join, number);
  }
}

// Relays each request once. If another relay has forwarded it already, a third transmission from the same
// area is not needed.
void AnchorMembership::consider_passing_on(const Frame& frame, const Join& join,
                                           std::uint32_t number) noexcept {
  const bool of_same_tag = relayed_.join().origin == join.origin;
  const std::uint64_t request = std::uint64_t{join.origin} << 32 | static_cast<std::uint32_t>(join.nonce);
  if (std::find(passed_.begin(), passed_.end(), request) != passed_.end()) {
    const bool by_another = frame.source != join.origin;
    if (by_another && of_same_tag) relayed_.settle();
    return;
  }
  if (relayed_.pending() && !of_same_tag) return;
  passed_[next_passed_++ % passed_.size()] = request;
  passed_on_since_ = number;
  relayed_.want(join, kPassOn, number);
}

void AnchorMembership::on_beacon(const Frame& /*frame*/, const Beacon& /*beacon*/) noexcept {
  const Join& request = relayed_.join();
  const bool holds = slots_.slot_of(request.origin).has_value();
  if (holds != request.leaving) relayed_.settle();  // the master knows
}

void AnchorMembership::on_beacon_out(Beacon& beacon, bool leading) noexcept {
  if (leading) slots_.lead(beacon);
}

}  // namespace groma::mac
