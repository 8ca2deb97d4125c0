#include "firmware/core/mac/master_election.hpp"

#include <algorithm>
#include <limits>

#include "firmware/core/mac/superframe.hpp"

namespace groma::mac {

MasterElection::MasterElection(const Site& site, Ticks duration, Ticks guard) noexcept
    : site_(site),
      duration_(duration),
      guard_(guard),
      rank_(site.lender == kNobody ? mac::rank_of(*site.schedule, site.id) : std::nullopt),
      beaconers_(site.schedule->backup_ids_count + 1U) {}

// Long enough to hear a running network in spite of five lost beacons, and for each rank to hear the one
// before.
Ticks MasterElection::listening_time() const noexcept {
  const auto rank = static_cast<std::int64_t>(rank_.value_or(0));
  return std::max(Ticks::from_us(100'000), 5 * duration_) +
         rank * std::max(Ticks::from_us(60'000), 3 * duration_);
}

void MasterElection::search(ClockTime now, ClockTime not_before, std::uint32_t rounds) noexcept {
  part_ = {};
  search_start_ = now;
  lead_at_ = std::max(now + listening_time(), not_before) + std::int64_t{rounds} * beaconers_ * duration_;
}

void MasterElection::on_traffic(ClockTime now) noexcept {
  constexpr std::int64_t kMostListenings = 20;
  const ClockTime latest = search_start_ + kMostListenings * listening_time();
  start_not_before(std::min(now + listening_time(), latest));
}

// In a network with a key no session id may be used twice: it makes the session's key. The ids of an
// uncounted boot may have been used.
std::optional<ClockTime> MasterElection::lead_at() const noexcept {
  constexpr std::uint16_t kLast = std::numeric_limits<std::uint16_t>::max();
  const bool has_session_id =
      site_.network_key.empty() ||
      (site_.boot_count != 0 && site_.sessions != nullptr && *site_.sessions != kLast);
  return rank_ && has_session_id ? std::optional(lead_at_) : std::nullopt;
}

void MasterElection::found() noexcept {
  const std::uint16_t start = site_.sessions == nullptr ? std::uint16_t{0} : (*site_.sessions)++;
  session_ = std::uint64_t{site_.id} << 48 | std::uint64_t{site_.boot_count} << 16 | start;
  heard_ = {};
  former_.reset();
  fresh_ = number_ = 0;
  lead();
}

void MasterElection::lead() noexcept {
  if (part_.role == Role::kFollowing) former_ = fresh_;
  part_ = {.role = Role::kLeading, .master = site_.id};
  proven_ = true;
}

void MasterElection::follow(std::uint16_t source, const Beacon& beacon) noexcept {
  if (part_.role == Role::kSearching || session_ != beacon.session) {
    heard_ = {};
    proven_ = false;
    former_.reset();
  } else if (rank_of_id(beacon.master) > rank_of_id(part_.master)) {
    former_ = fresh_;
  }
  if (const std::size_t rank = rank_of_id(source); rank < kMaxBeaconers) heard_[rank] = beacon.superframe;
  const auto hop = static_cast<std::uint8_t>(std::min<int>(beacon.hop + 1, 255));
  part_ = {.role = Role::kFollowing, .master = beacon.master, .parent = source, .hop = hop};
  session_ = beacon.session;
  number_ = beacon.superframe;
  parent_origin_ = fresh_ = origin_of(beacon);
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
  return beacon.age <= patience_at(beacon.hop) && (!former_ || since(origin_of(beacon), *former_) > 0);
}

Verdict MasterElection::judge(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept {
  if (far(ahead)) return judge_misplaced(beacon, ahead);
  return leads() ? judge_as_master(source, beacon, ahead) : judge_as_follower(source, beacon, ahead);
}

// A beacon far from its place is outdated. But if the acting master repeats such a count several times in a
// row, this node's own count is wrong.
Verdict MasterElection::judge_misplaced(const Beacon& beacon, Ticks ahead) noexcept {
  constexpr std::uint8_t kBelieved = 3;
  if (beacon.hop != 0 || ++part_.misplaced < kBelieved) return Verdict::kIgnore;
  part_.misplaced = 0;
  if (!leads()) return Verdict::kLeave;
  if (ahead > Ticks(0)) dissolve();
  return Verdict::kIgnore;
}

Verdict MasterElection::judge_as_master(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept {
  if (beacon.master == site_.id) return Verdict::kIgnore;
  const std::size_t theirs = rank_of_id(beacon.master);
  if (theirs > *rank_) {
    part_.competitor = theirs;
    competitor_until_ = beacon.superframe + 8 * beaconers_;
    return Verdict::kIgnore;
  }
  if (!is_news(beacon)) return Verdict::kIgnore;
  if (!aligned(ahead)) {
    dissolve();
    return Verdict::kIgnore;
  }
  follow(source, beacon);
  return Verdict::kSwitch;
}

Verdict MasterElection::judge_as_follower(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept {
  if (beacon.master == site_.id) return Verdict::kIgnore;  // outdated: this node was the master
  const std::int32_t newer = since(origin_of(beacon), fresh_);
  if (beacon.master != part_.master) {
    const bool better = rank_of_id(beacon.master) < rank_of_id(part_.master) && is_news(beacon);
    // Information from its own master may be as old as this node's own path to it allows.
    if (!better && newer <= static_cast<std::int32_t>(patience() - kPatience / 2)) return Verdict::kIgnore;
    follow(source, beacon);
    return aligned(ahead) ? Verdict::kSwitch : Verdict::kAdopt;
  }
  if (!aligned(ahead)) return Verdict::kMeasure;  // the clock filter decides whether to use it
  heard_[rank_of_id(source)] = beacon.superframe;
  part_.misplaced = 0;
  if (newer > 0) {
    proven_ = true;
    fresh_ = origin_of(beacon);
  }
  return choose_parent(source, beacon, newer);
}

// Of an aligned beacon of the followed master, whose content is `newer` by as many superframes.
Verdict MasterElection::choose_parent(std::uint16_t source, const Beacon& beacon,
                                      std::int32_t newer) noexcept {
  const std::uint32_t origin = origin_of(beacon);
  const auto hop = static_cast<std::uint8_t>(std::min<int>(beacon.hop + 1, 255));
  if (source == part_.parent) {
    // A relay that has not heard news itself knows no more than this node.
    if (since(origin, parent_origin_) <= 0) return Verdict::kKnown;
    part_.hop = hop;
    parent_origin_ = origin;
    return Verdict::kMeasure;
  }
  const auto silent = since(beacon.superframe, parent_origin_);
  const auto turns = static_cast<std::int32_t>(beaconers_);
  constexpr std::int32_t kMissesOfMaster = 6;
  const bool lost = silent > (part_.hop == 1 ? kMissesOfMaster : 3 * turns + beacon.age);
  const bool better = hop < part_.hop || lost || newer > 2 * turns;
  if (newer <= 0 || !better) return Verdict::kKnown;
  part_.parent = source;
  parent_origin_ = origin;
  part_.hop = hop;
  return Verdict::kSwitch;
}

// Counts better ranks that were heard recently, except the present master.
std::uint32_t MasterElection::better_ranks_alive(std::uint32_t number) const noexcept {
  const auto recent = static_cast<std::int32_t>(kPatience + 4 * beaconers_);
  std::uint32_t count = 0;
  for (std::size_t rank = 0; rank < *rank_; ++rank) {
    if (rank == rank_of_id(part_.master) || !heard_[rank]) continue;
    if (since(number, *heard_[rank]) <= recent) ++count;
  }
  return count;
}

bool MasterElection::begin(std::uint32_t number) noexcept {
  number_ = number;
  if (part_.competitor != 0 && since(number, competitor_until_) > 0) part_.competitor = 0;
  if (leads()) {
    fresh_ = number;
    return false;
  }
  const std::uint32_t unheard = age(number);
  if (!(rank_ && proven_ && unheard > patience() + better_ranks_alive(number) * (beaconers_ + 2)))
    return false;
  lead();
  fresh_ = number;
  return true;
}

void MasterElection::on_absence(std::uint32_t number) noexcept {
  if (!leads() || since(number, fresh_) < static_cast<std::int32_t>(kPatience - 2)) return;
  constexpr std::uint32_t kToHearOthers = 3;
  part_.role = Role::kFollowing;
  part_.hop = 1;
  part_.dissolving = false;
  fresh_ = number - kPatience + kToHearOthers;
}

// The ranks beyond the first have one turn each. An acting master of such a rank uses every second one of its
// turns; the schedule's master, which has no turn, uses the others. So any two of them can hear each other.
bool MasterElection::owns_turn(std::uint32_t number) const noexcept {
  if (!rank_ || turn(number) == 0) return false;
  if (*rank_ != 0) return turn(number) == *rank_ && (even(number) || !leads());
  return turn(number) == (leads() ? part_.competitor : rank_of_id(part_.master)) && !even(number);
}

bool MasterElection::has_shared_turn(std::uint32_t number) const noexcept {
  const bool may =
      part_.role != Role::kSearching && !part_.dissolving && (leads() || age(number) <= patience());
  return may && owns_turn(number);
}

bool MasterElection::parent_due(std::uint32_t number, bool shared) const noexcept {
  if (part_.role != Role::kFollowing) return false;
  if (part_.hop <= 1) return !shared;
  return shared && turn(number) == rank_of_id(part_.parent);
}

}  // namespace groma::mac
