// The tag: follows the network's time, polls its anchors in its slot, and collects their answers.
//
//   Station (search, beacon, shared slot) --> POLL --> RESPONSE windows --> [FINAL] --> Station
//
// Each RESPONSE window is timed from the POLL: an anchor that does not answer costs only its own range. A
// RESPONSE counts only in its own window, from the anchor whose turn it is, and for the exchange in progress.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <utility>

#include "firmware/core/mac/membership.hpp"
#include "firmware/core/mac/station.hpp"
#include "firmware/core/mac/step.hpp"

namespace groma::mac {

class Tag final : public Station {
 public:
  // `counters` outlives the tag. The tag polls once the schedule or a beacon assigns it a slot, unless that
  // is lent.
  Tag(const Site& site, groma_Counters& counters) noexcept
      : Station(site, counters), membership_(site.id, *site.schedule, slots(), site.lender) {
    attach(membership_);
  }

  std::size_t precompute() noexcept {
    if (!keyed()) return 0;
    if (!in_slots()) {
      prepare_control();
      const auto slot = before_slots() ? membership_.slot(superframe_number()) : std::nullopt;
      const auto index = static_cast<std::uint8_t>(slot.value_or(0));
      if (slot) authenticator().expect_sent(site().id, FrameType::kPoll, {superframe_number(), index});
    } else if (phase_ == Phase::kResponses) {
      authenticator().expect_received(current().legs[window_].anchor, FrameType::kResponse, slot_place());
    }
    return 0;
  }
  // The action that follows the listening in progress whatever it brings, so that it can be armed before its
  // result is known. Nothing if it depends on the result.
  [[nodiscard]] std::optional<Action> next_rx_window() const noexcept {
    if (!in_slots()) return control_ahead();
    if (phase_ != Phase::kResponses) return std::nullopt;
    if (window_ + 1 < current().count) return response_window(window_ + 1);
    return superframe().has_final() ? std::nullopt : control_ahead();
  }

  // Evaluates the last exchange and chooses the anchors of the next one. Call when there is time; otherwise
  // the POLL does it.
  void choose_anchors() noexcept {
    AnchorSet& anchors = membership_.anchors();
    for (const Leg& leg : std::span(previous().legs).first(windows_over_)) {
      leg.answered ? anchors.on_answer(leg.anchor, link_quality(leg.quality))
                   : anchors.on_silence(leg.anchor);
    }
    windows_over_ = 0;
    if (next_count_ != 0) return;
    const std::size_t places = std::min(superframe().responses(), kMaxAnchors);
    next_count_ = static_cast<std::uint8_t>(anchors.choose(std::span(next_anchors_).first(places)));
  }
  [[nodiscard]] TagMembership& membership() noexcept { return membership_; }
  [[nodiscard]] const TagMembership& membership() const noexcept { return membership_; }

 private:
  enum class Phase : std::uint8_t { kPoll, kResponses, kFinal };  // of the slot

  [[nodiscard]] std::optional<Action> slot_action(ClockTime now) noexcept override {
    const std::uint32_t superframe = superframe_number();
    end_superframe();
    if (slots().outdated(superframe)) coexistence().on_lack(false, true);
    const bool lent = site().lent_until_us != nullptr && site().lent_until_us->has_value();
    const auto slot = lent ? std::nullopt : membership_.slot(superframe);
    if (!slot || !ahead(poll_due(superframe, *slot), now) || !sure(superframe)) return std::nullopt;
    return poll(superframe, *slot);
  }
  [[nodiscard]] Place slot_place() const noexcept override { return {current().superframe, current().slot}; }
  [[nodiscard]] Step slot_transmitted(ClockTime timestamp) noexcept override {
    Exchange& exchange = current();
    if (phase_ == Phase::kFinal) {
      exchange.closing_sent = timestamp;
      return finish(timestamp);
    }
    exchange.poll_sent = timestamp;
    // If the closing frame is later, clock drift distorts the range: at 2 ppm/s by 0.7 m for each second.
    constexpr std::uint32_t kLatestClosing = 2;
    if (previous_valid_ && !superframe().has_final() &&
        exchange.superframe - previous().superframe <= kLatestClosing) {
      previous().closing_sent = timestamp;
    }
    phase_ = Phase::kResponses;
    window_ = 0;
    return act(response_window(window_));
  }
  [[nodiscard]] Step slot_received(const Reception& reception) noexcept override {
    if (const auto frame = accept(reception, slot_place())) {
      if (const auto* response = std::get_if<Response>(&frame->body)) {
        take_response(*frame, *response, reception);
      } else if (overhear(*frame, reception)) {
        return finish(reception.timestamp);
      }
    }
    return next_window(reception.timestamp);
  }
  [[nodiscard]] Step slot_timeout(ClockTime now) noexcept override { return next_window(now); }
  // A POLL that was not sent leaves no exchange behind.
  [[nodiscard]] Step slot_abandoned(ClockTime now) noexcept override {
    return phase_ == Phase::kPoll ? plan(now) : finish(now);
  }
  void forget_exchanges() noexcept override {
    phase_ = Phase::kPoll;
    previous_valid_ = false;
    windows_over_ = 0;
  }

  // Uses each number once, even if its POLL is not sent, so that no anchor can close one exchange with
  // another's frame.
  Action poll(std::uint32_t superframe, std::size_t slot) noexcept {
    choose_anchors();
    phase_ = Phase::kPoll;
    Exchange& exchange = current();
    exchange.number = next_number_++;
    exchange.superframe = superframe;
    exchange.slot = static_cast<std::uint8_t>(slot);
    exchange.count = std::exchange(next_count_, std::uint8_t{0});
    exchange.closing_sent.reset();
    for (std::size_t i = 0; i < exchange.count; ++i) exchange.legs[i] = Leg{.anchor = next_anchors_[i]};
    const Poll body{.exchange = exchange.number,
                    .superframe = superframe,
                    .slot = exchange.slot,
                    .lent = membership_.borrows(),
                    .count = exchange.count,
                    .anchors = next_anchors_};
    const ClockTime timestamp = timestamp_not_after(poll_due(superframe, slot));
    return transmit(timestamp, kBroadcast, body, slot_place());
  }
  [[nodiscard]] ClockTime response_due(std::size_t index) const noexcept {
    return current().poll_sent + superframe().response(index, current().count);
  }
  [[nodiscard]] Action response_window(std::size_t index) const noexcept {
    return listen(SlotKind::kResponse, response_due(index), superframe().on_air(kResponseBytes), Ticks(0));
  }
  void take_response(const Frame& frame, const Response& response, const Reception& reception) noexcept {
    Leg& leg = current().legs[window_];
    const Ticks late = reception.timestamp - response_due(window_);
    const bool in_window = late >= -superframe().guard() && late <= superframe().guard();
    if (frame.source != leg.anchor || response.exchange != current().number ||
        (reception.timestamp_valid && !in_window)) {
      ++counters().stale_frames;
      return;
    }
    if (!reception.timestamp_valid) ++counters().bad_stamps;
    leg.answered = true;
    leg.timestamp_valid = reception.timestamp_valid;
    leg.received = reception.timestamp;
    leg.reply = response.reply;
    leg.health = response.health;
    leg.quality = reception.quality;

    if (!response.closing_valid || !previous_valid_) return;
    const auto legs = std::span(previous().legs).first(previous().count);
    const auto open =
        std::find_if(legs.begin(), legs.end(), [&](const Leg& one) { return one.anchor == leg.anchor; });
    if (open == legs.end()) return;
    const bool same = response.closed_exchange == previous().number;
    open->closing_state = same ? Leg::Closing::kHeld : Leg::Closing::kStale;
    open->closing = response.closing;
  }
  // Reports interference if the answers are less than half of the usual twice in a row.
  void watch_answers() noexcept {
    const auto legs = std::span(current().legs).first(current().count);
    const auto answers = static_cast<std::uint8_t>(
        std::count_if(legs.begin(), legs.end(), [](const Leg& leg) { return leg.answered; }));
    const bool poor = 2 * answers < usual_answers_ || answers == 0;
    constexpr std::uint8_t kAlone = 4;
    unanswered_ =
        answers != 0 ? std::uint8_t{0} : static_cast<std::uint8_t>(std::min(unanswered_ + 1, int{kAlone}));
    coexistence().on_lack(poor && was_poor_, unanswered_ == kAlone);
    was_poor_ = poor;
    if (answers == 0 && sync().state() == SyncState::kCoasting) coexistence().on_silence();
    usual_answers_ = std::max<std::uint8_t>(answers, usual_answers_ == 0 ? 0 : usual_answers_ - 1);
  }
  Step next_window(ClockTime now) noexcept {
    const Exchange& exchange = current();
    if (++window_ < exchange.count) return act(response_window(window_));
    if (!superframe().has_final()) return finish(now);
    phase_ = Phase::kFinal;
    const ClockTime timestamp = timestamp_not_after(exchange.poll_sent + superframe().final(exchange.count));
    return act(transmit(timestamp, kBroadcast, Final{exchange.number}, slot_place()));
  }
  // Each anchor has had its chance to close the previous exchange.
  Step finish(ClockTime now) noexcept {
    watch_answers();
    const Exchange* completed = previous_valid_ ? &previous() : nullptr;
    windows_over_ = static_cast<std::uint8_t>(std::min<std::size_t>(window_, current().count));
    current_ = (current_ + 1) % 3;
    previous_valid_ = true;
    Step step = plan(now);
    step.completed = completed;
    return step;
  }

  [[nodiscard]] Exchange& current() noexcept { return exchanges_[current_]; }
  [[nodiscard]] const Exchange& current() const noexcept { return exchanges_[current_]; }
  [[nodiscard]] Exchange& previous() noexcept { return exchanges_[(current_ + 2) % 3]; }

  TagMembership membership_;
  Phase phase_ = Phase::kPoll;
  std::uint8_t usual_answers_ = 0;  // RESPONSEs in one exchange
  bool was_poor_ = false;
  std::uint8_t unanswered_ = 0;  // exchanges in a row
  std::uint16_t next_number_ = 0;
  std::size_t window_ = 0;
  // The exchange in progress, the one before, which waits for its closing timestamps, and the completed one
  // before that.
  std::array<Exchange, 3> exchanges_{};
  std::size_t current_ = 0;
  bool previous_valid_ = false;
  std::uint8_t windows_over_ = 0;  // windows of the last exchange that choose_anchors() has not evaluated
  std::uint8_t next_count_ = 0;    // chosen for the next POLL; 0: not chosen yet
  std::array<std::uint16_t, kMaxAnchors> next_anchors_{};
};

}  // namespace groma::mac
