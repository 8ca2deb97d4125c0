// Who leads the network, and by which path this node follows: pure decisions, no radio and no clock filter.
//
//   searching --beacon--> following --nothing of the master for long, and next in rank--> leading
//       ^  \--nobody heard for long, and in the ranks--> leading (a new session)             |
//       |                                                                                    |
//       +-------- dissolved, or a newer schedule heard ---------------------------------------+
//
// A session is a count of superframes that somebody began; it goes on under whoever leads it. Its name is
// unique. Of two masters of one session the better rank stays. Of two sessions the older one stays, by its
// count; within the guard the smaller name. The loser says so in its last beacon
// (`dissolving`), so that its nodes come over. A loser that does not know of it is told: who has heard its
// beacon sends an `invitation` where its nodes listen.
//
// What a beacon tells left the master `age` superframes ago: a relay can pass it on but not make it younger,
// so that relays cannot keep a dead master alive among each other.
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

// What a beacon is to this node.
enum class Verdict : std::uint8_t {
  kIgnore,   // of no use
  kStale,    // of another schedule
  kKnown,    // of the network followed, but by another path than the clock filter's
  kMeasure,  // a stamp for the clock filter
  kSwitch,   // the same, the first by another path
  kAdopt,    // from now on this timeline is followed: the clock filter starts with it
  kLeave,    // fall silent and search
  kCall,     // of another session, which is to come over or to fall silent: its nodes are to be told
};

// What to do in a superframe that begins.
enum class Duty : std::uint8_t {
  kGoOn,
  kTakeOver,  // lead from now on, with the time as it is known
  kScan,      // listen for another timeline; a master's own beacon still goes out
  kHush,      // the same, without it: two that send at one time do not hear each other
  kHushLong,  // the same, for two superframes: what lies over their border is heard, too
};

class Mastership {
 public:
  // `duration`: of a superframe. `hash`: schedule_hash(). `guard`: two timelines that differ by less are one.
  Mastership(const Site& site, ranging::Ticks duration, ranging::Ticks guard, std::uint32_t hash) noexcept;

  // Begins to search, at start or when the time is lost.
  void search(ranging::ClockTime now) noexcept;
  // While searching: a frame of this network that is no beacon. Somebody is there; it is not yet time to
  // lead.
  void on_traffic(ranging::ClockTime now) noexcept;
  // While searching: when to found a session where nobody is heard until then; nothing: never.
  [[nodiscard]] std::optional<ranging::ClockTime> lead_at() const noexcept;
  // Founds a session: leads, from superframe 0 on.
  void found() noexcept;

  // A beacon of this network, sent by `source`. `ahead`: by how much its timeline is ahead of this node's;
  // of no meaning while searching.
  [[nodiscard]] Verdict judge(std::uint16_t source, const Beacon& beacon, ranging::Ticks ahead,
                              ranging::ClockTime now) noexcept;
  // In a network with a key, while not searching: a beacon of another timeline, said now or long ago. Nobody
  // goes over; but if it is of now, its nodes are to be told of this timeline.
  [[nodiscard]] Verdict judge_hearsay(std::uint16_t source, const Beacon& beacon) noexcept;
  // The same: a call, from a timeline that is there.
  [[nodiscard]] Verdict judge_call(std::uint16_t source, const Beacon& beacon, ranging::Ticks ahead) noexcept;
  // A frame of this network that has no place in the timeline, or frames that should have come did not: there
  // may be another one.
  void suspect() noexcept {
    suspicious_ = true;
    suspected_ = number_;
  }
  // In a network with a key: a frame that has no place and whose code does not fit. Of another session, or of
  // nobody.
  void on_rumour() noexcept { rumoured_ = 2; }
  // Frames that should have come did not: until the contrary is told. `idle`: none came, so that there is
  // nothing that a scan could disturb.
  void on_lack(bool lacking, bool idle) noexcept {
    lacking_ = lacking;
    idle_ = idle;
  }

  [[nodiscard]] bool lacking() const noexcept { return lacking_; }

  // Not while searching: superframe `number` begins, the one after the last one asked for or a later one.
  [[nodiscard]] Duty begin(std::uint32_t number) noexcept;
  // The others may be quiet for a reason.
  void on_silence() noexcept;
  // To be quiet from the next superframe on, up to `until`: another session is called over.
  void hush(std::uint32_t until) noexcept;
  // The superframe's kScan is for all of the session: the master's beacon says so.
  [[nodiscard]] bool quiet() const noexcept { return quiet_; }
  // What this node follows has been told by one beacon alone, and by none for so long that it may have been
  // anybody's.
  [[nodiscard]] bool forsaken_at_once(std::uint32_t number) const noexcept;
  // This node may call a session over in the shared slot of that one's superframe `number`.
  [[nodiscard]] bool may_invite(std::uint32_t number) const noexcept;
  // In that one or one of the next so many.
  [[nodiscard]] bool may_invite_within(std::uint32_t number, std::uint32_t more) const noexcept {
    for (std::uint32_t i = 0; i <= more; ++i) {
      if (may_invite(number + i)) return true;
    }
    return false;
  }
  // A relay's beacon leaves: true where it asks the master to be silent in the next two superframes and to
  // listen, as this node will.
  [[nodiscard]] bool ask_for_silence() noexcept;
  // The radio was off: what this node knew last as a master may be old.
  void on_absence(std::uint32_t number) noexcept;
  // This node sends a beacon in the shared slot of superframe `number`.
  [[nodiscard]] bool has_shared_turn(std::uint32_t number) const noexcept;
  // A beacon of its own has left: true where that was the last one, and it searches.
  [[nodiscard]] bool on_led(ranging::ClockTime now) noexcept;

  [[nodiscard]] Role role() const noexcept { return role_; }
  [[nodiscard]] bool leads() const noexcept { return role_ == Role::kLeading; }
  [[nodiscard]] std::optional<std::size_t> rank() const noexcept { return rank_; }
  [[nodiscard]] std::uint64_t session() const noexcept { return session_; }
  [[nodiscard]] std::uint16_t master() const noexcept { return master_; }  // kNobody while searching
  [[nodiscard]] std::uint8_t hop() const noexcept { return hop_; }         // 0: leads
  [[nodiscard]] bool dissolving() const noexcept { return last_beacons_ != 0; }
  // Superframes since what this node knows left the master.
  [[nodiscard]] std::uint32_t age(std::uint32_t number) const noexcept;
  // The beacon of the path that this node follows is due in superframe `number`, in the shared slot or not.
  [[nodiscard]] bool parent_due(std::uint32_t number, bool shared) const noexcept;

  // Superframes without word from the master, beyond what relays take, after which it counts as gone.
  static constexpr std::uint32_t kPatience = 12;

 private:
  [[nodiscard]] Verdict judge_schedule(const Beacon& beacon, ranging::ClockTime now) noexcept;
  [[nodiscard]] bool is_credible(std::uint16_t source, const Beacon& beacon) const noexcept;
  [[nodiscard]] bool gives_way(const Beacon& beacon, ranging::Ticks ahead) const noexcept;
  [[nodiscard]] Verdict judge_echo(const Beacon& beacon, ranging::Ticks ahead,
                                   ranging::ClockTime now) noexcept;
  [[nodiscard]] Verdict call_over() noexcept;
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
  // Its session has dissolved: begins to search for the one that it gave way to.
  void go_over(ranging::ClockTime now) noexcept;
  [[nodiscard]] bool is_shunned(const Beacon& beacon, ranging::ClockTime now) const noexcept;
  [[nodiscard]] std::size_t rank_of_id(std::uint16_t id) const noexcept;  // beaconers_: none
  [[nodiscard]] std::uint32_t patience_at(std::uint8_t hop) const noexcept;
  [[nodiscard]] std::uint32_t patience() const noexcept { return patience_at(hop_); }
  [[nodiscard]] bool is_news(const Beacon& beacon) const noexcept;
  [[nodiscard]] Duty scan_duty(std::uint32_t number) noexcept;
  // It hears no beacon of its network, neither polls nor is polled, and can never lead: a scan costs nothing.
  [[nodiscard]] bool orphaned(std::uint32_t number) const noexcept {
    return role_ == Role::kFollowing && !rank_ && idle_ && age(number) > kPatience;
  }
  [[nodiscard]] std::uint32_t better_ranks_alive(std::uint32_t number) const noexcept;
  [[nodiscard]] ranging::Ticks listening_time() const noexcept;

  static constexpr std::size_t kMaxBeaconers = 8;

  // Between things that cost ranges: the first few times at once, then ever longer, each twice the one
  // before. After that of 2^burst_log2 superframes it goes on at 64: what lasts so long is no network to come
  // to terms with.
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
  std::uint8_t last_beacons_ = 0;  // still to be sent by a master that gives up
  bool suspicious_ = false;
  std::uint32_t suspected_ = 0;  // superframe
  std::uint8_t rumoured_ = 0;    // superframes for which it counts
  bool lacking_ = false;
  bool idle_ = false;
  std::uint8_t hop_ = 0;
  std::uint16_t master_ = kNobody;
  std::uint16_t parent_ = kNobody;  // whose beacons the clock follows
  std::uint32_t number_ = 0;        // superframe under way
  std::uint32_t fresh_ = 0;         // superframe in which what is known left the master
  std::uint32_t parent_told_ = 0;   // the same, of what the parent told
  // The same, of the last that was known of the masters that were given up for this one, of this session.
  std::optional<std::uint32_t> former_;
  std::uint64_t session_ = 0;
  bool proven_ = false;      // more than one beacon has told of the session
  std::uint8_t echoes_ = 0;  // masters' own beacons of this session in a row that count other superframes
  // Superframe in which each rank was last heard itself, where it has been.
  std::array<std::optional<std::uint32_t>, kMaxBeaconers> heard_{};
  std::size_t rival_ = 0;  // rank of a worse master of this session; 0: none
  std::uint32_t rival_until_ = 0;
  Pause scans_{4, 5, 5};
  Pause rumours_{2, 2, 8};
  Pause lacks_{1, 2, 8};
  Pause idles_{0, 2, 2};
  Pause calls_;
  Pause silences_{1, 1, 8};
  std::uint32_t hushed_ = 0;  // superframes
  bool quiet_ = false;
  // The master whose last word came in a shared slot, and when it did.
  std::uint16_t displaced_ = kNobody;
  std::uint32_t displaced_at_ = 0;
  bool asks_for_silence_ = false;
  bool listens_next_ = false;
  std::uint32_t led_ = 0;             // superframe of its last beacon as a master
  std::uint32_t newer_schedule_ = 0;  // that the last beacon of a newer one told of
  std::uint32_t older_schedule_ = 0;
  bool drives_off_ = false;         // while searching: those who are there have an older schedule
  ranging::ClockTime stale_until_;  // founds nothing: a newer schedule is there

  ranging::ClockTime search_start_;
  ranging::ClockTime lead_at_;
  std::uint64_t shunned_ = 0;  // session
  std::uint16_t shunned_master_ = kNobody;
  std::uint32_t shunned_at_ = 0;  // superframe of its master's last beacon
  ranging::ClockTime shunned_until_;
};

}  // namespace groma::mac
