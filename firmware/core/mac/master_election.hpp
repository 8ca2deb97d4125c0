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
#include <optional>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/site.hpp"
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
  MasterElection(const Site& site, Ticks duration, Ticks guard) noexcept;

  // Starts the search, at power-up or when the time is lost. Starts no session before `not_before`, and
  // listens for `rounds` rounds of relaying more.
  void search(ClockTime now, ClockTime not_before, std::uint32_t rounds) noexcept;
  void start_not_before(ClockTime time) noexcept { lead_at_ = std::max(lead_at_, time); }
  // While searching, reports a frame of this network that is not a beacon. Another node is there, so this one
  // waits longer before it leads.
  void on_traffic(ClockTime now) noexcept;
  // While searching: when to start a session if no node has been heard until then; nothing: never.
  [[nodiscard]] std::optional<ClockTime> lead_at() const noexcept;
  // Starts a session: leads, from superframe 0 on.
  void found() noexcept;
  // Follows the beacon's master, by the path of `source`.
  void follow(std::uint16_t source, const Beacon& beacon) noexcept;
  // Marks the next beacon of this master as its last one.
  void dissolve() noexcept { part_.dissolving = true; }

  // Only anchors with a rank send beacons, and a master's own beacon is as old as its hop count.
  [[nodiscard]] bool is_credible(std::uint16_t source, const Beacon& beacon) const noexcept;
  // Judges a credible beacon of this session, sent by `source`. `ahead`: how far its timeline is ahead of
  // this node's. After kLeave this node has to search.
  [[nodiscard]] Verdict judge(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept;

  // While not searching: superframe `number` begins. `number` increases from call to call. Returns true if
  // this node leads from now on and keeps the present time.
  [[nodiscard]] bool begin(std::uint32_t number) noexcept;
  // The radio was off: the knowledge of an acting master may be outdated.
  void on_absence(std::uint32_t number) noexcept;
  // Whose turn the shared slot of superframe `number` is: 0: open to all; n: of the back-up of rank n.
  [[nodiscard]] std::uint32_t turn(std::uint32_t number) const noexcept { return number % beaconers_; }
  // The turns of a rank are even and odd alternately.
  [[nodiscard]] bool even(std::uint32_t number) const noexcept { return number / beaconers_ % 2 == 0; }
  // The turn is this node's.
  [[nodiscard]] bool owns_turn(std::uint32_t number) const noexcept;
  // This node sends a beacon in the shared slot of superframe `number`.
  [[nodiscard]] bool has_shared_turn(std::uint32_t number) const noexcept;
  // In superframe `number` a beacon of the followed path is due, in the shared slot or in the beacon slot.
  [[nodiscard]] bool parent_due(std::uint32_t number, bool shared) const noexcept;

  [[nodiscard]] Role role() const noexcept { return part_.role; }
  [[nodiscard]] bool leads() const noexcept { return part_.role == Role::kLeading; }
  [[nodiscard]] std::optional<std::size_t> rank() const noexcept { return rank_; }
  // beaconers() if it has none.
  [[nodiscard]] std::size_t rank_of_id(std::uint16_t id) const noexcept;
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
  [[nodiscard]] std::uint32_t age(std::uint32_t number) const noexcept;
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
  [[nodiscard]] Verdict judge_misplaced(const Beacon& beacon, Ticks ahead) noexcept;
  [[nodiscard]] Verdict judge_as_master(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept;
  [[nodiscard]] Verdict judge_as_follower(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept;
  [[nodiscard]] Verdict choose_parent(std::uint16_t source, const Beacon& beacon,
                                      std::int32_t newer) noexcept;
  void lead() noexcept;
  [[nodiscard]] std::uint32_t patience_at(std::uint8_t hop) const noexcept;
  [[nodiscard]] std::uint32_t patience() const noexcept { return patience_at(part_.hop); }
  [[nodiscard]] bool is_news(const Beacon& beacon) const noexcept;
  [[nodiscard]] std::uint32_t better_ranks_alive(std::uint32_t number) const noexcept;
  [[nodiscard]] Ticks listening_time() const noexcept;

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
