#include "firmware/core/mac/station.hpp"

#include <algorithm>
#include <utility>

namespace groma::mac {

Station::Station(const Site& site, groma_Counters& counters) noexcept
    : site_(site),
      superframe_(*site.schedule, site.phy, !site.network_key.empty()),
      hash_(schedule_hash(*site.schedule, site.network_id, site.phy.preamble())),
      sync_(superframe_),
      election_(site_, superframe_.duration(), superframe_.guard()),
      coexistence_(site_, election_, hash_),
      slots_(*site.schedule),
      authenticator_(site.cipher, site.network_key, site.signed_places),
      replay_guard_(site_),
      counters_(counters) {
  if (keyed()) attach(replay_guard_);
}

void Station::attach(ControlChannel& channel) noexcept {
  if (channel_count_ < channels_.size()) channels_[channel_count_++] = &channel;
}

// ---- events

Step Station::start(ClockTime now) noexcept {
  begin_search(now);
  forget_exchanges();
  return plan(now);
}

Step Station::plan(ClockTime now) noexcept {
  for (;;) {
    if (const auto action = control(now)) return act(*action);
    if (const auto action = slot_action(now)) return act(*action);
  }
}

Step Station::on_transmitted(ClockTime timestamp) noexcept {
  ++counters_.frames_sent;
  if (in_slots()) return slot_transmitted(timestamp);
  release_sender(true);
  if (phase_ == Phase::kBeacon && coexistence_.on_led(timestamp)) sync_.search();
  return plan(timestamp);
}

Step Station::on_late(ClockTime now) noexcept {
  ++counters_.late_transmits;
  if (in_slots()) return slot_abandoned(now);
  release_sender(false);
  return plan(now);
}

Step Station::on_received(const Reception& reception) noexcept {
  if (in_slots()) return slot_received(reception);
  if (const auto rest = control_received(reception)) return act(*rest);
  return plan(reception.timestamp);
}

Step Station::on_timeout(ClockTime now) noexcept {
  if (in_slots()) return slot_timeout(now);
  control_timeout();
  return plan(now);
}

Step Station::resume(ClockTime now) noexcept {
  const bool in_slot = in_slots();
  if (sync_.state() == SyncState::kSearching) {
    begin_search(now);
  } else {
    if (phase_ == Phase::kBeacon && !election_.leads()) miss();
    release_sender(false);
    const Ticks elapsed = now - sync_.start(number_);
    election_.on_absence(number_ +
                         static_cast<std::uint32_t>(elapsed.count() / superframe_.duration().count()));
    if (!election_.leads()) sync_.follow();
  }
  return in_slot ? slot_abandoned(now) : plan(now);
}

void Station::on_clock_restart() noexcept {
  sync_.on_clock_restart();
  forget_exchanges();
}

void Station::release_sender(bool sent) noexcept {
  if (sender_ != nullptr) std::exchange(sender_, nullptr)->on_sent(number_, sent);
}

std::optional<Action> Station::control_received(const Reception& reception) noexcept {
  if (const auto frame = accept(reception, control_place())) {
    const bool searching = phase_ == Phase::kSearching;
    if (const auto* beacon = std::get_if<Beacon>(&frame->body)) {
      if (take_beacon(*frame, *beacon, reception)) return std::nullopt;
    } else {
      if (searching) coexistence_.on_traffic(reception.timestamp);
      if (std::holds_alternative<Join>(frame->body) || std::holds_alternative<Data>(frame->body)) {
        for (ControlChannel* channel : channels()) channel->on_control(*frame, number_, election_.leads());
        if (phase_ == Phase::kShared) return std::nullopt;
      } else if (!searching && phase_ != Phase::kScanning) {
        on_stray(*frame);
      }
    }
  }
  if (phase_ == Phase::kSearching) return std::nullopt;
  const auto rest = listen_on(reception.timestamp);
  if (!rest) control_timeout();
  return rest;
}

void Station::control_timeout() noexcept {
  const bool shared = phase_ == Phase::kShared;
  if ((shared || phase_ == Phase::kBeacon) && election_.parent_due(number_, shared)) miss();
}

void Station::miss() noexcept {
  ++counters_.beacons_missed;
  sync_.on_beacon_missed();
}

// ---- the sequence of a superframe

void Station::begin_search(ClockTime now) noexcept {
  sync_.search();
  coexistence_.search(now);
  others_.reset();
  sender_ = nullptr;
  phase_ = Phase::kSearching;
}

void Station::prepare_control() noexcept {
  if (!keyed()) return;
  if (phase_ == Phase::kBeacon) {
    if (!election_.leads())
      authenticator_.expect_received(election_.master(), FrameType::kBeacon, control_place());
    if (fresh()) {  // a challenge has a key of its own
      const bool relays = election_.has_shared_turn(number_);
      authenticator_.expect_sent(site_.id, relays ? FrameType::kBeacon : FrameType::kJoin,
                                 {number_, Place::kShared});
    }
  } else if (const std::uint32_t turn = election_.turn(number_); phase_ == Phase::kShared && turn != 0) {
    authenticator_.expect_received(site_.schedule->backup_ids[turn - 1], FrameType::kBeacon, control_place());
  }
}

void Station::end_superframe() noexcept {
  ++number_;
  next_ = Next::kBeacon;
}

std::optional<Action> Station::control(ClockTime now) noexcept {
  for (;;) {
    if (!fresh() && (replay_guard_.hopeless() || sync_.missed_in_a_row() > MasterElection::kPatience))
      sync_.search();
    if (sync_.state() == SyncState::kSearching && !start_session_if_due(now)) {
      constexpr Ticks kWhile = Ticks::from_us(50'000);
      phase_ = Phase::kSearching;
      return Action{.kind = Action::Kind::kListenNow,
                    .until = std::min(now + kWhile, election_.lead_at().value_or(now + kWhile))};
    }
    if (const auto action = request_in_turn(now)) return action;
    if (next_ == Next::kSlots) {
      phase_ = Phase::kSlots;
      return std::nullopt;
    }
    const bool beacon = next_ == Next::kBeacon;
    next_ = beacon ? Next::kShared : Next::kSlots;
    if (const auto action = beacon ? beacon_slot(now) : shared_slot(now)) return action;
  }
}

std::optional<Action> Station::control_ahead() const noexcept {
  if (sync_.state() == SyncState::kSearching || election_.leads()) return std::nullopt;
  Ticks place;
  SlotKind slot = SlotKind::kBeacon;
  if (phase_ == Phase::kBeacon && next_ == Next::kShared && !election_.has_shared_turn(number_) && !keyed()) {
    for (const ControlChannel* channel : channels()) {
      if (channel->wants_slot()) return std::nullopt;
    }
    place = superframe_.shared();
    slot = SlotKind::kShared;
  } else if (phase_ == Phase::kSlots && next_ == Next::kBeacon) {
    place = superframe_.beacon();
  } else {
    return std::nullopt;
  }
  return listen(slot, sync_.start(number_) + place, superframe_.control_bytes(), sync_.margin(number_));
}

bool Station::start_session_if_due(ClockTime now) noexcept {
  if (election_.role() != Role::kSearching) begin_search(now);
  replay_guard_.forget();
  const auto lead_at = election_.lead_at();
  if (!lead_at || now < *lead_at) return false;
  constexpr Ticks kHead = Ticks::from_us(2'000);
  coexistence_.found();
  replay_guard_.found();
  authenticator_.enter(election_.session());
  sync_.found(ClockTime(0) + ranging::round_up_to_grid(now + kHead - ClockTime(0)));
  slots_.reset();
  number_ = 0;
  next_ = Next::kBeacon;
  phase_ = Phase::kBeacon;
  // Nodes obey a newer schedule only after two beacons with it.
  if (others_) send_merge_requests(2, false);
  return true;
}

std::optional<Action> Station::beacon_slot(ClockTime now) noexcept {
  sync_.begin(number_);
  if (sync_.state() == SyncState::kSearching) return std::nullopt;
  const Duty duty = coexistence_.begin(number_);
  if ((duty == Duty::kTakeOver && !fresh()) || election_.orphaned_after_one_beacon(number_)) {
    sync_.search();
    return std::nullopt;
  }
  if (duty == Duty::kTakeOver) sync_.lead();
  scanning_ =
      duty == Duty::kScan || (keyed() && requests_within(sync_.start(number_), sync_.start(number_ + 1)));
  if (duty == Duty::kSilence || (scanning_ && !election_.leads())) return scan(now);
  if (duty == Duty::kLongSilence) return scan(now, 2);
  const ClockTime due = sync_.start(number_) + superframe_.beacon();
  // A merge request this close to the beacon leaves no time for the beacon.
  const Ticks room = superframe_.phy().air_time(superframe_.control_bytes()) + kToGetReady;
  if (scanning_ && requests_within(due - room, due + room)) return scan(now);
  phase_ = Phase::kBeacon;
  if (!ahead(due, now)) {
    control_timeout();
    return std::nullopt;
  }
  if (election_.leads()) return send_beacon(due, false);
  return listen(SlotKind::kBeacon, due, superframe_.control_bytes(), sync_.margin(number_));
}

// Listens until the end of this superframe, or of a later one.
std::optional<Action> Station::scan(ClockTime now, std::uint32_t superframes) noexcept {
  scanning_ = false;
  for (std::uint32_t i = 0; i < superframes; ++i) end_superframe();
  phase_ = Phase::kScanning;
  if (const auto action = request_in_turn(now)) return action;
  const ClockTime end = sync_.start(number_);
  if (end <= now) return std::nullopt;
  return Action{.kind = Action::Kind::kListenNow, .until = end};
}

std::optional<Action> Station::shared_slot(ClockTime now) noexcept {
  if (scanning_) return scan(now);
  const ClockTime due = sync_.start(number_) + superframe_.shared();
  phase_ = Phase::kShared;
  if (!ahead(due, now)) {
    control_timeout();
    return std::nullopt;
  }
  if (timed(number_)) {
    const ClockTime timestamp = timestamp_not_after(due);
    if (fresh() && election_.has_shared_turn(number_)) {
      if (!election_.even(number_) && !election_.leads()) {
        if (const auto action = from_channels(timestamp, true)) return action;
      }
      return send_beacon(due, true);
    }
    if (election_.turn(number_) == 0) {
      if (const auto action = from_channels(timestamp, false)) return action;
    }
  }
  return listen(SlotKind::kShared, due, superframe_.control_bytes(), sync_.margin(number_));
}

std::optional<Action> Station::from_channels(ClockTime timestamp, bool own_turn) noexcept {
  for (ControlChannel* channel : channels()) {
    if (!fresh() && channel != &replay_guard_) continue;
    const auto outgoing = own_turn ? channel->own_turn(number_) : channel->open_slot(number_);
    if (!outgoing) continue;
    sender_ = channel;
    return transmit(timestamp, outgoing->destination, outgoing->body, {number_, Place::kShared});
  }
  return std::nullopt;
}

Beacon Station::make_beacon(Ticks tx_offset, bool shared) noexcept {
  Beacon beacon{.superframe = number_,
                .session = election_.session(),
                .epoch = site_.schedule->epoch,
                .schedule_hash = hash_,
                .master = election_.master(),
                .hop = election_.hop(),
                .age = static_cast<std::uint8_t>(std::min<std::uint32_t>(election_.age(number_), 255)),
                .tx_offset_dtu = static_cast<std::int16_t>(tx_offset.count()),
                .dissolving = election_.dissolving(),
                .shared = shared};
  slots_.fill(beacon);
  return beacon;
}

Action Station::send_beacon(ClockTime due, bool shared) noexcept {
  const ClockTime timestamp = timestamp_not_after(due);
  Beacon beacon = make_beacon(timestamp - due, shared);
  beacon.quiet = shared ? coexistence_.ask_for_silence() : scanning_ && coexistence_.quiet();
  for (ControlChannel* channel : channels()) channel->on_beacon_out(beacon, election_.leads());
  return transmit(timestamp, kBroadcast, beacon, place_of(beacon));
}

// ---- merge requests

// Sends merge requests in the shared slots of the other session, in this node's turns, while all of its own
// session are silent; until the other session's next open slot is over.
std::optional<Action> Station::request_in_turn(ClockTime now) noexcept {
  if (next_ != Next::kBeacon || phase_ != Phase::kScanning) return std::nullopt;
  while (others_) {
    const ClockTime timestamp = timestamp_not_after(others_->shared);
    if (ahead(timestamp, now) && sure(number_) &&
        coexistence_.may_request_merge(others_->merge_target.superframe)) {
      const ClockTime ready = timestamp - superframe_.phy().before_rmarker() - kToGetReady;
      if (ready - kToGetReady >= sync_.start(number_)) return std::nullopt;
      if (ready > now + kToGetReady) return Action{.kind = Action::Kind::kListenNow, .until = ready};
      const Action request = merge_request(timestamp);
      next_of_others();
      return request;
    }
    next_of_others();
  }
  return std::nullopt;
}

bool Station::requests_within(ClockTime from, ClockTime to) const noexcept {
  if (!others_) return false;
  for (std::uint32_t i = 0; i < others_->left; ++i) {
    const ClockTime shared = others_->shared + std::int64_t{i} * superframe_.duration();
    if (shared > from && shared < to)
      return coexistence_.may_request_merge(others_->merge_target.superframe + i);
  }
  return false;
}

void Station::next_of_others() noexcept {
  if (--others_->left == 0) return others_.reset();
  others_->shared += superframe_.duration();
  ++others_->merge_target.superframe;
}

Action Station::merge_request(ClockTime timestamp) noexcept {
  Beacon beacon = make_beacon(Ticks(0), true);
  beacon.superframe = superframe_at(timestamp);
  beacon.place = Ticks(sync_.network_time(timestamp).count() % superframe_.duration().count());
  beacon.merge_request = true;
  return transmit(timestamp, kBroadcast, beacon, place_of(beacon), others_->merge_target);
}

// All nodes that heard the other session stay silent until one of them has sent a merge request in its turn:
// from the next superframe on, or at once if they are scanning. If `only_requester_silent`, only the
// requesting node stays silent, and only in that superframe.
void Station::send_merge_requests(std::uint32_t rounds, bool only_requester_silent) noexcept {
  const Ticks duration = superframe_.duration();
  std::uint32_t& target = others_->merge_target.superframe;
  while (phase_ != Phase::kScanning && since(superframe_at(others_->shared), number_) <= 0) {
    others_->shared += duration;
    ++target;
  }
  const std::uint32_t turns = election_.beaconers();
  if (only_requester_silent) {
    others_->left = turns;  // each once
    return;
  }
  const std::uint32_t to_open = (turns - target % turns) % turns;
  // In the first slot some nodes may not know yet that they have to be silent. A node with a turn of its own
  // may be the only one in range of the others.
  constexpr std::uint32_t kMore = 1;
  std::uint32_t last = to_open + (rounds - 1) * turns + kMore;
  if (!election_.leads() && election_.rank()) {
    std::uint32_t own = 0;
    while (own < 2 * turns && !coexistence_.may_request_merge(target + own)) ++own;
    last = std::max(last, own);
  }
  others_->left = last + 1;
  coexistence_.keep_silence(superframe_at(others_->shared + std::int64_t{last} * duration));
}

}  // namespace groma::mac
