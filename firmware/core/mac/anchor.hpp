// The anchor: follows the network's time or leads it, and answers the tags that poll it.
//
//   Station (search, beacon, shared slot) / slot 0 / slot 1 / ... in turn;
//   in a slot: POLL --> RESPONSE --> [FINAL]
//
// If a RESPONSE does not leave at the timestamp that it states, its exchange is never closed and gives no
// range.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <optional>

#include "firmware/core/mac/membership.hpp"
#include "firmware/core/mac/station.hpp"
#include "firmware/core/mac/step.hpp"

namespace groma::mac {

class Anchor final : public Station {
 public:
  // `counters` outlives the anchor.
  Anchor(const Site& site, groma_Counters& counters) noexcept
      : Station(site, counters), membership_(site.id, *site.schedule, slots()) {
    attach(membership_);
  }

  std::size_t precompute() noexcept {
    if (!in_slots()) prepare_control();
    if (!in_slots() || phase_ != Phase::kPoll) return 0;
    if (keyed()) {
      authenticator().expect_received(expected_tag(), FrameType::kPoll, slot_place());
      authenticator().expect_sent(site().id, FrameType::kResponse, slot_place());
    }
    return superframe().on_air(kResponseBytes);
  }
  // As Tag::next_rx_window().
  [[nodiscard]] std::optional<Action> next_rx_window() const noexcept {
    return in_slots() ? std::nullopt : control_ahead();
  }
  [[nodiscard]] const AnchorMembership& membership() const noexcept { return membership_; }

 private:
  enum class Phase : std::uint8_t { kPoll, kResponse, kFinal };  // of the slot
  static constexpr int kSilent = 4;  // superframes without a POLL after which a slot counts as unused

  // The last exchange with one tag.
  struct Record {
    std::uint16_t tag = kNobody;
    std::uint16_t exchange = 0;
    std::uint32_t superframe = 0;
    bool valid = false;          // the RESPONSE was sent at `responded`
    bool closing_valid = false;  // a FINAL came in
    ClockTime responded{};       // A2
    Ticks closing{};             // A3 - A2
  };

  [[nodiscard]] std::optional<Action> slot_action(ClockTime now) noexcept override {
    if (superframe_number() != slots_of_) {
      slots_of_ = superframe_number();
      next_slot_ = 0;
    }
    while (next_slot_ < superframe().slot_count()) {
      enter_next_slot();
      const ClockTime due = poll_due(slots_of_, slot_);
      if (!ahead(due, now)) continue;
      phase_ = Phase::kPoll;
      return listen_in_slot(due);
    }
    constexpr std::uint32_t kTooMany = 2;
    const bool idle = ++polls_missing_ > kTooMany;
    coexistence().on_lack(idle, idle);
    end_superframe();
    next_slot_ = 0;
    return std::nullopt;
  }
  [[nodiscard]] Place slot_place() const noexcept override {
    return {slots_of_, static_cast<std::uint8_t>(slot_)};
  }
  [[nodiscard]] Step slot_transmitted(ClockTime timestamp) noexcept override {
    Record& record = *answered_;
    record.valid = timestamp == record.responded;
    if (!record.valid) ++counters().bad_stamps;
    if (!superframe().has_final()) return plan(timestamp);
    phase_ = Phase::kFinal;
    return act(listen(SlotKind::kFinal, poll_heard_ + superframe().final(polled_),
                      superframe().on_air(kFinalBytes), Ticks(0)));
  }
  [[nodiscard]] Step slot_received(const Reception& reception) noexcept override {
    const ClockTime now = reception.timestamp;
    if (phase_ == Phase::kPoll) go_on_to(now);
    const bool unused_slot = phase_ == Phase::kPoll && silent_[slot_] >= kSilent && !in_time(reception);
    if (const auto frame = accept(reception, slot_place(), unused_slot)) {
      if (const auto* poll = std::get_if<Poll>(&frame->body);
          poll != nullptr && phase_ == Phase::kPoll && is_of_slot(*frame, *poll, reception)) {
        silent_[slot_] = 0;
        pollers_[slot_] = frame->source;
        if (const auto action = answer(*frame, *poll, reception)) return act(*action);
      } else if (const auto* final = std::get_if<Final>(&frame->body);
                 final != nullptr && phase_ == Phase::kFinal) {
        close(*frame, *final, reception);
        return plan(now);
      } else if (overhear(*frame, reception)) {
        return plan(now);
      }
    }
    const auto rest = listen_on(now);
    return rest ? act(*rest) : plan(now);
  }
  void forget_exchanges() noexcept override {
    records_ = {};
    answered_ = nullptr;
    polls_missing_ = 0;
  }

  // The answer to a POLL heard in this slot, if the POLL asks for one.
  [[nodiscard]] std::optional<Action> answer(const Frame& frame, const Poll& poll,
                                             const Reception& reception) noexcept {
    if (!fresh()) return std::nullopt;
    if (!reception.timestamp_valid) {
      ++counters().bad_stamps;
      return std::nullopt;
    }
    const auto end = poll.anchors.begin() + poll.count;
    const auto self = std::find(poll.anchors.begin(), end, site().id);
    membership_.on_poll(owner_for(frame, poll), slot_, self != end);
    if (self == end) return std::nullopt;
    const auto index = static_cast<std::size_t>(self - poll.anchors.begin());

    polls_missing_ = 0;
    Record& record = record_of(frame.source);
    Response body{.exchange = poll.exchange, .health = health()};
    if (record.valid) {
      body.closed_exchange = record.exchange;
      if (superframe().has_final()) {
        body.closing_valid = record.closing_valid;
        body.closing = record.closing;
      } else {
        // This POLL closes the previous exchange if it directly follows it.
        const auto following = static_cast<std::uint16_t>(record.exchange + 1);
        body.closing = reception.timestamp - record.responded;
        body.closing_valid = poll.exchange == following && body.closing <= kMaxClosing;
      }
      if (!body.closing_valid) body.closing = Ticks(0);
    }

    poll_heard_ = reception.timestamp;
    polled_ = poll.count;
    const ClockTime timestamp =
        timestamp_not_after(reception.timestamp + superframe().response(index, poll.count));
    body.reply = timestamp - reception.timestamp;
    record = {.tag = frame.source,
              .exchange = poll.exchange,
              .superframe = poll.superframe,
              .responded = timestamp};
    answered_ = &record;
    phase_ = Phase::kResponse;
    return transmit(timestamp, frame.source, body, slot_place());
  }
  // Listens for the slot's POLL. Listens to an unused slot for its whole length and into the next slot's
  // POLL, because a frame there shows that another network is near.
  [[nodiscard]] Action listen_in_slot(ClockTime due) const noexcept {
    Action action = listen(SlotKind::kPoll, due, superframe().on_air(poll_bytes(superframe().responses())),
                           sync().margin(slots_of_));
    if (silent_[slot_] < kSilent) return action;
    // The next action, listening for a POLL or a beacon, is one slot length later.
    const bool last = next_slot_ >= superframe().slot_count();
    action.until = last ? std::max(action.until, action.at + superframe().tag_slot() - kToGetReady)
                        : action.until + superframe().tag_slot();
    action.preamble_until.reset();
    return action;
  }
  void enter_next_slot() noexcept {
    slot_ = next_slot_++;
    silent_[slot_] = static_cast<std::uint8_t>(std::min(silent_[slot_] + 1, 255));
  }
  // Assigns a frame that came after the end of a slot to the next slot.
  void go_on_to(ClockTime now) noexcept {
    while (next_slot_ < superframe().slot_count() && now >= poll_due(slots_of_, next_slot_) - tolerance()) {
      enter_next_slot();
    }
  }
  // The slot's POLL is due no earlier or later than by this.
  [[nodiscard]] Ticks tolerance() const noexcept { return superframe().guard() + sync().margin(slots_of_); }
  // The reception is where the POLL of the present slot is due.
  [[nodiscard]] bool in_time(const Reception& reception) const noexcept {
    const Ticks late = reception.timestamp - poll_due(slots_of_, slot_);
    return !reception.timestamp_valid || (late <= tolerance() && late >= -tolerance());
  }
  // The tag in whose slot the POLL is sent: its sender, or the present slot's owner, which lent it.
  [[nodiscard]] std::uint16_t owner_for(const Frame& frame, const Poll& poll) const noexcept {
    return poll.lent ? slots().owner_of(slot_) : frame.source;
  }
  // The POLL is in the present slot and its sender may poll there.
  [[nodiscard]] bool is_of_slot(const Frame& frame, const Poll& poll,
                                const Reception& reception) const noexcept {
    const std::uint16_t owner = owner_for(frame, poll);
    return poll.superframe == slots_of_ && poll.slot == slot_ && owner != kNobody &&
           slots().may_poll(owner, slot_) && in_time(reception);
  }
  // The sender of the next POLL in the present slot: the one of its last POLL, because several tags may share
  // the slot, or its owner has lent it. If there has been none for a while, the owner.
  [[nodiscard]] std::uint16_t expected_tag() const noexcept {
    const bool used = pollers_[slot_] != kNobody && silent_[slot_] < kSilent;
    return used ? pollers_[slot_] : slots().owner_of(slot_);
  }
  // The record of that tag, or the oldest one, cleared for it.
  [[nodiscard]] Record& record_of(std::uint16_t tag) noexcept {
    const auto rank = [&](const Record& record) -> std::uint64_t {
      if (record.tag == tag) return ~std::uint64_t{0};
      return record.tag == kNobody ? std::uint64_t{1} << 32 : slots_of_ - record.superframe;
    };
    Record& best = *std::max_element(records_.begin(), records_.end(),
                                     [&](const Record& a, const Record& b) { return rank(a) < rank(b); });
    if (best.tag != tag) best = {.tag = tag};
    return best;
  }
  void close(const Frame& frame, const Final& final, const Reception& reception) noexcept {
    Record& record = *answered_;
    if (frame.source != record.tag || final.exchange != record.exchange) {
      ++counters().stale_frames;
      return;
    }
    if (!reception.timestamp_valid) {
      ++counters().bad_stamps;
      return;
    }
    record.closing = reception.timestamp - record.responded;
    record.closing_valid = true;
  }

  AnchorMembership membership_;
  Phase phase_ = Phase::kPoll;
  std::uint32_t slots_of_ = 0;                     // superframe that the slot indices refer to
  std::size_t next_slot_ = 0;                      // index of the next slot
  std::size_t slot_ = 0;                           // index of the present slot
  std::array<std::uint8_t, kMaxTags> silent_{};    // of each slot: superframes without a POLL
  std::array<std::uint16_t, kMaxTags> pollers_{};  // of each slot: the sender of its last POLL
  std::uint32_t polls_missing_ = 0;                // superframes without a POLL that names this anchor
  ClockTime poll_heard_{};
  std::size_t polled_ = 0;      // number of anchors in the POLL
  Record* answered_ = nullptr;  // of the POLL's sender
  std::array<Record, kMaxTags> records_{};
};

}  // namespace groma::mac
