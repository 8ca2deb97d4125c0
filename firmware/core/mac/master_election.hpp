// Master election within one session, and the choice of the path that this node follows: pure decisions,
// without radio and clock filter. Coexistence (coexistence.hpp) judges beacons of other timelines first.
//
//   searching --beacon--> following --master silent for long, and next in rank--> leading
//       ^  \--no node heard for long, and ranked--> leading (a new session)          |
//       |                                                                            |
//       +-------- dissolved, or a newer schedule heard ------------------------------+
//
// docs/explanation/network.md has the rules.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/site.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/ranging/device_time.hpp"

namespace groma::mac {

enum class Role : std::uint8_t { kSearching, kFollowing, kLeading };

// How this node uses a beacon.
enum class Verdict : std::uint8_t {
  kIgnore,        // not at all
  kStale,         // of another schedule
  kKnown,         // of the followed network, but by another path than the clock filter's
  kMeasure,       // as a measurement for the clock filter
  kSwitch,        // as kMeasure, the first by another path
  kAdopt,         // to follow this timeline from now on: the clock filter restarts with it
  kLeave,         // to stop transmitting and search
  kRequestMerge,  // to send merge requests to its session, which has to join this one or fall silent
};

class MasterElection {
 public:
  // `duration`: of a superframe. `guard`: timelines that differ by less count as aligned.
  MasterElection(const Site& site, Ticks duration, Ticks guard) noexcept
      : site_(site),
        duration_(duration),
        guard_(guard),
        rank_(site.lender == kNobody ? mac::rank_of(*site.schedule, site.id) : std::nullopt),
        beaconers_(site.schedule->backup_ids_count + 1U) {}

  // Starts the search, at power-up or when the time is lost. Starts no session before `not_before`, and
  // listens for `rounds` rounds of relaying more.
  void search(ClockTime now, ClockTime not_before, std::uint32_t rounds) noexcept {
    part_ = {};
    search_start_ = now;
    lead_at_ = std::max(now + listening_time(), not_before) + std::int64_t{rounds} * beaconers_ * duration_;
  }
  void start_not_before(ClockTime time) noexcept { lead_at_ = std::max(lead_at_, time); }
  // While searching, reports a frame of this network that is not a beacon. Another node is there, so this one
  // waits longer before it leads.
  void on_traffic(ClockTime now) noexcept {
    constexpr std::int64_t kMostListenings = 20;
    const ClockTime latest = search_start_ + kMostListenings * listening_time();
    start_not_before(std::min(now + listening_time(), latest));
  }
  // While searching: when to start a session if no node has been heard until then; nothing: never.
  // In a network with a key no session id may be used twice: it makes the session's key. The ids of an
  // uncounted boot may have been used.
  [[nodiscard]] std::optional<ClockTime> lead_at() const noexcept {
    constexpr std::uint16_t kLast = std::numeric_limits<std::uint16_t>::max();
    const bool has_session_id =
        site_.network_key.empty() ||
        (site_.boot_count != 0 && site_.sessions != nullptr && *site_.sessions != kLast);
    return rank_ && has_session_id ? std::optional(lead_at_) : std::nullopt;
  }
  // Starts a session: leads, from superframe 0 on.
  void found() noexcept {
    const std::uint16_t start = site_.sessions == nullptr ? std::uint16_t{0} : (*site_.sessions)++;
    session_ = std::uint64_t{site_.id} << 48 | std::uint64_t{site_.boot_count} << 16 | start;
    heard_ = {};
    former_.reset();
    fresh_ = number_ = 0;
    lead();
  }
  // Follows the beacon's master, by the path of `source`.
  void follow(std::uint16_t source, const Beacon& beacon) noexcept {
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
  // Marks the next beacon of this master as its last one.
  void dissolve() noexcept { part_.dissolving = true; }

  // Only anchors with a rank send beacons, and a master's own beacon is as old as its hop count.
  [[nodiscard]] bool is_credible(std::uint16_t source, const Beacon& beacon) const noexcept {
    const bool own_word = beacon.hop == 0;
    return rank_of_id(source) != beaconers_ && rank_of_id(beacon.master) != beaconers_ &&
           own_word == (source == beacon.master) && (!own_word || beacon.age == 0);
  }
  // Judges a credible beacon of this session, sent by `source`. `ahead`: how far its timeline is ahead of
  // this node's. After kLeave this node has to search.
  [[nodiscard]] Verdict judge(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept {
    if (far(ahead)) return judge_misplaced(beacon, ahead);
    return leads() ? judge_as_master(source, beacon, ahead) : judge_as_follower(source, beacon, ahead);
  }

  // While not searching: superframe `number` begins. `number` increases from call to call. Returns true if
  // this node leads from now on and keeps the present time.
  [[nodiscard]] bool begin(std::uint32_t number) noexcept {
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
  // The radio was off: the knowledge of an acting master may be outdated.
  void on_absence(std::uint32_t number) noexcept {
    if (!leads() || since(number, fresh_) < static_cast<std::int32_t>(kPatience - 2)) return;
    constexpr std::uint32_t kToHearOthers = 3;
    part_.role = Role::kFollowing;
    part_.hop = 1;
    part_.dissolving = false;
    fresh_ = number - kPatience + kToHearOthers;
  }
  // Whose turn the shared slot of superframe `number` is: 0: open to all; n: of the back-up of rank n.
  [[nodiscard]] std::uint32_t turn(std::uint32_t number) const noexcept { return number % beaconers_; }
  // The turns of a rank are even and odd alternately.
  [[nodiscard]] bool even(std::uint32_t number) const noexcept { return number / beaconers_ % 2 == 0; }
  // The turn is this node's.
  // The ranks beyond the first have one turn each. An acting master of such a rank uses every second one of
  // its turns; the schedule's master, which has no turn, uses the others. So any two of them can hear each
  // other.
  [[nodiscard]] bool owns_turn(std::uint32_t number) const noexcept {
    if (!rank_ || turn(number) == 0) return false;
    if (*rank_ != 0) return turn(number) == *rank_ && (even(number) || !leads());
    return turn(number) == (leads() ? part_.competitor : rank_of_id(part_.master)) && !even(number);
  }
  // This node sends a beacon in the shared slot of superframe `number`.
  [[nodiscard]] bool has_shared_turn(std::uint32_t number) const noexcept {
    const bool may =
        part_.role != Role::kSearching && !part_.dissolving && (leads() || age(number) <= patience());
    return may && owns_turn(number);
  }
  // In superframe `number` a beacon of the followed path is due, in the shared slot or in the beacon slot.
  [[nodiscard]] bool parent_due(std::uint32_t number, bool shared) const noexcept {
    if (part_.role != Role::kFollowing) return false;
    if (part_.hop <= 1) return !shared;
    return shared && turn(number) == rank_of_id(part_.parent);
  }

  [[nodiscard]] Role role() const noexcept { return part_.role; }
  [[nodiscard]] bool leads() const noexcept { return part_.role == Role::kLeading; }
  [[nodiscard]] std::optional<std::size_t> rank() const noexcept { return rank_; }
  // beaconers() if it has none.
  [[nodiscard]] std::size_t rank_of_id(std::uint16_t id) const noexcept {
    return rank_of(*site_.schedule, id).value_or(beaconers_);
  }
  // The number of anchors that send beacons.
  [[nodiscard]] std::uint32_t beaconers() const noexcept { return beaconers_; }
  [[nodiscard]] std::uint64_t session() const noexcept { return session_; }
  [[nodiscard]] std::uint16_t master() const noexcept { return part_.master; }  // kNobody while searching
  [[nodiscard]] std::uint8_t hop() const noexcept { return part_.hop; }         // 0: leads
  [[nodiscard]] bool dissolving() const noexcept { return part_.dissolving; }
  [[nodiscard]] std::uint32_t number() const noexcept { return number_; }  // superframe in progress
  // More than one beacon has confirmed the session.
  [[nodiscard]] bool proven() const noexcept { return proven_; }
  // Superframes since the master sent what this node knows.
  [[nodiscard]] std::uint32_t age(std::uint32_t number) const noexcept {
    if (leads()) return 0;
    return static_cast<std::uint32_t>(std::max<std::int32_t>(since(number, fresh_), 0));
  }
  // This follower has had no news of the master for so long that the master counts as gone.
  [[nodiscard]] bool lost_master(std::uint32_t number) const noexcept {
    return part_.role == Role::kFollowing && age(number) > patience();
  }
  // The master has been gone for so long that every back-up should have taken over.
  [[nodiscard]] bool overdue(std::uint32_t number) const noexcept {
    return age(number) > patience() + beaconers_ * (beaconers_ + 4);
  }
  // The followed session is known from one beacon only, and has not been confirmed for too long: the beacon
  // may have been forged or damaged.
  [[nodiscard]] bool orphaned_after_one_beacon(std::uint32_t number) const noexcept {
    return part_.role == Role::kFollowing && !proven_ && age(number) > patience() + 2 * beaconers_;
  }
  [[nodiscard]] bool aligned(Ticks ahead) const noexcept { return ahead <= guard_ && ahead >= -guard_; }
  // The two timelines count different superframes.
  [[nodiscard]] bool far(Ticks ahead) const noexcept {
    const Ticks half(duration_.count() / 2);
    return ahead > half || ahead < -half;
  }

  // Superframes without news of the master, beyond the delay of relays, after which it counts as gone.
  static constexpr std::uint32_t kPatience = 12;

 private:
  // A beacon far from its place is outdated. But if the acting master repeats such a count several times in a
  // row, this node's own count is wrong.
  [[nodiscard]] Verdict judge_misplaced(const Beacon& beacon, Ticks ahead) noexcept {
    constexpr std::uint8_t kBelieved = 3;
    if (beacon.hop != 0 || ++part_.misplaced < kBelieved) return Verdict::kIgnore;
    part_.misplaced = 0;
    if (!leads()) return Verdict::kLeave;
    if (ahead > Ticks(0)) dissolve();
    return Verdict::kIgnore;
  }
  [[nodiscard]] Verdict judge_as_master(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept {
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
  [[nodiscard]] Verdict judge_as_follower(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept {
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
  [[nodiscard]] Verdict choose_parent(std::uint16_t source, const Beacon& beacon,
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
  void lead() noexcept {
    if (part_.role == Role::kFollowing) former_ = fresh_;
    part_ = {.role = Role::kLeading, .master = site_.id};
    proven_ = true;
  }
  // Each hop beyond the first may wait for its turn twice.
  [[nodiscard]] std::uint32_t patience_at(std::uint8_t hop) const noexcept {
    const std::uint32_t relays = hop == 0 ? 0 : std::min<std::uint32_t>(hop - 1U, kMaxBeaconers);
    return kPatience + 2 * beaconers_ * relays;
  }
  [[nodiscard]] std::uint32_t patience() const noexcept { return patience_at(part_.hop); }
  // Of a beacon with another master of this session: that master may be alive, given its path's delay, and
  // the information is newer than what was known when that master was replaced.
  [[nodiscard]] bool is_news(const Beacon& beacon) const noexcept {
    return beacon.age <= patience_at(beacon.hop) && (!former_ || since(origin_of(beacon), *former_) > 0);
  }
  // Counts better ranks that were heard recently, except the present master.
  [[nodiscard]] std::uint32_t better_ranks_alive(std::uint32_t number) const noexcept {
    const auto recent = static_cast<std::int32_t>(kPatience + 4 * beaconers_);
    std::uint32_t count = 0;
    for (std::size_t rank = 0; rank < *rank_; ++rank) {
      if (rank == rank_of_id(part_.master) || !heard_[rank]) continue;
      if (since(number, *heard_[rank]) <= recent) ++count;
    }
    return count;
  }
  // Long enough to hear a running network in spite of five lost beacons, and for each rank to hear the one
  // before.
  [[nodiscard]] Ticks listening_time() const noexcept {
    const auto rank = static_cast<std::int64_t>(rank_.value_or(0));
    return std::max(Ticks::from_us(100'000), 5 * duration_) +
           rank * std::max(Ticks::from_us(60'000), 3 * duration_);
  }

  static constexpr std::size_t kMaxBeaconers = 8;

  const Site& site_;
  Ticks duration_;
  Ticks guard_;
  std::optional<std::size_t> rank_;
  std::uint32_t beaconers_;

  struct Part {  // in the session; a change of role sets all of it
    Role role = Role::kSearching;
    std::uint16_t master = kNobody;
    std::uint16_t parent = kNobody;  // the sender whose beacons the clock filter uses
    std::uint8_t hop = 0;
    bool dissolving = false;
    std::uint8_t misplaced = 0;  // consecutive beacons of masters of this session with a wrong count
    std::size_t competitor = 0;  // rank of a competing, worse master of this session; 0: none
  } part_;
  bool proven_ = false;
  std::uint64_t session_ = 0;
  std::uint32_t number_ = 0;
  std::uint32_t fresh_ = 0;          // superframe in which the master sent what is known
  std::uint32_t parent_origin_ = 0;  // as fresh_, of what the parent reported
  // As fresh_, the latest known of former masters of this session.
  std::optional<std::uint32_t> former_;
  // Superframe in which each rank was last heard directly.
  std::array<std::optional<std::uint32_t>, kMaxBeaconers> heard_{};
  std::uint32_t competitor_until_ = 0;
  ClockTime search_start_;
  ClockTime lead_at_;
};

}  // namespace groma::mac
