#include "firmware/core/mac/coexistence.hpp"

#include <algorithm>
#include <utility>

#include "firmware/core/mac/hash.hpp"

namespace groma::mac {
namespace {

// Superframes in which the nodes of a new session do not scan for missing frames.
constexpr std::uint32_t kSettling = 16;
// For this time after a beacon with a newer schedule a node starts no session, and for this time after it
// left a session it does not return: in superframes of 20 ms a hundred, more than the pauses between scans_
// and twelve rounds of relaying by seven back-ups take.
constexpr Ticks kQuiet = Ticks::from_us(2'000'000);

// Equal at all nodes of a session, different in each superframe and session.
std::uint32_t chance_of(std::uint64_t session, std::uint32_t number) noexcept {
  return mix(static_cast<std::uint32_t>(session >> 32) * 0x9E37'79B9U ^
             static_cast<std::uint32_t>(session) * 0x85EB'CA6BU ^ number) >>
         16;
}

}  // namespace

bool Pause::ends(std::uint32_t number) noexcept {
  constexpr std::int32_t kForgotten = 64;
  constexpr int kGoesOn_log2 = 6;
  const std::int32_t over = since(number, next_);
  if (over < 0) return false;
  if (over > kForgotten) times_ = 0;
  times_ = static_cast<std::uint8_t>(std::min(times_ + 1, at_once_ + longest_log2_));
  int log2 = std::max(times_ - at_once_, 0);
  if (log2 > burst_log2_) log2 = std::min<int>(log2 - burst_log2_ - 1 + kGoesOn_log2, longest_log2_);
  next_ = number + (1U << log2);
  return true;
}

Coexistence::Coexistence(const Site& site, MasterElection& election, std::uint32_t hash) noexcept
    : site_(site),
      election_(election),
      hash_(hash),
      merge_requests_(site.network_key.empty() ? Pause(4, 8, 8) : Pause(1, 2, 8)) {}

void Coexistence::search(ClockTime now, std::uint32_t rounds) noexcept {
  suspected_.reset();
  lacking_ = displaces_older_ = false;
  unverified_polls_ = 0;
  silent_left_ = 0;
  election_.search(now, stale_until_, rounds);
}

void Coexistence::found() noexcept {
  election_.found();
  restart_pauses(0);
}

void Coexistence::restart_pauses(std::uint32_t number) noexcept {
  for (Pause* pause : {&scans_, &unverified_scans_, &merge_requests_, &silences_}) pause->restart(number);
  for (Pause* pause : {&lacks_, &idles_}) pause->restart(number + kSettling);
}

void Coexistence::follow(std::uint16_t source, const Beacon& beacon) noexcept {
  if (election_.role() == Role::kSearching || election_.session() != beacon.session) {
    silent_left_ = 0;
    restart_pauses(beacon.superframe);
  }
  suspected_.reset();
  election_.follow(source, beacon);
}

// The next relay of the other session may be two rounds away, and more if it is the schedule's master, which
// has only every second turn of another rank.
void Coexistence::leave_session(ClockTime now, std::uint32_t number) noexcept {
  constexpr std::uint32_t kRounds = 4;
  avoided_ = election_.session();
  avoided_master_ = election_.master();
  avoided_at_ = number;
  avoided_until_ = now + kQuiet;
  search(now, kRounds);
}

bool Coexistence::of_this_schedule(const Beacon& beacon) const noexcept {
  return beacon.epoch == site_.schedule->epoch && beacon.schedule_hash == hash_;
}

// ---- beacons

Verdict Coexistence::judge(std::uint16_t source, const Beacon& beacon, Ticks ahead, ClockTime now) noexcept {
  if (!of_this_schedule(beacon)) return judge_schedule(beacon, now);
  if (!election_.is_credible(source, beacon)) return Verdict::kStale;
  const bool searching = election_.role() == Role::kSearching;
  const bool same_session = beacon.session == election_.session();
  if (beacon.merge_request && !searching && same_session) return Verdict::kIgnore;
  if (beacon.dissolving) {
    const bool of_own = same_session && beacon.master == election_.master() && beacon.hop == 0;
    if (election_.role() != Role::kFollowing || !of_own || election_.far(ahead)) return Verdict::kIgnore;
    leave_session(now, beacon.superframe);
    return Verdict::kLeave;
  }
  if (searching) {
    // A master that resigned does not continue: newer information than its last beacon's shows that its
    // farewell was not genuine.
    const bool resigned = beacon.master != avoided_master_ || since(origin_of(beacon), avoided_at_) <= 0;
    if (beacon.session == avoided_ && now < avoided_until_ && resigned) return Verdict::kIgnore;
    follow(source, beacon);
    return Verdict::kAdopt;
  }
  return same_session ? judge_own_session(source, beacon, ahead, now)
                      : judge_other_session(source, beacon, ahead);
}

Verdict Coexistence::judge_own_session(std::uint16_t source, const Beacon& beacon, Ticks ahead,
                                       ClockTime now) noexcept {
  if (!election_.far(ahead)) {
    if (beacon.hop == 0) watch_place(beacon);
    if (election_.leads() && beacon.master == election_.master() && beacon.quiet) listens_next_ = true;
  }
  const std::uint16_t master = election_.master();
  const Verdict verdict = election_.judge(source, beacon, ahead);
  if (election_.master() != master) suspected_.reset();
  if (verdict == Verdict::kLeave) search(now);
  return verdict;
}

// Nodes with two different schedules would collide. The newer schedule wins: a node with the older one stops
// transmitting, and a node with the newer one informs the others.
Verdict Coexistence::judge_schedule(const Beacon& beacon, ClockTime now) noexcept {
  const std::uint32_t epoch = site_.schedule->epoch;
  const bool newer = beacon.epoch != epoch ? beacon.epoch > epoch : beacon.schedule_hash > hash_;
  if (election_.role() == Role::kSearching) {
    // A node whose schedule is on trial leaves the older network alone, because other nodes receive their
    // schedule over it; the master receives it last and is the exception.
    const bool waits = newer || (site_.on_trial && election_.rank() != std::size_t{0});
    if (waits) election_.start_not_before(now + kQuiet);
    if (waits || !election_.rank()) return Verdict::kStale;
    if (!std::exchange(displaces_older_, true)) election_.search(now, stale_until_, 0);
    return Verdict::kRequestMerge;
  }
  if (beacon.dissolving) return Verdict::kStale;
  // A single frame may be damaged or forged: require a second one with the same content.
  const std::uint32_t fingerprint = beacon.epoch ^ beacon.schedule_hash;
  if (std::exchange(newer ? newer_schedule_ : older_schedule_, fingerprint) != fingerprint) {
    suspect();
    return Verdict::kStale;
  }
  if (!newer) return request_merge(election_.proven() && !election_.dissolving());
  stale_until_ = now + kQuiet;
  if (election_.leads()) {
    election_.dissolve();
    return Verdict::kStale;
  }
  search(now);
  return Verdict::kLeave;
}

// Aligned parts of one session: judge() decides by rank. Parts that have drifted apart: the one ahead stays,
// so that no count goes back.
Verdict Coexistence::judge_merge_request(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept {
  if (!election_.is_credible(source, beacon)) return Verdict::kStale;
  if (beacon.session == election_.session() && election_.aligned(ahead)) return Verdict::kIgnore;
  if (gives_way(beacon, ahead)) {
    follow(source, beacon);
    return Verdict::kAdopt;
  }
  return silent_left_ != 0 ? Verdict::kIgnore : Verdict::kRequestMerge;
}

Verdict Coexistence::judge_unverified(std::uint16_t source, const Beacon& beacon) noexcept {
  return request_merge(of_this_schedule(beacon) && election_.is_credible(source, beacon));
}

// This node's session gives way to the beacon's session.
bool Coexistence::gives_way(const Beacon& beacon, Ticks ahead) const noexcept {
  const bool older = election_.aligned(ahead) ? beacon.session < election_.session() : ahead > Ticks(0);
  return older || election_.lost_master(election_.number());
}

Verdict Coexistence::judge_other_session(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept {
  if (!gives_way(beacon, ahead)) return request_merge(election_.proven() && !election_.dissolving());
  if (election_.leads()) {
    election_.dissolve();
    return Verdict::kIgnore;
  }
  follow(source, beacon);
  return Verdict::kAdopt;
}

Verdict Coexistence::request_merge(bool may) noexcept {
  const bool due = may && silent_left_ == 0 && merge_requests_.ends(election_.number());
  return due ? Verdict::kRequestMerge : Verdict::kIgnore;
}

// A rank exists once in a site, so its turn is free in the other session.
bool Coexistence::may_request_merge(std::uint32_t number) const noexcept {
  if (!election_.rank() || election_.dissolving()) return false;
  const bool open = election_.turn(number) == 0;
  if (election_.leads() && (open || *election_.rank() == 0)) return open;
  return election_.owns_turn(number);
}

// ---- scans and radio silence

// All nodes of a session scan in the same superframes, so that they do not drown out what they listen for. A
// master mostly omits its beacon then, because two nodes that send at once do not hear each other. Scans are
// random, because two sessions that scan at once do not hear each other either.
Duty Coexistence::begin(std::uint32_t number) noexcept {
  if (election_.begin(number)) return Duty::kTakeOver;
  if (election_.overdue(number)) lacking_ = true;
  if (election_.dissolving()) return Duty::kGoOn;
  quiet_ = silent_left_ != 0;
  const std::uint32_t chance =
      chance_of(election_.session() ^ std::uint64_t{election_.master()} << 32, number);
  const bool may_scan = chance % 8 < 5;
  // This node hears no beacon of its network, does not poll, is not polled, and can never lead: a scan costs
  // nothing.
  const bool orphaned = election_.role() == Role::kFollowing && !election_.rank() && idle_ &&
                        election_.age(number) > MasterElection::kPatience;
  if (std::exchange(listens_next_, false) || (may_scan && orphaned)) return Duty::kLongSilence;
  if (silent_left_ != 0) {
    --silent_left_;
    return election_.leads() ? Duty::kScan : Duty::kSilence;
  }
  if (!begin_scan(number, may_scan)) return Duty::kGoOn;
  // Its own nodes need its beacons.
  constexpr std::int32_t kLongestSilence = 3;
  const bool may_be_silent = since(number, led_) < kLongestSilence;
  return may_be_silent && chance / 8 % 4 != 0 ? Duty::kSilence : Duty::kScan;
}

// Returns true, and begins the pause that follows, if the evidence requires a scan.
bool Coexistence::begin_scan(std::uint32_t number, bool may_scan) noexcept {
  const bool unverified_poll = unverified_polls_ != 0;
  if (unverified_poll) --unverified_polls_;
  constexpr std::int32_t kNews = 4;
  if (suspected_ && since(number, *suspected_) > kNews) suspected_.reset();
  if (!may_scan || election_.has_shared_turn(number)) return false;
  if (suspected_ && scans_.ends(number)) {
    suspected_.reset();
    quiet_ = true;
  } else if (unverified_poll && unverified_scans_.ends(number)) {
    quiet_ = true;
  } else {
    return lacking_ && (idle_ ? idles_ : lacks_).ends(number);
  }
  return true;
}

void Coexistence::keep_silence(std::uint32_t until) noexcept {
  const auto most = static_cast<std::int32_t>(2 * election_.beaconers() + 1);
  silent_left_ =
      static_cast<std::uint32_t>(std::clamp<std::int32_t>(since(until, election_.number()), 0, most));
}

void Coexistence::on_silence() noexcept {
  if (silences_.ends(election_.number())) silent_left_ = std::max(silent_left_, std::uint32_t{1});
}

// If the master is heard in successive shared slots but never in the beacon slot, beacons of another session
// may collide with its own. They can be heard only while the master is silent.
void Coexistence::watch_place(const Beacon& beacon) noexcept {
  const auto recent = static_cast<std::int32_t>(4 * election_.beaconers());
  asks_for_silence_ =
      beacon.shared && beacon.master == displaced_ && since(beacon.superframe, displaced_at_) <= recent;
  displaced_ = beacon.shared ? beacon.master : kNobody;
  displaced_at_ = beacon.superframe;
}

bool Coexistence::ask_for_silence() noexcept {
  listens_next_ = !election_.leads() && std::exchange(asks_for_silence_, false);
  return listens_next_;
}

bool Coexistence::on_led(ClockTime now) noexcept {
  led_ = election_.number();
  if (!election_.dissolving()) return false;
  leave_session(now, led_);
  return true;
}

}  // namespace groma::mac
