#include "firmware/core/mac/tag.hpp"

#include <algorithm>

namespace groma::mac {

using ranging::ClockTime;
using ranging::Ticks;

Tag::Tag(const Site& site, groma_Counters& counters) noexcept : station_(site, counters) {
  const auto& tags = site.schedule.tag_ids;
  slot_ = static_cast<std::size_t>(std::find(tags, tags + site.schedule.tag_ids_count, site.id) - tags);
}

Step Tag::listening(const Action& action, const Exchange* completed) noexcept {
  listening_ = action;
  return {action, completed};
}

Step Tag::start(ClockTime now) noexcept {
  station_.sync().search();
  previous_valid_ = false;
  return listening(plan(now));
}

Action Tag::plan(ClockTime now) noexcept {
  for (;;) {
    if (station_.sync().state() == SyncState::kSearching) {
      phase_ = Phase::kSearching;
      return Station::search(now);
    }
    if (beacon_next_) {
      beacon_next_ = false;
      if (station_.ahead(station_.beacon_due(superframe_), now)) {
        phase_ = Phase::kBeacon;
        return station_.listen_for_beacon(superframe_);
      }
      station_.beacon_missed(superframe_);
      continue;
    }
    const std::uint32_t superframe = superframe_++;
    beacon_next_ = true;
    const bool in_time = station_.ahead(station_.poll_due(superframe, slot_), now);
    if (in_time && station_.sync().margin(superframe) <= station_.superframe().guard()) {
      phase_ = Phase::kPoll;
      return poll();
    }
  }
}

// In the slot of the superframe before superframe_. A number is used once, whether or not its POLL gets out,
// so that no anchor can close one exchange with another's frame.
Action Tag::poll() noexcept {
  const groma_Schedule& schedule = station_.site().schedule;
  Exchange& exchange = current();
  exchange.number = next_number_++;
  exchange.superframe = superframe_ - 1;
  exchange.slot = static_cast<std::uint8_t>(slot_);
  exchange.count = static_cast<std::uint8_t>(schedule.anchor_ids_count);
  exchange.closing_sent.reset();
  Poll body{.exchange = exchange.number,
            .superframe = exchange.superframe,
            .slot = exchange.slot,
            .count = exchange.count};
  for (std::size_t i = 0; i < exchange.count; ++i) {
    exchange.legs[i] = Leg{.anchor = schedule.anchor_ids[i]};
    body.anchors[i] = schedule.anchor_ids[i];
  }
  const ClockTime stamp = station_.stamp_not_after(station_.poll_due(exchange.superframe, slot_));
  return station_.transmit(stamp, kBroadcast, body);
}

Step Tag::on_transmitted(ClockTime stamp) noexcept {
  ++station_.counters().frames_sent;
  if (phase_ == Phase::kFinal) {
    current().closing_sent = stamp;
    return finish(stamp);
  }
  Exchange& exchange = current();
  exchange.poll_sent = stamp;
  if (previous_valid_ && !station_.superframe().has_final()) previous().closing_sent = stamp;
  phase_ = Phase::kResponses;
  window_ = 0;
  return listening(response_window());
}

Step Tag::on_late(ClockTime now) noexcept {
  ++station_.counters().late_transmits;
  if (phase_ == Phase::kFinal) return finish(now);
  return listening(plan(now));
}

Action Tag::response_window() noexcept {
  const Exchange& exchange = current();
  const ClockTime due = exchange.poll_sent + station_.superframe().response(window_, exchange.count);
  return station_.listen(due, kResponseBytes, Ticks(0));
}

Step Tag::on_received(const Reception& reception) noexcept {
  const auto frame = station_.accept(reception);
  if (phase_ == Phase::kResponses) {
    const auto* response = frame ? std::get_if<Response>(&frame->body) : nullptr;
    if (response != nullptr) {
      take_response(*frame, *response, reception);
    } else if (frame) {
      ++station_.counters().stale_frames;
    }
    return next_window(reception.stamp);
  }
  if (frame) {
    if (const auto* beacon = std::get_if<Beacon>(&frame->body)) {
      if (station_.take_beacon(*frame, *beacon, reception)) {
        superframe_ = beacon->superframe;
        beacon_next_ = false;
        return listening(plan(reception.stamp));
      }
    }
  }
  return listen_on_or(reception.stamp);
}

void Tag::take_response(const Frame& frame, const Response& response, const Reception& reception) noexcept {
  Exchange& exchange = current();
  Leg& leg = exchange.legs[window_];
  const ClockTime due = exchange.poll_sent + station_.superframe().response(window_, exchange.count);
  const Ticks guard = station_.superframe().guard();
  const bool in_window = reception.stamp >= due - guard && reception.stamp <= due + guard;
  if (frame.source != leg.anchor || response.exchange != exchange.number ||
      (reception.stamp_valid && !in_window)) {
    ++station_.counters().stale_frames;
    return;
  }
  if (!reception.stamp_valid) ++station_.counters().bad_stamps;
  leg.answered = true;
  leg.stamp_valid = reception.stamp_valid;
  leg.received = reception.stamp;
  leg.reply = response.reply;
  leg.quality = reception.quality;

  if (!previous_valid_ || !response.closing_valid) return;
  Exchange& before = previous();
  const auto end = before.legs.begin() + before.count;
  const auto open =
      std::find_if(before.legs.begin(), end, [&](const Leg& other) { return other.anchor == leg.anchor; });
  if (open == end) return;
  const bool same = response.closed_exchange == before.number;
  open->closing_state = same ? Leg::Closing::kHeld : Leg::Closing::kStale;
  open->closing = response.closing;
}

Step Tag::next_window(ClockTime now) noexcept {
  const Exchange& exchange = current();
  if (++window_ < exchange.count) return listening(response_window());
  if (!station_.superframe().has_final()) return finish(now);
  phase_ = Phase::kFinal;
  const ClockTime stamp =
      station_.stamp_not_after(exchange.poll_sent + station_.superframe().final(exchange.count));
  return {station_.transmit(stamp, kBroadcast, Final{exchange.number}), nullptr};
}

// The exchange before has had its chance to be closed by each anchor.
Step Tag::finish(ClockTime now) noexcept {
  const Exchange* completed = previous_valid_ ? &previous() : nullptr;
  current_ = (current_ + 1) % 3;
  previous_valid_ = true;
  return listening(plan(now), completed);
}

Step Tag::on_timeout(ClockTime now) noexcept {
  if (phase_ == Phase::kResponses) return next_window(now);
  if (phase_ == Phase::kBeacon) station_.beacon_missed(superframe_);
  return listening(plan(now));
}

Step Tag::resume(ClockTime now) noexcept {
  if (phase_ == Phase::kResponses || phase_ == Phase::kFinal) return finish(now);
  if (phase_ == Phase::kBeacon) station_.beacon_missed(superframe_);
  return listening(plan(now));
}

// After a frame of no use while waiting for a beacon.
Step Tag::listen_on_or(ClockTime now) noexcept {
  if (phase_ == Phase::kSearching) return listening(Station::search(now));
  if (listening_.preamble_until && now < *listening_.preamble_until) {
    return listening(Station::listen_on(listening_));
  }
  return on_timeout(now);
}

}  // namespace groma::mac
