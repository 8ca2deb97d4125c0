// How nodes join and leave the running network, by messages in the shared slots and by beacons: the tag's
// side and the anchor's (docs/explanation/joining.md).
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/anchor_set.hpp"
#include "firmware/core/mac/control_channel.hpp"
#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/repeated_join.hpp"
#include "firmware/core/mac/slot_map.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "groma.pb.h"

namespace groma::mac {

class TagMembership final : public ControlChannel {
 public:
  // `slots`, this node's slot map, outlives this object. `lender`: uses the slot of that tag instead of one
  // of its own; kNobody: its own.
  TagMembership(std::uint16_t id, const groma_Schedule& schedule, const SlotMap& slots,
                std::uint16_t lender = kNobody) noexcept
      : id_(id),
        owner_(lender != kNobody ? lender : id),
        slots_(slots),
        anchors_(anchors_of(schedule)),
        join_(id, 1) {}

  // The slot in which the tag may poll in superframe `number`.
  [[nodiscard]] std::optional<std::size_t> slot(std::uint32_t number) const noexcept {
    return leaving_ ? std::nullopt : slots_.valid_slot_of(owner_, number);
  }
  // The slot is another tag's.
  [[nodiscard]] bool borrows() const noexcept { return owner_ != id_; }
  // Stops polling permanently and announces it.
  void leave() noexcept {
    if (leaving_) return;
    leaving_ = true;
    join_.settle();
    join_.want({.origin = id_, .tag = true, .leaving = true}, kAnnounceLeaving, 0);
  }

  [[nodiscard]] AnchorSet& anchors() noexcept { return anchors_; }
  [[nodiscard]] const AnchorSet& anchors() const noexcept { return anchors_; }

  [[nodiscard]] std::optional<Outgoing> open_slot(std::uint32_t number) noexcept override {
    return join_.turn(number);
  }
  void on_sent(std::uint32_t /*number*/, bool sent) noexcept override { join_.on_sent(sent); }
  void on_control(const Frame& frame, std::uint32_t /*number*/, bool /*leading*/) noexcept override {
    // Only a JOIN heard directly shows that the anchor is in range.
    const auto* join = std::get_if<Join>(&frame.body);
    if (join == nullptr || join->tag || join->leaving || join->origin != frame.source) return;
    (void)anchors_.announce(join->origin);
  }
  void on_beacon(const Frame& frame, const Beacon& beacon) noexcept override {
    anchors_.hear(frame.source);
    const bool homeless = !slots_.slot_of(owner_);
    if (leaving_ ? homeless : !homeless || borrows()) {
      join_.settle();
    } else if (!leaving_) {
      join_.want({.origin = id_, .tag = true, .wants_slot = true}, kAsk, beacon.superframe);
    }
  }

 private:
  // A tag without a slot asks at once, then ever less often, until it has one.
  static constexpr Repetition kAsk{.first_window_log2 = 0, .last_window_log2 = 4};
  static constexpr Repetition kAnnounceLeaving{.first_window_log2 = 0, .last_window_log2 = 4, .times = 4};

  std::uint16_t id_;
  std::uint16_t owner_;  // of the slot in which this node polls
  const SlotMap& slots_;
  AnchorSet anchors_;
  RepeatedJoin join_;
  bool leaving_ = false;
};

class AnchorMembership final : public ControlChannel {
 public:
  // `slots`, this node's slot map, outlives this object. At the master this object changes it.
  AnchorMembership(std::uint16_t id, const groma_Schedule& schedule, SlotMap& slots) noexcept
      : id_(id),
        beaconer_(rank_of(schedule, id).has_value()),
        listed_(std::count(schedule.anchor_ids, schedule.anchor_ids + schedule.anchor_ids_count, id) != 0),
        slots_(slots),
        announcement_(id, 3),
        relayed_(id, 2) {}

  [[nodiscard]] const SlotMap& slots() const noexcept { return slots_; }
  // A POLL was heard in its slot; `named`: it asks for this anchor's answer.
  void on_poll(std::uint16_t tag, std::size_t slot, bool named) noexcept {
    slots_.hear(tag, slot);
    // The polling tag knows this anchor. Other tags in range will soon learn of it as well.
    if (!named || !listed_) return;
    announcing_ = Announcing::kDone;
    announcement_.settle();
  }

  [[nodiscard]] std::optional<Outgoing> open_slot(std::uint32_t number) noexcept override {
    announce(number);
    if (number - passed_on_since_ > kPassedOnWithin) relayed_.settle();
    auto request = relayed_.turn(number);
    return request ? request : announcement_.turn(number);
  }
  [[nodiscard]] std::optional<Outgoing> own_turn(std::uint32_t number) noexcept override {
    if (number - passed_on_since_ > kPassedOnWithin) return std::nullopt;
    return relayed_.take();
  }
  void on_sent(std::uint32_t /*number*/, bool sent) noexcept override {
    relayed_.on_sent(sent);
    announcement_.on_sent(sent);
  }
  void on_control(const Frame& frame, std::uint32_t number, bool leading) noexcept override {
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
  void on_beacon(const Frame& /*frame*/, const Beacon& /*beacon*/) noexcept override {
    const Join& request = relayed_.join();
    const bool holds = slots_.slot_of(request.origin).has_value();
    if (holds != request.leaving) relayed_.settle();  // the master knows
  }
  void on_beacon_out(Beacon& beacon, bool leading) noexcept override {
    if (leading) slots_.lead(beacon);
  }

 private:
  // All anchors may start at once, and most are polled before their turn comes.
  static constexpr std::uint32_t kBeforeAnnouncing = 3;  // superframes
  static constexpr Repetition kAnnounce{.first_window_log2 = 2, .last_window_log2 = 5, .times = 3};
  static constexpr std::uint32_t kRemindEach = 256;  // superframes
  static constexpr Repetition kRemind{.first_window_log2 = 4, .last_window_log2 = 4, .times = 1};
  // In superframes: after this time the tag has repeated its request itself.
  static constexpr std::uint32_t kPassedOnWithin = 32;
  static constexpr Repetition kPassOn{.first_window_log2 = 1, .last_window_log2 = 4, .times = 2};

  void announce(std::uint32_t number) noexcept {
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
  // Relays each request once. If another relay has forwarded it already, a third transmission from the same
  // area is not needed.
  void consider_passing_on(const Frame& frame, const Join& join, std::uint32_t number) noexcept {
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

  std::uint16_t id_;
  bool beaconer_;  // this node relays beacons
  bool listed_;    // among the schedule's anchors, which all tags know
  std::uint32_t next_announcement_ = 0;
  enum class Announcing : std::uint8_t { kNotYet, kSoon, kDone };
  Announcing announcing_ = Announcing::kNotYet;
  SlotMap& slots_;
  RepeatedJoin announcement_;
  RepeatedJoin relayed_;                   // a tag's request
  std::uint32_t passed_on_since_ = 0;      // superframe of the last request to be relayed
  std::array<std::uint64_t, 4> passed_{};  // origin and lower half of the nonce of the last requests
  std::size_t next_passed_ = 0;
};

}  // namespace groma::mac
