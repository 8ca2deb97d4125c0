#include "firmware/core/mac/station.hpp"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <utility>

namespace groma::mac {

using ranging::ClockTime;
using ranging::Ticks;

namespace {

// Nodes that the schedule names have a turn each; other nodes derive theirs from their ids.
ReplayGuard::Settings replay_guard_of(const Site& site) noexcept {
  const groma_Schedule& schedule = *site.schedule;
  const auto anchors = std::span(schedule.anchor_ids).first(schedule.anchor_ids_count);
  const auto tags = std::span(schedule.tag_ids).first(schedule.tag_ids_count);
  const auto turns = static_cast<std::uint32_t>(anchors.size() + tags.size());
  const auto anchor = std::find(anchors.begin(), anchors.end(), site.id) - anchors.begin();
  const auto tag = std::find(tags.begin(), tags.end(), site.id) - tags.begin();
  const bool is_anchor = static_cast<std::size_t>(anchor) < anchors.size();
  const auto turn = static_cast<std::uint32_t>(is_anchor ? anchor : anchor + tag);
  return {.id = site.id,
          .tag = static_cast<std::size_t>(tag) < tags.size(),
          .required = !site.network_key.empty(),
          .boot_count = site.boot_count,
          .nonces = site.nonces,
          .turn = turn < turns ? turn : site.id % turns,
          .turns = turns,
          .relays = schedule.backup_ids_count};
}

SlotKind slot_kind(const Body& body, Place place) noexcept {
  if (place.slot == Place::kBeacon) return SlotKind::kBeacon;
  if (place.slot == Place::kShared) return SlotKind::kShared;
  if (std::holds_alternative<Poll>(body)) return SlotKind::kPoll;
  return std::holds_alternative<Final>(body) ? SlotKind::kFinal : SlotKind::kResponse;
}

// The nonce of a challenge.
std::optional<std::uint64_t> challenge_of(const Body& body) noexcept {
  const auto* join = std::get_if<Join>(&body);
  return join != nullptr && join->wants_challenge_response ? std::optional(join->nonce) : std::nullopt;
}

}  // namespace

Station::Station(const Site& site, groma_Counters& counters) noexcept
    : site_(site),
      superframe_(*site.schedule, site.phy, !site.network_key.empty()),
      hash_(schedule_hash(*site.schedule, site.network_id, site.phy.preamble())),
      sync_(superframe_),
      election_(site_, superframe_.duration(), superframe_.guard()),
      coexistence_(site_, election_, hash_),
      slots_(*site.schedule),
      authenticator_(site.cipher, site.network_key, site.signed_places),
      replay_guard_(replay_guard_of(site)),
      counters_(counters) {
  if (!site.network_key.empty()) attach(replay_guard_);
}

void Station::attach(ControlChannel& channel) noexcept {
  for (ControlChannel*& place : channels_) {
    if (place == nullptr) {
      place = &channel;
      return;
    }
  }
}

// ---- the sequence of a superframe

void Station::start(ClockTime now) noexcept {
  sync_.search();
  coexistence_.search(now);
  others_.reset();
  phase_ = Phase::kSearching;
}

void Station::resume(ClockTime now) noexcept {
  if (sync_.state() == SyncState::kSearching) return start(now);
  if (sender_ != nullptr) std::exchange(sender_, nullptr)->on_sent(number_, false);
  if (phase_ == Phase::kBeacon && !own_beacon_) miss();
  const Ticks elapsed = now - sync_.start(number_);
  election_.on_absence(number_ +
                       static_cast<std::uint32_t>(elapsed.count() / superframe_.duration().count()));
  if (!election_.leads()) sync_.follow();
}

void Station::prepare_control() noexcept {
  if (!keyed()) return;
  if (phase_ == Phase::kBeacon) {
    if (!own_beacon_) expect_heard(election_.master(), FrameType::kBeacon, control_place());
    if (fresh()) {  // a challenge has a key of its own
      expect_said(election_.has_shared_turn(number_) ? FrameType::kBeacon : FrameType::kJoin,
                  {number_, Place::kShared});
    }
  } else if (const std::size_t turn = superframe_.shared_turn(number_);
             phase_ == Phase::kShared && turn != 0) {
    expect_heard(site_.schedule->backup_ids[turn - 1], FrameType::kBeacon, control_place());
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
    if (sync_.state() == SyncState::kSearching && !start_session_if_due(now)) return search(now);
    std::optional<Action> action = request_in_turn(now);
    if (action) {
      listening_ = *action;
      return action;
    }
    switch (next_) {
      case Next::kBeacon:
        next_ = Next::kShared;
        action = beacon_slot(now);
        break;
      case Next::kShared:
        next_ = Next::kSlots;
        action = shared_slot(now);
        break;
      case Next::kSlots:
        phase_ = Phase::kSlots;
        return std::nullopt;
    }
    if (action) {
      listening_ = *action;
      return action;
    }
  }
}

std::optional<Action> Station::control_ahead() const noexcept {
  if (sync_.state() == SyncState::kSearching || election_.leads()) return std::nullopt;
  Ticks place;
  SlotKind slot = SlotKind::kBeacon;
  if (phase_ == Phase::kBeacon && next_ == Next::kShared && !election_.has_shared_turn(number_) && !keyed()) {
    const bool sends = std::any_of(channels_.begin(), channels_.end(), [](const ControlChannel* channel) {
      return channel != nullptr && channel->wants_slot();
    });
    if (sends) return std::nullopt;
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
  if (election_.role() != Role::kSearching) {
    coexistence_.search(now);
    others_.reset();
  }
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
  if (others_) send_merge_requests(MergeTarget(others_->merge_target), others_->shared, 2, false);
  return true;
}

Action Station::search(ClockTime now) noexcept {
  constexpr Ticks kWhile = Ticks::from_us(50'000);
  phase_ = Phase::kSearching;
  listening_ = {.kind = Action::Kind::kListenNow,
                .until = std::min(now + kWhile, election_.lead_at().value_or(now + kWhile))};
  return listening_;
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
  if (scanning_ && requests_beside(due)) return scan(now);
  if (!ahead(due, now)) {
    if (election_.parent_due(number_, false)) miss();
    return std::nullopt;
  }
  phase_ = Phase::kBeacon;
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
  if (!ahead(due, now)) {
    if (election_.parent_due(number_, true)) miss();
    return std::nullopt;
  }
  phase_ = Phase::kShared;
  if (timed(number_)) {
    const ClockTime timestamp = timestamp_not_after(due);
    if (fresh() && election_.has_shared_turn(number_)) {
      const bool odd = number_ / (site_.schedule->backup_ids_count + 1U) % 2 != 0;
      if (odd && !election_.leads()) {
        if (const auto action = from_channels(timestamp, true)) return action;
      }
      return send_beacon(due, true);
    }
    if (superframe_.shared_turn(number_) == 0) {
      if (const auto action = from_channels(timestamp, false)) return action;
    }
  }
  return listen(SlotKind::kShared, due, superframe_.control_bytes(), sync_.margin(number_));
}

std::optional<Action> Station::from_channels(ClockTime timestamp, bool own_turn) noexcept {
  for (ControlChannel* channel : channels_) {
    if (channel == nullptr) break;
    if (!fresh() && channel != &replay_guard_) continue;
    const auto outgoing = own_turn ? channel->own_turn(number_) : channel->open_slot(number_);
    if (!outgoing) continue;
    sender_ = channel;
    own_beacon_ = false;
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

// Sends merge requests in the shared slots of the other session, in this node's turns, while all of its own
// session are silent; until the other session's next open slot is over.
std::optional<Action> Station::request_in_turn(ClockTime now) noexcept {
  const bool quiet = phase_ == Phase::kScanning || phase_ == Phase::kRequesting;
  if (next_ != Next::kBeacon || !quiet) return std::nullopt;
  while (others_) {
    const ClockTime timestamp = timestamp_not_after(others_->shared);
    if (ahead(timestamp, now) && sure(number_) &&
        coexistence_.may_request_merge(others_->merge_target.superframe)) {
      const ClockTime ready = timestamp - superframe_.phy().before_rmarker() - kToGetReady;
      if (ready - kToGetReady >= sync_.start(number_)) return std::nullopt;
      if (ready > now + kToGetReady) {
        phase_ = Phase::kScanning;
        return Action{.kind = Action::Kind::kListenNow, .until = ready};
      }
      const MergeTarget merge_target = others_->merge_target;
      next_of_others();
      return merge_request(timestamp, merge_target);
    }
    next_of_others();
  }
  return std::nullopt;
}

// A merge request this close to the beacon leaves no time for the beacon.
bool Station::requests_beside(ClockTime due) const noexcept {
  const Ticks room = superframe_.phy().air_time(superframe_.control_bytes()) + kToGetReady;
  return requests_within(due - room, due + room);
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

Action Station::merge_request(ClockTime timestamp, const MergeTarget& merge_target) noexcept {
  const std::int64_t duration = superframe_.duration().count();
  const std::int64_t time = sync_.network_time(timestamp).count();
  Beacon beacon = make_beacon(Ticks(0), true);
  beacon.superframe = static_cast<std::uint32_t>(time / duration);
  beacon.place = Ticks(time % duration);
  beacon.merge_request = true;
  phase_ = Phase::kRequesting;
  sender_ = nullptr;
  own_beacon_ = true;
  return transmit(timestamp, kBroadcast, beacon, place_of(beacon), &merge_target);
}

// All nodes that heard the other session stay silent until one of them has sent a merge request in its turn:
// from the next superframe on, or at once if they are scanning. If `only_requester_silent`, only the
// requesting node stays silent, and only in that superframe.
void Station::send_merge_requests(const MergeTarget& merge_target, ClockTime shared, std::uint32_t rounds,
                                  bool only_requester_silent) noexcept {
  const Ticks duration = superframe_.duration();
  others_ = Others{.shared = shared, .merge_target = merge_target, .left = 0};
  while (phase_ != Phase::kScanning &&
         static_cast<std::int32_t>(superframe_at(others_->shared) - number_) <= 0) {
    others_->shared += duration;
    ++others_->merge_target.superframe;
  }
  const std::uint32_t turns = site_.schedule->backup_ids_count + 1U;
  if (only_requester_silent) {
    others_->left = turns;  // each once
    return;
  }
  const std::uint32_t to_open = (turns - others_->merge_target.superframe % turns) % turns;
  // In the first slot some nodes may not know yet that they have to be silent. A node with a turn of its own
  // may be the only one in range of the others.
  constexpr std::uint32_t kMore = 1;
  std::uint32_t last = to_open + (rounds - 1) * turns + kMore;
  while (!election_.leads() && election_.rank() && last < 2 * turns &&
         !coexistence_.may_request_merge_within(others_->merge_target.superframe, last)) {
    ++last;
  }
  others_->left = last + 1;
  coexistence_.keep_silence(superframe_at(others_->shared + std::int64_t{last} * duration));
}

Action Station::send_beacon(ClockTime due, bool shared) noexcept {
  const ClockTime timestamp = timestamp_not_after(due);
  Beacon beacon = make_beacon(timestamp - due, shared);
  beacon.quiet = shared ? coexistence_.ask_for_silence() : scanning_ && coexistence_.quiet();
  for (ControlChannel* channel : channels_) {
    if (channel != nullptr) channel->on_beacon_out(beacon, election_.leads());
  }
  if (election_.leads()) slots_.take(beacon);
  sender_ = nullptr;
  own_beacon_ = true;
  return transmit(timestamp, kBroadcast, beacon, place_of(beacon));
}

void Station::on_control_transmitted(ClockTime timestamp) noexcept {
  ++counters_.frames_sent;
  if (sender_ != nullptr) {
    std::exchange(sender_, nullptr)->on_sent(number_, true);
  } else if (phase_ == Phase::kBeacon && coexistence_.on_led(timestamp)) {
    sync_.search();
  }
  own_beacon_ = false;
}

void Station::on_control_late() noexcept {
  ++counters_.late_transmits;
  own_beacon_ = false;
  if (sender_ != nullptr) std::exchange(sender_, nullptr)->on_sent(number_, false);
}

std::optional<Action> Station::on_control_received(const Reception& reception) noexcept {
  const auto frame = accept(reception, control_place());
  if (frame) {
    const Phase phase = phase_;
    if (const auto* beacon = std::get_if<Beacon>(&frame->body)) {
      if (take_beacon(*frame, *beacon, reception)) return std::nullopt;
    } else if (std::holds_alternative<Join>(frame->body) || std::holds_alternative<Data>(frame->body)) {
      if (phase == Phase::kSearching) coexistence_.on_traffic(reception.timestamp);
      for (ControlChannel* channel : channels_) {
        if (channel != nullptr) channel->on_control(*frame, number_, election_.leads());
      }
      if (phase == Phase::kShared) return std::nullopt;
    } else if (phase == Phase::kSearching) {
      coexistence_.on_traffic(reception.timestamp);
    } else if (phase != Phase::kScanning) {
      ++counters_.stale_frames;
      if (std::holds_alternative<Poll>(frame->body)) coexistence_.suspect();
    }
  }
  if (phase_ == Phase::kSearching) return std::nullopt;
  const auto rest = listen_on(listening_, reception.timestamp);
  if (!rest) on_control_timeout();
  return rest;
}

void Station::on_control_timeout() noexcept {
  if (phase_ == Phase::kBeacon && election_.parent_due(number_, false)) miss();
  if (phase_ == Phase::kShared && election_.parent_due(number_, true)) miss();
}

void Station::miss() noexcept {
  ++counters_.beacons_missed;
  sync_.on_beacon_missed();
}

bool Station::overhear(const Accepted& frame, const Reception& reception) noexcept {
  if (const auto* beacon = std::get_if<Beacon>(&frame.body)) return take_beacon(frame, *beacon, reception);
  ++counters_.stale_frames;
  if (std::holds_alternative<Poll>(frame.body)) coexistence_.suspect();
  return false;
}

// ---- beacons

bool Station::take_beacon(const Accepted& frame, const Beacon& beacon, const Reception& reception) noexcept {
  if (!reception.timestamp_valid) {
    ++counters_.bad_stamps;
    return false;
  }
  if (beacon.schedule_hash == hash_ && beacon.slots != superframe_.slot_count()) {
    ++counters_.stale_frames;
    return false;
  }
  const BeaconReception timestamp{.superframe = beacon.superframe,
                                  .place = place_in_superframe(beacon),
                                  .heard = reception.timestamp,
                                  .offset_ppb = reception.quality.clock_offset_ppb,
                                  .hop = beacon.hop,
                                  .age = beacon.age};
  const bool searching = sync_.state() == SyncState::kSearching;
  const Ticks ahead = searching ? Ticks(0) : ahead_by(beacon, reception.timestamp);
  const bool requested = authenticator_.on() && beacon.merge_request;
  const std::uint64_t session = election_.session();
  const Verdict verdict = frame.unverified ? coexistence_.judge_unverified(frame.source, beacon)
                          : requested      ? coexistence_.judge_merge_request(frame.source, beacon, ahead)
                                      : coexistence_.judge(frame.source, beacon, ahead, reception.timestamp);
  switch (verdict) {
    case Verdict::kStale:
      ++counters_.stale_frames;
      return false;
    case Verdict::kIgnore:
      return false;
    case Verdict::kRequestMerge:
      return request_merge(beacon, reception.timestamp, frame.unverified);
    case Verdict::kLeave:
      sync_.search();
      return true;
    case Verdict::kKnown:
      take_content(frame, beacon, false);
      return phase_ == Phase::kShared;
    case Verdict::kMeasure:
    case Verdict::kSwitch:
    case Verdict::kAdopt:
      break;
  }
  // Some nodes may have missed the merge request.
  std::optional<Others> former;
  if (requested && verdict == Verdict::kAdopt) {
    const std::uint32_t next = number_ + (phase_ == Phase::kScanning ? 0U : 1U);
    former = Others{.shared = sync_.start(next) + superframe_.shared(),
                    .merge_target = {session, next},
                    .left = site_.schedule->backup_ids_count + 1U};
  }
  // A beacon later than its place may have been delayed by an attacker.
  if (!take_time(timestamp, beacon.session, verdict, !authenticator_.on() || ahead >= Ticks(0))) {
    ++counters_.bad_stamps;
    return false;
  }
  ++counters_.beacons_received;
  if (verdict == Verdict::kAdopt) others_ = former;
  take_content(frame, beacon, verdict == Verdict::kAdopt);
  if (phase_ == Phase::kScanning && verdict != Verdict::kAdopt) return false;
  number_ = beacon.superframe;
  next_ = beacon.shared ? Next::kSlots : Next::kShared;
  scanning_ = beacon.quiet && !beacon.shared;
  return true;
}

bool Station::request_merge(const Beacon& beacon, ClockTime heard, bool unverified) noexcept {
  const MergeTarget merge_target{beacon.session, beacon.superframe};
  const ClockTime shared = heard - place_in_superframe(beacon) + superframe_.shared();
  if (sync_.state() == SyncState::kSearching) {
    others_ = Others{.shared = shared, .merge_target = merge_target};
    return false;
  }
  // The other session may be a recording, and no expected frames are missing.
  const bool only_requester_silent = unverified && !coexistence_.lacking();
  send_merge_requests(merge_target, shared, 1, only_requester_silent);
  return phase_ == Phase::kScanning &&
         (!only_requester_silent || requests_within(heard, sync_.start(number_)));
}

bool Station::take_time(const BeaconReception& timestamp, std::uint64_t session, Verdict verdict,
                        bool persuasive) noexcept {
  if (verdict == Verdict::kAdopt) {
    if (!fresh()) replay_guard_.forget();
    authenticator_.enter(session);
    sync_.adopt(timestamp);
    return true;
  }
  sync_.follow();
  return sync_.on_beacon(timestamp, verdict == Verdict::kSwitch, persuasive);
}

void Station::take_content(const Frame& frame, const Beacon& beacon, bool adopted) noexcept {
  slots_.take(beacon, adopted);
  for (ControlChannel* channel : channels_) {
    if (channel != nullptr && (fresh() || channel == &replay_guard_)) channel->on_beacon(frame, beacon);
  }
}

// ---- frames

std::optional<Station::Accepted> Station::accept(const Reception& reception, Place place,
                                                 bool unused_slot) noexcept {
  // One named object, so that it is returned without a copy.
  std::optional<Accepted> frame(std::in_place);
  if (const auto error = parse(reception.frame, *frame)) {
    ++(*error == ParseError::kForeign ? counters_.foreign_frames : counters_.malformed_frames);
    frame.reset();
  } else if (frame->network != site_.network_id) {
    ++counters_.foreign_frames;
    frame.reset();
  } else if (!is_for_this_node(*frame) || !authenticate(*frame, reception, place, unused_slot)) {
    frame.reset();
  }
  return frame;
}

bool Station::is_for_this_node(const Frame& frame) const noexcept {
  return frame.destination == site_.id || frame.destination == kBroadcast ||
         std::holds_alternative<Join>(frame.body) || std::holds_alternative<Data>(frame.body);
}

bool Station::authenticate(Accepted& frame, const Reception& reception, Place place,
                           bool unused_slot) noexcept {
  if (!authenticator_.on()) {
    if (frame.secured) ++counters_.foreign_frames;
    return !frame.secured;
  }
  if (!frame.secured) {
    ++counters_.unsecured_frames;
    return false;
  }
  if (const auto* beacon = std::get_if<Beacon>(&frame.body)) return authenticate(frame, *beacon, reception);
  // Without knowing the place this node cannot verify the MIC; but another node is there.
  if (phase_ == Phase::kSearching) coexistence_.on_traffic(reception.timestamp);
  if (phase_ == Phase::kSearching || phase_ == Phase::kScanning) return false;
  if (const auto nonce = challenge_of(frame.body)) {
    if (authenticator_.fits_challenge(reception.frame, place, *nonce)) return true;
    ++counters_.forged_frames;
    return false;
  }
  if (authenticator_.fits(reception.frame, place)) return true;
  ++counters_.forged_frames;
  if (unused_slot && std::holds_alternative<Poll>(frame.body)) coexistence_.on_unverified_poll();
  return false;
}

Ticks Station::place_in_superframe(const Beacon& beacon) const noexcept {
  if (beacon.merge_request) return beacon.place;
  return (beacon.shared ? superframe_.shared() : superframe_.beacon()) + Ticks(beacon.tx_offset_dtu);
}

Ticks Station::ahead_by(const Beacon& beacon, ClockTime heard) const noexcept {
  return sync_.start(beacon.superframe) + place_in_superframe(beacon) - heard;
}

// Once this node knows the time, a replayed beacon of its own session is late against this node's clock. A
// beacon of another timeline may be a replay, unless it is a merge request to this session: it then came in
// this node's own shared slot, and its MIC was made for that slot.
Station::Trust Station::trust_in(const Beacon& beacon, ClockTime heard) const noexcept {
  if (!knows_time()) return beacon.merge_request ? Trust::kNone : Trust::kFull;
  const std::uint32_t number = beacon.merge_request ? superframe_at(heard) : beacon.superframe;
  const Ticks most = superframe_.guard() + sync_.margin(number);
  const Ticks ahead =
      beacon.merge_request ? sync_.start(number) + superframe_.shared() - heard : ahead_by(beacon, heard);
  const bool aligned = ahead <= most && ahead >= -most;
  if (beacon.merge_request) return aligned ? Trust::kFull : Trust::kNone;
  if (beacon.session != election_.session() || (!aligned && beacon.master != election_.master()))
    return Trust::kUnverified;
  return ahead >= -most ? Trust::kFull : Trust::kNone;
}

bool Station::authenticate(Accepted& frame, const Beacon& beacon, const Reception& reception) noexcept {
  const Trust trust = trust_in(beacon, reception.timestamp);
  bool fits = false;
  if (trust != Trust::kNone && beacon.merge_request) {
    fits = authenticator_.fits(reception.frame, beacon,
                               {election_.session(), superframe_at(reception.timestamp)});
  } else if (trust != Trust::kNone) {
    fits = authenticator_.fits(reception.frame, beacon);
  }
  frame.unverified = fits && trust == Trust::kUnverified;
  if (fits && !frame.unverified) return true;
  // A merge request of this session to another one is no forgery.
  const bool own_request = beacon.merge_request && knows_time() && beacon.session == election_.session();
  ++(own_request ? counters_.stale_frames : counters_.forged_frames);
  return fits;
}

Action Station::transmit(ClockTime timestamp, std::uint16_t destination, const Body& body, Place place,
                         const MergeTarget* merge_target) noexcept {
  serialize({.sequence = sequence_++,
             .network = site_.network_id,
             .destination = destination,
             .source = site_.id,
             .secured = authenticator_.on(),
             .body = body},
            outgoing_);
  if (!fresh()) {
    // A node that may hear a recording signs nothing else.
    authenticator_.abandon();
    if (const auto nonce = challenge_of(body))
      authenticator_.begin_signing_challenge(outgoing_, place, *nonce);
  } else if (merge_target != nullptr) {
    authenticator_.begin_signing(outgoing_, place, *merge_target);
  } else if (authenticator_.on()) {
    authenticator_.begin_signing(outgoing_, place);
  }
  return {.kind = Action::Kind::kTransmit,
          .slot = slot_kind(body, place),
          .at = timestamp,
          .frame = outgoing_.bytes()};
}

Action Station::listen(SlotKind slot, ClockTime due, std::size_t bytes, Ticks slack) const noexcept {
  const Ticks guard = superframe_.guard() + slack;
  const radio::Phy& phy = superframe_.phy();
  return {.kind = Action::Kind::kListen,
          .slot = slot,
          .at = due - phy.before_rmarker() - guard - phy.receiver_start(),
          .until = due + phy.after_rmarker(bytes) + guard,
          .preamble_until = due + guard};
}

std::optional<Action> Station::listen_on(const Action& interrupted, ClockTime now) noexcept {
  if (now >= interrupted.preamble_until.value_or(interrupted.until)) return std::nullopt;
  return Action{.kind = Action::Kind::kListenNow,
                .until = interrupted.until,
                .preamble_until = interrupted.preamble_until};
}

}  // namespace groma::mac
