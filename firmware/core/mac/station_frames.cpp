// The Station's beacons and frames: which it accepts, what it takes from them, and how it sends and listens.
#include <algorithm>
#include <utility>

#include "firmware/core/mac/station.hpp"

namespace groma::mac {
namespace {

SlotKind slot_kind(const Body& body, Place place) noexcept {
  if (place.slot == Place::kBeacon) return SlotKind::kBeacon;
  if (place.slot == Place::kShared) return SlotKind::kShared;
  if (std::holds_alternative<Poll>(body)) return SlotKind::kPoll;
  return std::holds_alternative<Final>(body) ? SlotKind::kFinal : SlotKind::kResponse;
}

// Counts a frame of which nothing is used.
bool drop(std::uint32_t& counter) noexcept {
  ++counter;
  return false;
}

}  // namespace

bool Station::overhear(const Accepted& frame, const Reception& reception) noexcept {
  if (const auto* beacon = std::get_if<Beacon>(&frame.body)) return take_beacon(frame, *beacon, reception);
  on_stray(frame);
  return false;
}

void Station::on_stray(const Frame& frame) noexcept {
  ++counters_.stale_frames;
  if (std::holds_alternative<Poll>(frame.body)) coexistence_.suspect();
}

// ---- beacons

bool Station::take_beacon(const Accepted& frame, const Beacon& beacon, const Reception& reception) noexcept {
  if (!reception.timestamp_valid) return drop(counters_.bad_stamps);
  if (beacon.schedule_hash == hash_ && beacon.slots != superframe_.slot_count())
    return drop(counters_.stale_frames);
  const bool searching = sync_.state() == SyncState::kSearching;
  const Ticks ahead = searching ? Ticks(0) : sync_.ahead_by(beacon, reception.timestamp);
  const bool requested = keyed() && beacon.merge_request;
  // The session that this node may leave: some of its nodes may have missed the merge request.
  std::optional<Others> former;
  if (requested) {
    const std::uint32_t next = number_ + (phase_ == Phase::kScanning ? 0U : 1U);
    former = Others{.shared = sync_.start(next) + superframe_.shared(),
                    .merge_target = {election_.session(), next},
                    .left = election_.beaconers()};
  }
  const Verdict verdict = frame.unverified ? coexistence_.judge_unverified(frame.source, beacon)
                          : requested      ? coexistence_.judge_merge_request(frame.source, beacon, ahead)
                                      : coexistence_.judge(frame.source, beacon, ahead, reception.timestamp);
  switch (verdict) {
    case Verdict::kStale:
      return drop(counters_.stale_frames);
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
  const bool adopts = verdict == Verdict::kAdopt;
  if (adopts) {
    if (!fresh()) replay_guard_.forget();
    authenticator_.enter(beacon.session);
    sync_.adopt(beacon, reception);
    others_ = former;
  } else {
    sync_.follow();
    // A beacon later than its place may have been delayed by an attacker.
    const bool persuasive = !keyed() || ahead >= Ticks(0);
    if (!sync_.on_beacon(beacon, reception, verdict == Verdict::kSwitch, persuasive))
      return drop(counters_.bad_stamps);
  }
  ++counters_.beacons_received;
  take_content(frame, beacon, adopts);
  if (phase_ == Phase::kScanning && !adopts) return false;
  number_ = beacon.superframe;
  next_ = beacon.shared ? Next::kSlots : Next::kShared;
  scanning_ = beacon.quiet && !beacon.shared;
  return true;
}

bool Station::request_merge(const Beacon& beacon, ClockTime heard, bool unverified) noexcept {
  others_ = Others{.shared = heard - superframe_.rmarker(beacon) + superframe_.shared(),
                   .merge_target = {beacon.session, beacon.superframe}};
  if (sync_.state() == SyncState::kSearching) return false;
  // The other session may be a recording, and no expected frames are missing.
  const bool only_requester_silent = unverified && !coexistence_.lacking();
  send_merge_requests(1, only_requester_silent);
  return phase_ == Phase::kScanning &&
         (!only_requester_silent || requests_within(heard, sync_.start(number_)));
}

void Station::take_content(const Frame& frame, const Beacon& beacon, bool adopted) noexcept {
  slots_.take(beacon, adopted);
  for (ControlChannel* channel : channels()) {
    if (fresh() || channel == &replay_guard_) channel->on_beacon(frame, beacon);
  }
}

// ---- frames

std::optional<Station::Accepted> Station::accept(const Reception& reception, Place place,
                                                 bool unused_slot) noexcept {
  // One named object, so that it is returned without a copy.
  std::optional<Accepted> frame(std::in_place);
  if (const auto error = parse(reception.frame, *frame)) {
    ++(*error == ParseError::kForeign ? counters_.foreign_frames : counters_.malformed_frames);
  } else if (frame->network != site_.network_id) {
    ++counters_.foreign_frames;
  } else if (is_for_this_node(*frame) && authenticate(*frame, reception, place, unused_slot)) {
    return frame;
  }
  frame.reset();
  return frame;
}

bool Station::is_for_this_node(const Frame& frame) const noexcept {
  return frame.destination == site_.id || frame.destination == kBroadcast ||
         std::holds_alternative<Join>(frame.body) || std::holds_alternative<Data>(frame.body);
}

bool Station::authenticate(Accepted& frame, const Reception& reception, Place place,
                           bool unused_slot) noexcept {
  if (frame.secured != keyed())
    return drop(frame.secured ? counters_.foreign_frames : counters_.unsecured_frames);
  if (!keyed()) return true;
  const auto* beacon = std::get_if<Beacon>(&frame.body);
  if (beacon == nullptr && (phase_ == Phase::kSearching || phase_ == Phase::kScanning)) {
    // Without knowing the place this node cannot verify the MIC; but another node is there.
    if (phase_ == Phase::kSearching) coexistence_.on_traffic(reception.timestamp);
    return false;
  }
  const Trust trust = beacon == nullptr ? Trust::kFull : trust_in(*beacon, reception.timestamp);
  const bool request = beacon != nullptr && beacon->merge_request;
  const Place sent_at = beacon == nullptr ? place : place_of(*beacon);
  MergeTarget receivers;
  if (request) receivers = {election_.session(), superframe_at(reception.timestamp)};
  const bool fits =
      trust != Trust::kNone && authenticator_.fits(reception.frame, frame.body, sent_at, receivers);
  frame.unverified = fits && trust == Trust::kUnverified;
  if (fits && !frame.unverified) return true;
  // A merge request of this session to another one is no forgery.
  const bool own_request = request && knows_time() && beacon->session == election_.session();
  ++(own_request ? counters_.stale_frames : counters_.forged_frames);
  if (unused_slot && std::holds_alternative<Poll>(frame.body)) coexistence_.on_unverified_poll();
  return fits;
}

// Once this node knows the time, a replayed beacon of its own session is late against this node's clock. A
// beacon of another timeline may be a replay, unless it is a merge request to this session: it then came in
// this node's own shared slot, and its MIC was made for that slot.
Station::Trust Station::trust_in(const Beacon& beacon, ClockTime heard) const noexcept {
  if (!knows_time()) return beacon.merge_request ? Trust::kNone : Trust::kFull;
  const std::uint32_t number = beacon.merge_request ? superframe_at(heard) : beacon.superframe;
  const Ticks most = superframe_.guard() + sync_.margin(number);
  const Ticks ahead = beacon.merge_request ? sync_.start(number) + superframe_.shared() - heard
                                           : sync_.ahead_by(beacon, heard);
  const bool aligned = ahead <= most && ahead >= -most;
  if (beacon.merge_request) return aligned ? Trust::kFull : Trust::kNone;
  if (beacon.session != election_.session() || (!aligned && beacon.master != election_.master()))
    return Trust::kUnverified;
  return ahead >= -most ? Trust::kFull : Trust::kNone;
}

Action Station::transmit(ClockTime timestamp, std::uint16_t destination, const Body& body, Place place,
                         const MergeTarget& merge_target) noexcept {
  serialize({.sequence = sequence_++,
             .network = site_.network_id,
             .destination = destination,
             .source = site_.id,
             .secured = keyed(),
             .body = body},
            outgoing_);
  // A node that may hear a recording signs its challenge alone.
  if (fresh() != (challenge_of(body) != nullptr)) {
    authenticator_.begin_signing(outgoing_, body, place, merge_target);
  } else {
    authenticator_.abandon();
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

std::optional<Action> Station::listen_on(ClockTime now) const noexcept {
  if (now >= action_.preamble_until.value_or(action_.until)) return std::nullopt;
  return Action{
      .kind = Action::Kind::kListenNow, .until = action_.until, .preamble_until = action_.preamble_until};
}

}  // namespace groma::mac
