#include "firmware/core/mac/anchor.hpp"

#include <algorithm>

namespace groma::mac {

using ranging::ClockTime;
using ranging::Ticks;

Anchor::Anchor(const Site& site, groma_Counters& counters) noexcept : station_(site, counters) {}

Step Anchor::doing(const Action& action) noexcept {
  doing_ = action;
  return {action, nullptr};
}

Step Anchor::start(ClockTime now) noexcept {
  records_ = {};
  station_.sync().search();
  if (is_master()) {
    constexpr Ticks kHead = Ticks::from_us(5'000);
    station_.sync().lead(ClockTime(0) + ranging::round_up_to_grid(now + kHead - ClockTime(0)));
    // "Past the last slot" of the one before the first.
    superframe_ = ~std::uint32_t{0};
    next_slot_ = station_.superframe().tag_count();
  }
  return doing(plan(now));
}

Action Anchor::plan(ClockTime now) noexcept {
  for (;;) {
    if (station_.sync().state() == SyncState::kSearching) {
      phase_ = Phase::kSearching;
      return Station::search(now);
    }
    if (next_slot_ >= station_.superframe().tag_count()) {
      ++superframe_;
      next_slot_ = 0;
      if (station_.ahead(station_.beacon_due(superframe_), now)) {
        phase_ = Phase::kBeacon;
        return is_master() ? beacon() : station_.listen_for_beacon(superframe_);
      }
      if (!is_master()) station_.beacon_missed(superframe_);
      continue;
    }
    slot_ = next_slot_++;
    const ClockTime due = station_.poll_due(superframe_, slot_);
    if (station_.ahead(due, now)) {
      phase_ = Phase::kPoll;
      return station_.listen(due, poll_bytes(station_.site().schedule.anchor_ids_count),
                             station_.sync().margin(superframe_));
    }
  }
}

Action Anchor::beacon() noexcept {
  const Beacon body{
      .superframe = superframe_, .epoch = station_.site().schedule.epoch, .schedule_hash = station_.hash()};
  return station_.transmit(station_.stamp_not_after(station_.beacon_due(superframe_)), kBroadcast, body);
}

Step Anchor::on_transmitted(ClockTime stamp) noexcept {
  ++station_.counters().frames_sent;
  if (phase_ != Phase::kResponse) return doing(plan(stamp));
  Record& record = records_[slot_];
  record.valid = stamp == record.responded;
  if (!record.valid) ++station_.counters().bad_stamps;
  if (!station_.superframe().has_final()) return doing(plan(stamp));
  phase_ = Phase::kFinal;
  return doing(station_.listen(poll_heard_ + station_.superframe().final(polled_), kFinalBytes, Ticks(0)));
}

Step Anchor::on_late(ClockTime now) noexcept {
  ++station_.counters().late_transmits;
  return doing(plan(now));
}

Step Anchor::on_received(const Reception& reception) noexcept {
  const auto frame = station_.accept(reception);
  if (frame) {
    if (const auto* beacon = std::get_if<Beacon>(&frame->body)) {
      if (!is_master() && station_.take_beacon(*frame, *beacon, reception)) {
        superframe_ = beacon->superframe;
        next_slot_ = 0;
        return doing(plan(reception.stamp));
      }
    } else if (const auto* poll = std::get_if<Poll>(&frame->body);
               poll != nullptr && phase_ == Phase::kPoll) {
      if (const auto action = answer(*frame, *poll, reception)) return doing(*action);
    } else if (const auto* final = std::get_if<Final>(&frame->body);
               final != nullptr && phase_ == Phase::kFinal) {
      close(*frame, *final, reception);
      return doing(plan(reception.stamp));
    }
  }
  return listen_on_or(reception.stamp);
}

std::optional<Action> Anchor::answer(const Frame& frame, const Poll& poll,
                                     const Reception& reception) noexcept {
  const groma_Schedule& schedule = station_.site().schedule;
  if (poll.superframe != superframe_ || poll.slot != slot_ || frame.source != schedule.tag_ids[slot_]) {
    ++station_.counters().stale_frames;
    return std::nullopt;
  }
  if (!reception.stamp_valid) {
    ++station_.counters().bad_stamps;
    return std::nullopt;
  }
  const auto end = poll.anchors.begin() + poll.count;
  const auto self = std::find(poll.anchors.begin(), end, station_.site().id);
  if (self == end) return std::nullopt;
  const auto index = static_cast<std::size_t>(self - poll.anchors.begin());

  Record& record = records_[slot_];
  Response body{.exchange = poll.exchange};
  if (record.valid) {
    body.closed_exchange = record.exchange;
    if (station_.superframe().has_final()) {
      body.closing_valid = record.closing.has_value();
      body.closing = record.closing.value_or(Ticks(0));
    } else {
      // This POLL closes the exchange before, if it follows it directly.
      const auto following = static_cast<std::uint16_t>(record.exchange + 1);
      body.closing = reception.stamp - record.responded;
      body.closing_valid = poll.exchange == following && body.closing <= kMaxClosing;
    }
    if (!body.closing_valid) body.closing = Ticks(0);
  }

  poll_heard_ = reception.stamp;
  polled_ = poll.count;
  const ClockTime stamp =
      station_.stamp_not_after(reception.stamp + station_.superframe().response(index, poll.count));
  body.reply = stamp - reception.stamp;
  record = {.exchange = poll.exchange, .responded = stamp};
  phase_ = Phase::kResponse;
  return station_.transmit(stamp, frame.source, body);
}

void Anchor::close(const Frame& frame, const Final& final, const Reception& reception) noexcept {
  Record& record = records_[slot_];
  if (frame.source != station_.site().schedule.tag_ids[slot_] || final.exchange != record.exchange) {
    ++station_.counters().stale_frames;
    return;
  }
  if (!reception.stamp_valid) {
    ++station_.counters().bad_stamps;
    return;
  }
  record.closing = reception.stamp - record.responded;
}

Step Anchor::on_timeout(ClockTime now) noexcept {
  if (phase_ == Phase::kBeacon) station_.beacon_missed(superframe_);
  return doing(plan(now));
}

Step Anchor::resume(ClockTime now) noexcept {
  if (phase_ == Phase::kBeacon && !is_master()) station_.beacon_missed(superframe_);
  return doing(plan(now));
}

// After a frame of no use.
Step Anchor::listen_on_or(ClockTime now) noexcept {
  if (phase_ == Phase::kSearching) return doing(Station::search(now));
  if (doing_.preamble_until && now < *doing_.preamble_until) return doing(Station::listen_on(doing_));
  return on_timeout(now);
}

}  // namespace groma::mac
