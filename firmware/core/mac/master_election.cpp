#include "firmware/core/mac/master_election.hpp"

#include <algorithm>
#include <limits>
#include <utility>

#include "firmware/core/mac/superframe.hpp"

namespace groma::mac {
namespace {

using ranging::ClockTime;
using ranging::Ticks;

// The number of superframes from `b` to `a`; correct across the number's wrap.
constexpr std::int32_t since(std::uint32_t a, std::uint32_t b) noexcept {
  return static_cast<std::int32_t>(a - b);
}

// Superframes in which the nodes of a new session do not scan for missing frames.
constexpr std::uint32_t kSettling = 16;

// Equal at all nodes of a session, different in each superframe and session. The finalizer of MurmurHash3.
std::uint32_t chance_of(std::uint64_t session, std::uint32_t number) noexcept {
  std::uint32_t h = static_cast<std::uint32_t>(session >> 32) * 0x9E37'79B9U ^
                    static_cast<std::uint32_t>(session) * 0x85EB'CA6BU ^ number;
  h ^= h >> 16;
  h *= 0x85EB'CA6BU;
  h ^= h >> 13;
  h *= 0xC2B2'AE35U;
  return h >> 16;
}

}  // namespace

MasterElection::MasterElection(const Site& site, Ticks duration, Ticks guard, std::uint32_t hash) noexcept
    : site_(site),
      duration_(duration),
      guard_(guard),
      hash_(hash),
      rank_(site.lender == kNobody ? rank_of(*site.schedule, site.id) : std::nullopt),
      beaconers_(site.schedule->backup_ids_count + 1U),
      merge_requests_(site.network_key.empty() ? Pause(4, 8, 8) : Pause(1, 2, 8)) {}

// Long enough to hear a running network in spite of five lost beacons, and for each rank to hear the one
// before.
Ticks MasterElection::listening_time() const noexcept {
  const auto rank = static_cast<std::int64_t>(rank_.value_or(0));
  return std::max(Ticks::from_us(100'000), 5 * duration_) +
         rank * std::max(Ticks::from_us(60'000), 3 * duration_);
}

void MasterElection::search(ClockTime now) noexcept {
  role_ = Role::kSearching;
  master_ = parent_ = kNobody;
  last_beacons_ = 0;
  competitor_ = 0;
  suspicious_ = lacking_ = displaces_older_ = false;
  unverified_polls_ = 0;
  silent_left_ = 0;
  search_start_ = now;
  lead_at_ = std::max(now + listening_time(), stale_until_);
}

void MasterElection::on_traffic(ClockTime now) noexcept {
  if (displaces_older_) return;
  constexpr std::int64_t kMostListenings = 20;
  const ClockTime latest = search_start_ + kMostListenings * listening_time();
  lead_at_ = std::max(lead_at_, std::min(now + listening_time(), latest));
}

std::optional<ClockTime> MasterElection::lead_at() const noexcept {
  if (!rank_ || !has_session_id()) return std::nullopt;
  return lead_at_;
}

// In a network with a key no session id may be used twice: it makes the session's key. The ids of an
// uncounted boot may have been used.
bool MasterElection::has_session_id() const noexcept {
  if (site_.network_key.empty()) return true;
  return site_.boot_count != 0 && site_.sessions != nullptr &&
         *site_.sessions != std::numeric_limits<std::uint16_t>::max();
}

void MasterElection::found() noexcept {
  const std::uint16_t start = site_.sessions == nullptr ? std::uint16_t{0} : (*site_.sessions)++;
  session_ = std::uint64_t{site_.id} << 48 | std::uint64_t{site_.boot_count} << 16 | start;
  heard_ = {};
  former_.reset();
  fresh_ = number_ = 0;
  scans_.restart(0);
  unverified_scans_.restart(0);
  lacks_.restart(kSettling);
  idles_.restart(kSettling);
  merge_requests_.restart(0);
  lead();
}

void MasterElection::lead() noexcept {
  if (role_ == Role::kFollowing) former_ = fresh_;
  role_ = Role::kLeading;
  master_ = site_.id;
  parent_ = kNobody;
  hop_ = 0;
  last_beacons_ = 0;
  competitor_ = 0;
  proven_ = true;
  misplaced_ = 0;
}

void MasterElection::dissolve() noexcept {
  constexpr std::uint8_t kLastBeacons = 1;
  if (last_beacons_ == 0) last_beacons_ = kLastBeacons;
}

// The next relay of the other session may be two rounds away, and more if it is the schedule's master, which
// has only every second turn of another rank.
void MasterElection::leave_session(ClockTime now) noexcept {
  avoided_ = session_;
  avoided_master_ = master_;
  avoided_at_ = number_;
  avoided_until_ = now + Ticks::from_us(2'000'000);
  search(now);
  lead_at_ = lead_at_ + 4 * std::int64_t{beaconers_} * duration_;
}

// A master that resigned does not continue: newer information than its last beacon's shows that its farewell
// was not genuine.
bool MasterElection::is_avoided(const Beacon& beacon, ClockTime now) const noexcept {
  if (beacon.session != avoided_ || now >= avoided_until_) return false;
  return beacon.master != avoided_master_ || since(beacon.superframe - beacon.age, avoided_at_) <= 0;
}

void MasterElection::follow(std::uint16_t source, const Beacon& beacon) noexcept {
  if (role_ == Role::kSearching || session_ != beacon.session) {
    heard_ = {};
    silent_left_ = 0;
    scans_.restart(beacon.superframe);
    unverified_scans_.restart(beacon.superframe);
    lacks_.restart(beacon.superframe + kSettling);
    idles_.restart(beacon.superframe + kSettling);
    merge_requests_.restart(beacon.superframe);
    silences_.restart(beacon.superframe);
    proven_ = false;
    former_.reset();
  } else if (rank_of_id(beacon.master) > rank_of_id(master_)) {
    former_ = fresh_;
  }
  if (const std::size_t rank = rank_of_id(source); rank < kMaxBeaconers) heard_[rank] = beacon.superframe;
  suspicious_ = false;
  role_ = Role::kFollowing;
  session_ = beacon.session;
  number_ = beacon.superframe;
  master_ = beacon.master;
  parent_ = source;
  parent_origin_ = beacon.superframe - beacon.age;
  hop_ = static_cast<std::uint8_t>(std::min<int>(beacon.hop + 1, 255));
  fresh_ = beacon.superframe - beacon.age;
  last_beacons_ = 0;
  misplaced_ = 0;
}

std::size_t MasterElection::rank_of_id(std::uint16_t id) const noexcept {
  return rank_of(*site_.schedule, id).value_or(beaconers_);
}

std::uint32_t MasterElection::age(std::uint32_t number) const noexcept {
  if (leads()) return 0;
  return static_cast<std::uint32_t>(std::max<std::int32_t>(since(number, fresh_), 0));
}

// Each hop beyond the first may wait for its turn twice.
std::uint32_t MasterElection::patience_at(std::uint8_t hop) const noexcept {
  const std::uint32_t relays = hop == 0 ? 0 : std::min<std::uint32_t>(hop - 1U, kMaxBeaconers);
  return kPatience + 2 * beaconers_ * relays;
}

bool MasterElection::is_credible(std::uint16_t source, const Beacon& beacon) const noexcept {
  const bool own_word = beacon.hop == 0;
  return rank_of_id(source) != beaconers_ && rank_of_id(beacon.master) != beaconers_ &&
         own_word == (source == beacon.master) && (!own_word || beacon.age == 0);
}

// Of a beacon with another master of this session: that master may be alive, given its path's delay, and the
// information is newer than what was known when that master was replaced.
bool MasterElection::is_news(const Beacon& beacon) const noexcept {
  const std::uint32_t origin = beacon.superframe - beacon.age;
  return beacon.age <= patience_at(beacon.hop) && (!former_ || since(origin, *former_) > 0);
}

Verdict MasterElection::judge(std::uint16_t source, const Beacon& beacon, Ticks ahead,
                              ClockTime now) noexcept {
  if (beacon.epoch != site_.schedule->epoch || beacon.schedule_hash != hash_) {
    return judge_schedule(beacon, now);
  }
  if (!is_credible(source, beacon)) return Verdict::kStale;
  if (beacon.merge_request && role_ != Role::kSearching && beacon.session == session_)
    return Verdict::kIgnore;
  const bool own_word = beacon.hop == 0;
  const Ticks half(duration_.count() / 2);
  const bool far = ahead > half || ahead < -half;
  if (beacon.dissolving) {
    const bool of_own = beacon.session == session_ && beacon.master == master_ && own_word && !far;
    if (role_ != Role::kFollowing || !of_own) return Verdict::kIgnore;
    number_ = beacon.superframe;
    leave_session(now);
    return Verdict::kLeave;
  }
  if (role_ == Role::kSearching) {
    if (is_avoided(beacon, now)) return Verdict::kIgnore;
    follow(source, beacon);
    return Verdict::kAdopt;
  }
  if (beacon.session != session_) return judge_other_session(source, beacon, ahead);
  if (far) return judge_misplaced(beacon, ahead, now);
  if (own_word && !beacon.merge_request) watch_place(beacon);
  return leads() ? judge_as_master(source, beacon, ahead) : judge_as_follower(source, beacon, ahead);
}

// A beacon far from its place is outdated. But if the acting master repeats such a count several times in a
// row, this node's own count is wrong.
Verdict MasterElection::judge_misplaced(const Beacon& beacon, Ticks ahead, ClockTime now) noexcept {
  constexpr std::uint8_t kBelieved = 3;
  if (beacon.hop != 0 || beacon.merge_request || ++misplaced_ < kBelieved) return Verdict::kIgnore;
  misplaced_ = 0;
  if (leads()) {
    if (ahead > Ticks(0)) dissolve();
    return Verdict::kIgnore;
  }
  search(now);
  return Verdict::kLeave;
}

// Nodes with two different schedules would collide. The newer schedule wins: a node with the older one stops
// transmitting, and a node with the newer one informs the others. A node whose schedule is on trial leaves
// the older network alone, because other nodes receive their schedule over it; the master receives it last
// and is the exception.
Verdict MasterElection::judge_schedule(const Beacon& beacon, ClockTime now) noexcept {
  const std::uint32_t epoch = site_.schedule->epoch;
  const bool newer = beacon.epoch != epoch ? beacon.epoch > epoch : beacon.schedule_hash > hash_;
  constexpr Ticks kQuiet = Ticks::from_us(2'000'000);
  if (role_ == Role::kSearching) {
    const bool waits = newer || (site_.on_trial && rank_ != std::size_t{0});
    if (waits) lead_at_ = std::max(lead_at_, now + kQuiet);
    if (waits || !rank_) return Verdict::kStale;
    if (!std::exchange(displaces_older_, true)) lead_at_ = std::max(now + listening_time(), stale_until_);
    return Verdict::kRequestMerge;
  }
  if (beacon.dissolving) return Verdict::kStale;
  // A single frame may be damaged or forged: require a second one with the same content.
  const std::uint32_t fingerprint = beacon.epoch ^ beacon.schedule_hash;
  if (std::exchange(newer ? newer_schedule_ : older_schedule_, fingerprint) != fingerprint) {
    suspect();
    return Verdict::kStale;
  }
  if (!newer) return request_merge();
  stale_until_ = now + kQuiet;
  if (leads()) {
    dissolve();
    return Verdict::kStale;
  }
  search(now);
  return Verdict::kLeave;
}

// Aligned parts of one session: judge() decides by rank. Parts that have drifted apart: the one ahead stays,
// so that no count goes back.
Verdict MasterElection::judge_merge_request(std::uint16_t source, const Beacon& beacon,
                                            Ticks ahead) noexcept {
  if (!is_credible(source, beacon)) return Verdict::kStale;
  if (beacon.session == session_ && ahead <= guard_ && ahead >= -guard_) return Verdict::kIgnore;
  if (gives_way(beacon, ahead)) {
    follow(source, beacon);
    return Verdict::kAdopt;
  }
  return silent_left_ != 0 ? Verdict::kIgnore : Verdict::kRequestMerge;
}

Verdict MasterElection::judge_unverified(std::uint16_t source, const Beacon& beacon) noexcept {
  if (beacon.epoch != site_.schedule->epoch || beacon.schedule_hash != hash_ || !is_credible(source, beacon))
    return Verdict::kIgnore;
  if (silent_left_ != 0 || !merge_requests_.over(number_)) return Verdict::kIgnore;
  merge_requests_.begin(number_);
  return Verdict::kRequestMerge;
}

// This node's session gives way to the beacon's session.
bool MasterElection::gives_way(const Beacon& beacon, Ticks ahead) const noexcept {
  const bool older = ahead > guard_ || (ahead >= -guard_ && beacon.session < session_);
  const bool lost_master = role_ == Role::kFollowing && age(number_) > patience();
  return older || lost_master;
}

Verdict MasterElection::judge_other_session(std::uint16_t source, const Beacon& beacon,
                                            Ticks ahead) noexcept {
  if (!gives_way(beacon, ahead)) return request_merge();
  if (leads()) {
    dissolve();
    return Verdict::kIgnore;
  }
  follow(source, beacon);
  return Verdict::kAdopt;
}

Verdict MasterElection::request_merge() noexcept {
  if (!proven_ || silent_left_ != 0 || last_beacons_ != 0 || !merge_requests_.over(number_)) {
    return Verdict::kIgnore;
  }
  merge_requests_.begin(number_);
  return Verdict::kRequestMerge;
}

Verdict MasterElection::judge_as_master(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept {
  if (beacon.master == site_.id) {
    if (beacon.quiet) listens_next_ = true;
    return Verdict::kIgnore;
  }
  const std::size_t theirs = rank_of_id(beacon.master);
  if (theirs > *rank_) {
    competitor_ = theirs;
    competitor_until_ = beacon.superframe + 8 * beaconers_;
    return Verdict::kIgnore;
  }
  if (!is_news(beacon)) return Verdict::kIgnore;
  if (ahead > guard_ || ahead < -guard_) {
    dissolve();
    return Verdict::kIgnore;
  }
  follow(source, beacon);
  return Verdict::kSwitch;
}

Verdict MasterElection::judge_as_follower(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept {
  if (beacon.master == site_.id) return Verdict::kIgnore;  // outdated: this node was the master
  const bool aligned = ahead <= guard_ && ahead >= -guard_;
  const std::int32_t newer = since(beacon.superframe - beacon.age, fresh_);
  if (beacon.master != master_) {
    const bool better = rank_of_id(beacon.master) < rank_of_id(master_) && is_news(beacon);
    // Information from its own master may be as old as this node's own path to it allows.
    if (!better && newer <= static_cast<std::int32_t>(patience() - kPatience / 2)) return Verdict::kIgnore;
    follow(source, beacon);
    return aligned ? Verdict::kSwitch : Verdict::kAdopt;
  }
  if (!aligned) return Verdict::kMeasure;  // the clock filter decides whether to use it
  heard_[rank_of_id(source)] = beacon.superframe;
  misplaced_ = 0;
  if (newer > 0) proven_ = true;
  const std::uint32_t origin = beacon.superframe - beacon.age;
  if (newer > 0) fresh_ = origin;
  const auto hop = static_cast<std::uint8_t>(std::min<int>(beacon.hop + 1, 255));
  if (source == parent_) {
    // A relay that has not heard news itself knows no more than this node.
    if (since(origin, parent_origin_) <= 0) return Verdict::kKnown;
    hop_ = hop;
    parent_origin_ = origin;
    return Verdict::kMeasure;
  }
  const auto silent = since(beacon.superframe, parent_origin_);
  const auto turns = static_cast<std::int32_t>(beaconers_);
  constexpr std::int32_t kMissesOfMaster = 6;
  const bool lost = silent > (hop_ == 1 ? kMissesOfMaster : 3 * turns + beacon.age);
  const bool better = hop < hop_ || lost || newer > 2 * turns;
  if (newer <= 0 || !better) return Verdict::kKnown;
  parent_ = source;
  parent_origin_ = origin;
  hop_ = hop;
  return Verdict::kSwitch;
}

// If the master is heard in successive shared slots but never in the beacon slot, beacons of another session
// may collide with its own. They can be heard only while the master is silent.
void MasterElection::watch_place(const Beacon& beacon) noexcept {
  const bool next = beacon.shared && beacon.master == displaced_ &&
                    since(beacon.superframe, displaced_at_) <= static_cast<std::int32_t>(4 * beaconers_);
  asks_for_silence_ = next;
  displaced_ = beacon.shared ? beacon.master : kNobody;
  displaced_at_ = beacon.superframe;
}

bool MasterElection::ask_for_silence() noexcept {
  listens_next_ = !leads() && std::exchange(asks_for_silence_, false);
  return listens_next_;
}

// Counts better ranks that were heard recently, except the present master.
std::uint32_t MasterElection::better_ranks_alive(std::uint32_t number) const noexcept {
  const auto recent = static_cast<std::int32_t>(kPatience + 4 * beaconers_);
  std::uint32_t count = 0;
  for (std::size_t rank = 0; rank < *rank_; ++rank) {
    if (rank == rank_of_id(master_) || !heard_[rank]) continue;
    if (since(number, *heard_[rank]) <= recent) ++count;
  }
  return count;
}

Duty MasterElection::begin(std::uint32_t number) noexcept {
  number_ = number;
  if (competitor_ != 0 && since(number, competitor_until_) > 0) competitor_ = 0;
  if (leads()) {
    fresh_ = number;
  } else {
    const std::uint32_t unheard = age(number);
    if (rank_ && proven_ && unheard > patience() + better_ranks_alive(number) * (beaconers_ + 2)) {
      lead();
      fresh_ = number;
      return Duty::kTakeOver;
    }
    if (unheard > patience() + beaconers_ * (beaconers_ + 4)) lacking_ = true;
  }
  return scan_duty(number);
}

bool MasterElection::orphaned_after_one_beacon(std::uint32_t number) const noexcept {
  return role_ == Role::kFollowing && !proven_ && age(number) > patience() + 2 * beaconers_;
}

void MasterElection::keep_silence(std::uint32_t until) noexcept {
  silent_left_ = static_cast<std::uint32_t>(
      std::clamp<std::int32_t>(since(until, number_), 0, static_cast<std::int32_t>(2 * beaconers_ + 1)));
}

void MasterElection::on_silence() noexcept {
  if (!silences_.over(number_)) return;
  silences_.begin(number_);
  silent_left_ = std::max(silent_left_, std::uint32_t{1});
}

// A rank exists once in a site, so its turn is free in the other session. An acting master shares its turn
// with the schedule's master, as in has_shared_turn().
bool MasterElection::may_request_merge(std::uint32_t number) const noexcept {
  if (!rank_ || last_beacons_ != 0) return false;
  const std::uint32_t turn = number % beaconers_;
  const bool even = number / beaconers_ % 2 == 0;
  if (turn == 0) return leads();
  if (turn == *rank_) return !leads() || even;
  return *rank_ == 0 && !leads() && turn == rank_of_id(master_) && !even;
}

// All nodes of a session scan in the same superframes, so that they do not drown out what they listen for. A
// master mostly omits its beacon then, because two nodes that send at once do not hear each other. Scans are
// random, because two sessions that scan at once do not hear each other either.
Duty MasterElection::scan_duty(std::uint32_t number) noexcept {
  if (last_beacons_ != 0) return Duty::kGoOn;
  quiet_ = silent_left_ != 0;
  const std::uint32_t chance = chance_of(session_ ^ std::uint64_t{master_} << 32, number);
  const bool may_scan = chance % 8 < 5;
  if (std::exchange(listens_next_, false) || (may_scan && orphaned(number))) return Duty::kLongSilence;
  if (silent_left_ != 0) {
    --silent_left_;
    return leads() ? Duty::kScan : Duty::kSilence;
  }
  const bool unverified_poll = unverified_polls_ != 0;
  if (unverified_poll) --unverified_polls_;
  constexpr std::int32_t kNews = 4;
  if (since(number, suspected_) > kNews) suspicious_ = false;
  if (!may_scan || has_shared_turn(number)) return Duty::kGoOn;
  if (suspicious_ && scans_.over(number)) {
    scans_.begin(number);
    suspicious_ = false;
    quiet_ = true;
  } else if (unverified_poll && unverified_scans_.over(number)) {
    unverified_scans_.begin(number);
    quiet_ = true;
  } else if (Pause& pause = idle_ ? idles_ : lacks_; lacking_ && pause.over(number)) {
    pause.begin(number);
  } else {
    return Duty::kGoOn;
  }
  // Its own nodes need its beacons.
  constexpr std::int32_t kLongestSilence = 3;
  const bool may_be_silent = since(number, led_) < kLongestSilence;
  return may_be_silent && chance / 8 % 4 != 0 ? Duty::kSilence : Duty::kScan;
}

void MasterElection::Pause::restart(std::uint32_t number) noexcept {
  next_ = number;
  times_ = 0;
}

bool MasterElection::Pause::over(std::uint32_t number) const noexcept {
  return since(number, next_) >= 0;
}

void MasterElection::Pause::begin(std::uint32_t number) noexcept {
  constexpr std::int32_t kForgotten = 64;
  constexpr int kGoesOn_log2 = 6;
  if (since(number, next_) > kForgotten) times_ = 0;
  times_ = static_cast<std::uint8_t>(std::min(times_ + 1, at_once_ + longest_log2_));
  int log2 = std::max(times_ - at_once_, 0);
  if (log2 > burst_log2_) log2 = std::min<int>(log2 - burst_log2_ - 1 + kGoesOn_log2, longest_log2_);
  next_ = number + (1U << log2);
}

void MasterElection::on_absence(std::uint32_t number) noexcept {
  if (!leads() || since(number, fresh_) < static_cast<std::int32_t>(kPatience - 2)) return;
  constexpr std::uint32_t kToHearOthers = 3;
  role_ = Role::kFollowing;
  hop_ = 1;
  last_beacons_ = 0;
  fresh_ = number - kPatience + kToHearOthers;
}

// The ranks beyond the first have one turn each. An acting master of such a rank uses every second one of its
// turns; the schedule's master, which has no turn, uses the others. So any two of them can hear each other.
bool MasterElection::has_shared_turn(std::uint32_t number) const noexcept {
  if (!rank_ || role_ == Role::kSearching || last_beacons_ != 0) return false;
  const std::uint32_t turn = number % beaconers_;
  const bool even = number / beaconers_ % 2 == 0;
  if (leads()) {
    if (*rank_ != 0) return turn == *rank_ && even;
    return competitor_ != 0 && turn == competitor_ && !even;
  }
  if (age(number) > patience()) return false;
  if (*rank_ != 0) return turn == *rank_;
  return turn != 0 && turn == rank_of_id(master_) && !even;
}

bool MasterElection::on_led(ClockTime now) noexcept {
  led_ = number_;
  if (last_beacons_ == 0 || --last_beacons_ != 0) return false;
  leave_session(now);
  return true;
}

bool MasterElection::parent_due(std::uint32_t number, bool shared) const noexcept {
  if (role_ != Role::kFollowing) return false;
  if (hop_ <= 1) return !shared;
  return shared && number % beaconers_ == rank_of_id(parent_);
}

}  // namespace groma::mac
