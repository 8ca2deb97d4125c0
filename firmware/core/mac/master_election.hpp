// Master election and the choice of the path that this node follows: pure decisions, without radio and clock
// filter.
//
//   searching --beacon--> following --master silent for long, and next in rank--> leading
//       ^  \--no node heard for long, and ranked--> leading (a new session)          |
//       |                                                                            |
//       +-------- dissolved, or a newer schedule heard ------------------------------+
//
// A session is a count of superframes that some node started; it continues under changing masters. Its id is
// unique. Of two masters of one session the better rank stays. Of two sessions the older one stays, by its
// count; within the guard, the one with the smaller id. The losing master marks its last beacon `dissolving`,
// so that its nodes join the other session. If the losing session does not know of the other one, a node that
// hears its beacon sends a merge request in the slot where its nodes listen.
//
// The content of a beacon left the master `age` superframes ago. A relay passes the age on and cannot reduce
// it, so relays cannot keep a dead master alive among themselves.
#pragma once

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

// What this node does in the superframe that begins.
enum class Duty : std::uint8_t {
  kGoOn,
  kTakeOver,     // lead from now on, and keep the present time
  kScan,         // listen for another timeline; a master still sends its own beacon
  kSilence,      // as kScan, without that beacon: two nodes that send at once do not hear each other
  kLongSilence,  // as kSilence, for two superframes: hears also what crosses their boundary
};

class MasterElection {
 public:
  // `duration`: of a superframe. `hash`: schedule_hash(). `guard`: timelines that differ by less count as
  // aligned.
  MasterElection(const Site& site, ranging::Ticks duration, ranging::Ticks guard,
                 std::uint32_t hash) noexcept;

  // Starts the search, at power-up or when the time is lost.
  void search(ranging::ClockTime now) noexcept;
  // While searching, reports a frame of this network that is not a beacon. Another node is there, so this one
  // waits longer before it leads.
  void on_traffic(ranging::ClockTime now) noexcept;
  // While searching: when to start a session if no node has been heard until then; nothing: never.
  [[nodiscard]] std::optional<ranging::ClockTime> lead_at() const noexcept;
  // Starts a session: leads, from superframe 0 on.
  void found() noexcept;

  // Judges a beacon of this network, sent by `source`. `ahead`: how far its timeline is ahead of this node's;
  // ignored while searching.
  [[nodiscard]] Verdict judge(std::uint16_t source, const Beacon& beacon, ranging::Ticks ahead,
                              ranging::ClockTime now) noexcept;
  // In a network with a key, while not searching: judges an unverified beacon of another timeline, which may
  // be a recording. This node does not join that timeline, but may send merge requests to it.
  [[nodiscard]] Verdict judge_unverified(std::uint16_t source, const Beacon& beacon) noexcept;
  // In a network with a key, while not searching: judges a verified merge request.
  [[nodiscard]] Verdict judge_merge_request(std::uint16_t source, const Beacon& beacon,
                                            ranging::Ticks ahead) noexcept;
  // Reports a frame of this network that does not fit the timeline: another session may be near.
  void suspect() noexcept {
    suspicious_ = true;
    suspected_ = number_;
  }
  // In a network with a key: reports an unverified POLL, one that does not fit the timeline and whose MIC is
  // wrong. It may belong to another session.
  void on_unverified_poll() noexcept { unverified_polls_ = 2; }
  // Reports whether expected frames are missing; holds until the next report. `idle`: no frame came at all,
  // so a scan would disturb nothing.
  void on_lack(bool lacking, bool idle) noexcept {
    lacking_ = lacking;
    idle_ = idle;
  }

  [[nodiscard]] bool lacking() const noexcept { return lacking_; }

  // While not searching: superframe `number` begins. `number` increases from call to call.
  [[nodiscard]] Duty begin(std::uint32_t number) noexcept;
  // No node is heard: the others may keep radio silence on purpose.
  void on_silence() noexcept;
  // Keeps radio silence from the next superframe to `until`, while merge requests are sent to another
  // session.
  void keep_silence(std::uint32_t until) noexcept;
  // The present kScan is for all nodes of the session: the master's beacon says so.
  [[nodiscard]] bool quiet() const noexcept { return quiet_; }
  // The followed session is known from one beacon only, and has not been confirmed for too long: the beacon
  // may have been forged or damaged.
  [[nodiscard]] bool orphaned_after_one_beacon(std::uint32_t number) const noexcept;
  // This node may send a merge request in the shared slot of the other session's superframe `number`.
  [[nodiscard]] bool may_request_merge(std::uint32_t number) const noexcept;
  // This node may do so in superframe `number` or one of the `more` that follow.
  [[nodiscard]] bool may_request_merge_within(std::uint32_t number, std::uint32_t more) const noexcept {
    for (std::uint32_t i = 0; i <= more; ++i) {
      if (may_request_merge(number + i)) return true;
    }
    return false;
  }
  // Call when a relayed beacon is sent. Returns true if the beacon requests radio silence from the master for
  // the next two superframes, in which this node listens too.
  [[nodiscard]] bool ask_for_silence() noexcept;
  // The radio was off: the knowledge of an acting master may be outdated.
  void on_absence(std::uint32_t number) noexcept;
  // This node sends a beacon in the shared slot of superframe `number`.
  [[nodiscard]] bool has_shared_turn(std::uint32_t number) const noexcept;
  // Call after a beacon of this master was sent. Returns true if it was the last one; this node then
  // searches.
  [[nodiscard]] bool on_led(ranging::ClockTime now) noexcept;

  [[nodiscard]] Role role() const noexcept { return role_; }
  [[nodiscard]] bool leads() const noexcept { return role_ == Role::kLeading; }
  [[nodiscard]] std::optional<std::size_t> rank() const noexcept { return rank_; }
  [[nodiscard]] std::uint64_t session() const noexcept { return session_; }
  [[nodiscard]] std::uint16_t master() const noexcept { return master_; }  // kNobody while searching
  [[nodiscard]] std::uint8_t hop() const noexcept { return hop_; }         // 0: leads
  [[nodiscard]] bool dissolving() const noexcept { return last_beacons_ != 0; }
  // Superframes since the master sent what this node knows.
  [[nodiscard]] std::uint32_t age(std::uint32_t number) const noexcept;
  // In superframe `number` a beacon of the followed path is due, in the shared slot or in the beacon slot.
  [[nodiscard]] bool parent_due(std::uint32_t number, bool shared) const noexcept;

  // Superframes without news of the master, beyond the delay of relays, after which it counts as gone.
  static constexpr std::uint32_t kPatience = 12;

 private:
  [[nodiscard]] Verdict judge_schedule(const Beacon& beacon, ranging::ClockTime now) noexcept;
  [[nodiscard]] bool is_credible(std::uint16_t source, const Beacon& beacon) const noexcept;
  [[nodiscard]] bool gives_way(const Beacon& beacon, ranging::Ticks ahead) const noexcept;
  [[nodiscard]] Verdict judge_misplaced(const Beacon& beacon, ranging::Ticks ahead,
                                        ranging::ClockTime now) noexcept;
  [[nodiscard]] Verdict request_merge() noexcept;
  [[nodiscard]] Verdict judge_other_session(std::uint16_t source, const Beacon& beacon,
                                            ranging::Ticks ahead) noexcept;
  [[nodiscard]] Verdict judge_as_master(std::uint16_t source, const Beacon& beacon,
                                        ranging::Ticks ahead) noexcept;
  [[nodiscard]] Verdict judge_as_follower(std::uint16_t source, const Beacon& beacon,
                                          ranging::Ticks ahead) noexcept;
  void watch_place(const Beacon& beacon) noexcept;
  void follow(std::uint16_t source, const Beacon& beacon) noexcept;
  void lead() noexcept;
  void dissolve() noexcept;
  // Its session has dissolved: starts to search for the other session.
  void leave_session(ranging::ClockTime now) noexcept;
  [[nodiscard]] bool is_avoided(const Beacon& beacon, ranging::ClockTime now) const noexcept;
  [[nodiscard]] std::size_t rank_of_id(std::uint16_t id) const noexcept;  // beaconers_ if it has none
  [[nodiscard]] std::uint32_t patience_at(std::uint8_t hop) const noexcept;
  [[nodiscard]] std::uint32_t patience() const noexcept { return patience_at(hop_); }
  [[nodiscard]] bool is_news(const Beacon& beacon) const noexcept;
  [[nodiscard]] Duty scan_duty(std::uint32_t number) noexcept;
  // This node hears no beacon of its network, does not poll, is not polled, and can never lead: a scan costs
  // nothing.
  [[nodiscard]] bool orphaned(std::uint32_t number) const noexcept {
    return role_ == Role::kFollowing && !rank_ && idle_ && age(number) > kPatience;
  }
  [[nodiscard]] std::uint32_t better_ranks_alive(std::uint32_t number) const noexcept;
  [[nodiscard]] ranging::Ticks listening_time() const noexcept;
  // There is an unused session id for found().
  [[nodiscard]] bool has_session_id() const noexcept;

  static constexpr std::size_t kMaxBeaconers = 8;

  // Back-off between actions that cost ranges: the first `at_once` follow directly, then each interval is
  // twice the one before. After an interval of 2^burst_log2 superframes the next is 64: a disturbance that
  // lasts this long is probably not a network to merge with.
  class Pause {
   public:
    constexpr Pause(std::uint8_t at_once, std::uint8_t burst_log2, std::uint8_t longest_log2) noexcept
        : at_once_(at_once), burst_log2_(burst_log2), longest_log2_(longest_log2) {}
    void restart(std::uint32_t number) noexcept;
    [[nodiscard]] bool over(std::uint32_t number) const noexcept;
    void begin(std::uint32_t number) noexcept;

   private:
    std::uint32_t next_ = 0;
    std::uint8_t times_ = 0;
    std::uint8_t at_once_;
    std::uint8_t burst_log2_;
    std::uint8_t longest_log2_;
  };

  const Site& site_;
  ranging::Ticks duration_;
  ranging::Ticks guard_;
  std::uint32_t hash_;
  std::optional<std::size_t> rank_;
  std::uint32_t beaconers_;

  Role role_ = Role::kSearching;
  std::uint8_t last_beacons_ = 0;  // still to be sent by a master that resigns
  bool suspicious_ = false;
  std::uint32_t suspected_ = 0;        // superframe
  std::uint8_t unverified_polls_ = 0;  // superframes for which the report counts
  bool lacking_ = false;
  bool idle_ = false;
  std::uint8_t hop_ = 0;
  std::uint16_t master_ = kNobody;
  std::uint16_t parent_ = kNobody;   // the sender whose beacons the clock filter uses
  std::uint32_t number_ = 0;         // superframe in progress
  std::uint32_t fresh_ = 0;          // superframe in which the master sent what is known
  std::uint32_t parent_origin_ = 0;  // as fresh_, of what the parent reported
  // As fresh_, the latest known of former masters of this session.
  std::optional<std::uint32_t> former_;
  std::uint64_t session_ = 0;
  bool proven_ = false;         // more than one beacon has confirmed the session
  std::uint8_t misplaced_ = 0;  // consecutive beacons of masters of this session with a wrong count
  // Superframe in which each rank was last heard directly.
  std::array<std::optional<std::uint32_t>, kMaxBeaconers> heard_{};
  std::size_t competitor_ = 0;  // rank of a competing, worse master of this session; 0: none
  std::uint32_t competitor_until_ = 0;
  Pause scans_{4, 5, 5};
  Pause unverified_scans_{2, 2, 8};
  Pause lacks_{1, 2, 8};
  Pause idles_{0, 2, 2};
  Pause merge_requests_;
  Pause silences_{1, 1, 8};
  std::uint32_t silent_left_ = 0;  // superframes
  bool quiet_ = false;
  // The master whose last beacon came in a shared slot, and when.
  std::uint16_t displaced_ = kNobody;
  std::uint32_t displaced_at_ = 0;
  bool asks_for_silence_ = false;
  bool listens_next_ = false;
  std::uint32_t led_ = 0;             // superframe of its last beacon as master
  std::uint32_t newer_schedule_ = 0;  // fingerprint of the newer schedule in the last beacon that had one
  std::uint32_t older_schedule_ = 0;
  bool displaces_older_ = false;    // while searching: a network with an older schedule is near
  ranging::ClockTime stale_until_;  // starts no session until then: a newer schedule is near

  ranging::ClockTime search_start_;
  ranging::ClockTime lead_at_;
  std::uint64_t avoided_ = 0;  // session
  std::uint16_t avoided_master_ = kNobody;
  std::uint32_t avoided_at_ = 0;  // superframe of its master's last beacon
  ranging::ClockTime avoided_until_;
};

}  // namespace groma::mac
