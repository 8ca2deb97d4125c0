#include "firmware/core/mac/anchor.hpp"

#include <algorithm>

namespace groma::mac {

using ranging::ClockTime;
using ranging::Ticks;

namespace {

constexpr int kSilent = 4;  // superframes without a POLL after which a slot counts as unused

}  // namespace

Anchor::Anchor(const Site& site, groma_Counters& counters) noexcept
    : station_(site, counters), membership_(site.id, *site.schedule, station_.slots()) {
  station_.attach(membership_);
}

Step Anchor::doing(const Action& action) noexcept {
  doing_ = action;
  return {action, nullptr};
}

Step Anchor::start(ClockTime now) noexcept {
  records_ = {};
  answered_ = nullptr;
  polls_missing_ = 0;
  station_.start(now);
  return doing(plan(now));
}

Action Anchor::plan(ClockTime now) noexcept {
  for (;;) {
    if (const auto action = station_.control(now)) {
      phase_ = Phase::kControl;
      next_slot_ = 0;
      return *action;
    }
    const std::uint32_t superframe = station_.superframe_number();
    if (superframe != slots_of_) {
      slots_of_ = superframe;
      next_slot_ = 0;
    }
    if (next_slot_ >= station_.superframe().slot_count()) {
      end_superframe();
      continue;
    }
    slot_ = next_slot_++;
    silent_[slot_] = static_cast<std::uint8_t>(std::min(silent_[slot_] + 1, 255));
    const ClockTime due = station_.poll_due(superframe, slot_);
    if (station_.ahead(due, now)) {
      phase_ = Phase::kPoll;
      return listen_in_slot(due);
    }
  }
}

// Listens to an unused slot for its whole length and into the next slot's POLL, because a frame there shows
// that another network is near.
Action Anchor::listen_in_slot(ClockTime due) const noexcept {
  const Superframe& superframe = station_.superframe();
  Action action = station_.listen(SlotKind::kPoll, due, superframe.on_air(poll_bytes(superframe.responses())),
                                  station_.sync().margin(slots_of_));
  if (silent_[slot_] < kSilent) return action;
  // The next action, listening for a POLL or a beacon, is one slot length later.
  const bool last = next_slot_ >= superframe.slot_count();
  action.until = last ? std::max(action.until, action.at + superframe.tag_slot() - Station::kToGetReady)
                      : action.until + superframe.tag_slot();
  action.preamble_until.reset();
  return action;
}

// Assigns a frame that came after the end of a slot to the next slot.
void Anchor::go_on_to(ClockTime now) noexcept {
  const Ticks early = station_.superframe().guard() + station_.sync().margin(slots_of_);
  while (next_slot_ < station_.superframe().slot_count() &&
         now >= station_.poll_due(slots_of_, next_slot_) - early) {
    slot_ = next_slot_++;
    silent_[slot_] = static_cast<std::uint8_t>(std::min(silent_[slot_] + 1, 255));
  }
}

void Anchor::end_superframe() noexcept {
  constexpr std::uint32_t kTooMany = 2;
  const bool idle = ++polls_missing_ > kTooMany;
  station_.on_lack(idle, idle);
  station_.end_superframe();
  next_slot_ = 0;
}

Step Anchor::on_transmitted(ClockTime timestamp) noexcept {
  if (phase_ == Phase::kControl) {
    station_.on_control_transmitted(timestamp);
    return doing(plan(timestamp));
  }
  ++station_.counters().frames_sent;
  Record& record = *answered_;
  record.valid = timestamp == record.responded;
  if (!record.valid) ++station_.counters().bad_stamps;
  if (!station_.superframe().has_final()) return doing(plan(timestamp));
  phase_ = Phase::kFinal;
  return doing(station_.listen(SlotKind::kFinal, poll_heard_ + station_.superframe().final(polled_),
                               station_.superframe().on_air(kFinalBytes), Ticks(0)));
}

Step Anchor::on_late(ClockTime now) noexcept {
  if (phase_ == Phase::kControl) {
    station_.on_control_late();
  } else {
    ++station_.counters().late_transmits;
  }
  return doing(plan(now));
}

Step Anchor::on_received(const Reception& reception) noexcept {
  if (phase_ == Phase::kControl) {
    if (const auto rest = station_.on_control_received(reception)) return doing(*rest);
    return doing(plan(reception.timestamp));
  }
  if (phase_ == Phase::kPoll) go_on_to(reception.timestamp);
  const bool unused_slot = phase_ == Phase::kPoll && silent_[slot_] >= kSilent && !in_time(reception);
  if (const auto frame = station_.accept(reception, place(), unused_slot)) {
    if (const auto* poll = std::get_if<Poll>(&frame->body);
        poll != nullptr && phase_ == Phase::kPoll && is_of_slot(*frame, *poll, reception)) {
      silent_[slot_] = 0;
      pollers_[slot_] = frame->source;
      if (const auto action = answer(*frame, *poll, reception)) return doing(*action);
    } else if (const auto* final = std::get_if<Final>(&frame->body);
               final != nullptr && phase_ == Phase::kFinal) {
      close(*frame, *final, reception);
      return doing(plan(reception.timestamp));
    } else if (station_.overhear(*frame, reception)) {
      return doing(plan(reception.timestamp));
    }
  }
  return listen_on_or(reception.timestamp);
}

bool Anchor::in_time(const Reception& reception) const noexcept {
  const Ticks late = reception.timestamp - station_.poll_due(slots_of_, slot_);
  const Ticks most = station_.superframe().guard() + station_.sync().margin(slots_of_);
  return !reception.timestamp_valid || (late <= most && late >= -most);
}

bool Anchor::is_of_slot(const Frame& frame, const Poll& poll, const Reception& reception) const noexcept {
  const std::uint16_t owner = owner_for(frame, poll);
  return poll.superframe == slots_of_ && poll.slot == slot_ && owner != kNobody &&
         station_.slots().may_poll(owner, slot_) && in_time(reception);
}

std::optional<Action> Anchor::answer(const Frame& frame, const Poll& poll,
                                     const Reception& reception) noexcept {
  if (!station_.fresh()) return std::nullopt;
  if (!reception.timestamp_valid) {
    ++station_.counters().bad_stamps;
    return std::nullopt;
  }
  const auto end = poll.anchors.begin() + poll.count;
  const auto self = std::find(poll.anchors.begin(), end, station_.site().id);
  membership_.on_poll(owner_for(frame, poll), slot_, self != end);
  if (self == end) return std::nullopt;
  const auto index = static_cast<std::size_t>(self - poll.anchors.begin());

  polls_missing_ = 0;
  Record& record = record_of(frame.source);
  Response body{.exchange = poll.exchange, .health = station_.health()};
  if (record.valid) {
    body.closed_exchange = record.exchange;
    if (station_.superframe().has_final()) {
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
      station_.timestamp_not_after(reception.timestamp + station_.superframe().response(index, poll.count));
  body.reply = timestamp - reception.timestamp;
  record = {
      .tag = frame.source, .exchange = poll.exchange, .superframe = poll.superframe, .responded = timestamp};
  answered_ = &record;
  phase_ = Phase::kResponse;
  return station_.transmit(timestamp, frame.source, body, place());
}

std::size_t Anchor::precompute() noexcept {
  if (phase_ == Phase::kControl) station_.prepare_control();
  if (phase_ != Phase::kPoll) return 0;
  if (station_.keyed()) {
    station_.expect_heard(expected_tag(), FrameType::kPoll, place());
    station_.expect_said(FrameType::kResponse, place());
  }
  return station_.superframe().on_air(kResponseBytes);
}

// The last one that polled in the slot: several tags may share it, or its owner has lent it. If nobody has
// for a while, the owner.
std::uint16_t Anchor::expected_tag() const noexcept {
  const bool used = pollers_[slot_] != kNobody && silent_[slot_] < kSilent;
  return used ? pollers_[slot_] : station_.slots().owner_of(slot_);
}

Anchor::Record& Anchor::record_of(std::uint16_t tag) noexcept {
  const auto found =
      std::find_if(records_.begin(), records_.end(), [=](const Record& record) { return record.tag == tag; });
  if (found != records_.end()) return *found;
  Record& oldest = *std::min_element(records_.begin(), records_.end(), [&](const Record& a, const Record& b) {
    if ((a.tag == kNobody) != (b.tag == kNobody)) return a.tag == kNobody;
    return slots_of_ - a.superframe > slots_of_ - b.superframe;
  });
  oldest = {.tag = tag};
  return oldest;
}

void Anchor::close(const Frame& frame, const Final& final, const Reception& reception) noexcept {
  Record& record = *answered_;
  if (frame.source != record.tag || final.exchange != record.exchange) {
    ++station_.counters().stale_frames;
    return;
  }
  if (!reception.timestamp_valid) {
    ++station_.counters().bad_stamps;
    return;
  }
  record.closing = reception.timestamp - record.responded;
  record.closing_valid = true;
}

Step Anchor::on_timeout(ClockTime now) noexcept {
  if (phase_ == Phase::kControl) station_.on_control_timeout();
  return doing(plan(now));
}

// No exchange may span the restart.
void Anchor::on_clock_restart() noexcept {
  station_.on_clock_restart();
  records_ = {};
  answered_ = nullptr;
}

Step Anchor::resume(ClockTime now) noexcept {
  station_.resume(now);
  return doing(plan(now));
}

// Continues after an unusable frame.
Step Anchor::listen_on_or(ClockTime now) noexcept {
  if (const auto rest = Station::listen_on(doing_, now)) return doing(*rest);
  return on_timeout(now);
}

}  // namespace groma::mac
