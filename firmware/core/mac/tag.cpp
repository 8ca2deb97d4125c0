#include "firmware/core/mac/tag.hpp"

#include <algorithm>
#include <span>
#include <utility>

namespace groma::mac {
namespace {

Place place_of(const Exchange& exchange) noexcept {
  return {exchange.superframe, exchange.slot};
}

}  // namespace

using ranging::ClockTime;
using ranging::Ticks;

Tag::Tag(const Site& site, groma_Counters& counters) noexcept
    : station_(site, counters), membership_(site.id, *site.schedule, station_.slots(), site.lender) {
  station_.attach(membership_);
}

Step Tag::start(ClockTime now) noexcept {
  station_.start(now);
  previous_valid_ = false;
  windows_over_ = 0;
  return {plan(now), nullptr};
}

Action Tag::plan(ClockTime now) noexcept {
  for (;;) {
    phase_ = Phase::kControl;
    if (const auto action = station_.control(now)) return *action;
    const std::uint32_t superframe = station_.superframe_number();
    station_.end_superframe();
    if (membership_.outdated(superframe)) station_.on_lack(false, true);
    const auto slot = has_lent() ? std::nullopt : membership_.slot(superframe);
    if (slot && station_.ahead(station_.poll_due(superframe, *slot), now) && station_.sure(superframe)) {
      phase_ = Phase::kPoll;
      return poll(superframe, *slot);
    }
  }
}

void Tag::choose_anchors() noexcept {
  AnchorSet& anchors = membership_.anchors();
  for (const Leg& leg : std::span(previous().legs).first(windows_over_)) {
    if (leg.answered) {
      anchors.on_answer(leg.anchor, link_quality(leg.quality));
    } else {
      anchors.on_silence(leg.anchor);
    }
  }
  windows_over_ = 0;
  if (next_count_ != 0) return;
  const std::size_t places = std::min(station_.superframe().responses(), kMaxAnchors);
  next_count_ = static_cast<std::uint8_t>(anchors.choose(std::span(next_anchors_).first(places)));
}

// Uses each number once, even if its POLL is not sent, so that no anchor can close one exchange with
// another's frame.
Action Tag::poll(std::uint32_t superframe, std::size_t slot) noexcept {
  choose_anchors();
  Exchange& exchange = current();
  exchange.number = next_number_++;
  exchange.superframe = superframe;
  exchange.slot = static_cast<std::uint8_t>(slot);
  exchange.count = std::exchange(next_count_, std::uint8_t{0});
  exchange.closing_sent.reset();
  Poll body{.exchange = exchange.number,
            .superframe = exchange.superframe,
            .slot = exchange.slot,
            .lent = membership_.borrows(),
            .count = exchange.count};
  for (std::size_t i = 0; i < exchange.count; ++i) {
    exchange.legs[i] = Leg{.anchor = next_anchors_[i]};
    body.anchors[i] = next_anchors_[i];
  }
  const ClockTime timestamp = station_.timestamp_not_after(station_.poll_due(superframe, slot));
  return station_.transmit(timestamp, kBroadcast, body, place_of(exchange));
}

Step Tag::on_transmitted(ClockTime timestamp) noexcept {
  if (phase_ == Phase::kControl) {
    station_.on_control_transmitted(timestamp);
    return {plan(timestamp), nullptr};
  }
  ++station_.counters().frames_sent;
  if (phase_ == Phase::kFinal) {
    current().closing_sent = timestamp;
    return finish(timestamp);
  }
  Exchange& exchange = current();
  exchange.poll_sent = timestamp;
  // If the closing frame is later, clock drift distorts the range: at 2 ppm/s by 0.7 m for each second.
  constexpr std::uint32_t kLatestClosing = 2;
  if (previous_valid_ && !station_.superframe().has_final() &&
      exchange.superframe - previous().superframe <= kLatestClosing) {
    previous().closing_sent = timestamp;
  }
  phase_ = Phase::kResponses;
  window_ = 0;
  return {response_window(window_), nullptr};
}

Step Tag::on_late(ClockTime now) noexcept {
  if (phase_ == Phase::kControl) {
    station_.on_control_late();
    return {plan(now), nullptr};
  }
  ++station_.counters().late_transmits;
  if (phase_ == Phase::kFinal) return finish(now);
  return {plan(now), nullptr};
}

std::optional<Action> Tag::next_rx_window() const noexcept {
  if (phase_ == Phase::kControl) return station_.control_ahead();
  if (phase_ != Phase::kResponses) return std::nullopt;
  if (window_ + 1 < current().count) return response_window(window_ + 1);
  if (station_.superframe().has_final()) return std::nullopt;
  return station_.control_ahead();
}

Action Tag::response_window(std::size_t index) const noexcept {
  const Exchange& exchange = current();
  const ClockTime due = exchange.poll_sent + station_.superframe().response(index, exchange.count);
  return station_.listen(SlotKind::kResponse, due, station_.superframe().on_air(kResponseBytes), Ticks(0));
}

Step Tag::on_received(const Reception& reception) noexcept {
  if (phase_ == Phase::kControl) {
    if (const auto rest = station_.on_control_received(reception)) return {*rest, nullptr};
    return {plan(reception.timestamp), nullptr};
  }
  if (const auto frame = station_.accept(reception, place_of(current()))) {
    if (const auto* response = std::get_if<Response>(&frame->body)) {
      take_response(*frame, *response, reception);
    } else if (station_.overhear(*frame, reception)) {
      return finish(reception.timestamp);
    }
  }
  return next_window(reception.timestamp);
}

void Tag::begin_verify(std::span<const std::uint8_t> frame) noexcept {
  station_.begin_verify(frame, phase_ == Phase::kControl ? station_.control_place() : place_of(current()));
}

std::size_t Tag::precompute() noexcept {
  if (!station_.keyed()) return 0;
  if (phase_ == Phase::kResponses) {
    station_.expect_heard(current().legs[window_].anchor, FrameType::kResponse, place_of(current()));
  } else if (phase_ == Phase::kControl) {
    station_.prepare_control();
    const std::uint32_t superframe = station_.superframe_number();
    const auto slot = station_.before_slots() ? membership_.slot(superframe) : std::nullopt;
    if (slot) station_.expect_said(FrameType::kPoll, {superframe, static_cast<std::uint8_t>(*slot)});
  }
  return 0;
}

Leg* Tag::previous_leg(std::uint16_t anchor) noexcept {
  if (!previous_valid_) return nullptr;
  Exchange& before = previous();
  const auto end = before.legs.begin() + before.count;
  const auto found =
      std::find_if(before.legs.begin(), end, [=](const Leg& leg) { return leg.anchor == anchor; });
  return found == end ? nullptr : &*found;
}

void Tag::take_response(const Frame& frame, const Response& response, const Reception& reception) noexcept {
  Exchange& exchange = current();
  Leg& leg = exchange.legs[window_];
  const ClockTime due = exchange.poll_sent + station_.superframe().response(window_, exchange.count);
  const Ticks guard = station_.superframe().guard();
  const bool in_window = reception.timestamp >= due - guard && reception.timestamp <= due + guard;
  if (frame.source != leg.anchor || response.exchange != exchange.number ||
      (reception.timestamp_valid && !in_window)) {
    ++station_.counters().stale_frames;
    return;
  }
  if (!reception.timestamp_valid) ++station_.counters().bad_stamps;
  leg.answered = true;
  leg.timestamp_valid = reception.timestamp_valid;
  leg.received = reception.timestamp;
  leg.reply = response.reply;
  leg.health = response.health;
  leg.quality = reception.quality;

  if (!response.closing_valid) return;
  Leg* open = previous_leg(leg.anchor);
  if (open == nullptr) return;
  const bool same = response.closed_exchange == previous().number;
  open->closing_state = same ? Leg::Closing::kHeld : Leg::Closing::kStale;
  open->closing = response.closing;
}

Step Tag::next_window(ClockTime now) noexcept {
  const Exchange& exchange = current();
  if (++window_ < exchange.count) return {response_window(window_), nullptr};
  if (!station_.superframe().has_final()) return finish(now);
  phase_ = Phase::kFinal;
  const ClockTime timestamp =
      station_.timestamp_not_after(exchange.poll_sent + station_.superframe().final(exchange.count));
  return {station_.transmit(timestamp, kBroadcast, Final{exchange.number}, place_of(exchange)), nullptr};
}

// Reports interference if the answers are less than half of the usual twice in a row.
void Tag::watch_answers() noexcept {
  const Exchange& exchange = current();
  const auto answers =
      static_cast<std::uint8_t>(std::count_if(exchange.legs.begin(), exchange.legs.begin() + exchange.count,
                                              [](const Leg& leg) { return leg.answered; }));
  const bool poor = 2 * answers < usual_answers_ || answers == 0;
  constexpr std::uint8_t kAlone = 4;
  unanswered_ =
      answers != 0 ? std::uint8_t{0} : static_cast<std::uint8_t>(std::min(unanswered_ + 1, int{kAlone}));
  station_.on_lack(poor && was_poor_, unanswered_ == kAlone);
  was_poor_ = poor;
  if (answers == 0) station_.on_silence();
  usual_answers_ = std::max<std::uint8_t>(answers, usual_answers_ == 0 ? 0 : usual_answers_ - 1);
}

// Each anchor has had its chance to close the previous exchange.
Step Tag::finish(ClockTime now) noexcept {
  watch_answers();
  const Exchange* completed = previous_valid_ ? &previous() : nullptr;
  windows_over_ = static_cast<std::uint8_t>(std::min<std::size_t>(window_, current().count));
  current_ = (current_ + 1) % 3;
  previous_valid_ = true;
  return {plan(now), completed};
}

Step Tag::on_timeout(ClockTime now) noexcept {
  if (phase_ == Phase::kResponses) return next_window(now);
  station_.on_control_timeout();
  return {plan(now), nullptr};
}

// No exchange may span the restart.
void Tag::on_clock_restart() noexcept {
  station_.on_clock_restart();
  phase_ = Phase::kControl;
  previous_valid_ = false;
  windows_over_ = 0;
}

Step Tag::resume(ClockTime now) noexcept {
  station_.resume(now);
  if (phase_ == Phase::kResponses || phase_ == Phase::kFinal) return finish(now);
  return {plan(now), nullptr};
}

}  // namespace groma::mac
