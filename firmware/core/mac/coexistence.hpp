// How nodes of different timelines on one channel find each other and become one network: pure decisions on
// top of the election within a session.
//
// docs/explanation/network.md has the rules. Receive windows are narrow, so nodes of another timeline are
// heard only in scans: superframes in which this node listens all the time. Scans cost ranges. Evidence
// (frames at unexpected times, missing frames) triggers them, and pauses bound their cost.
#pragma once

#include <cstdint>
#include <optional>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/master_election.hpp"
#include "firmware/core/mac/site.hpp"
#include "firmware/core/ranging/device_time.hpp"

namespace groma::mac {

// What this node does in the superframe that begins.
enum class Duty : std::uint8_t {
  kGoOn,
  kTakeOver,     // lead from now on, and keep the present time
  kScan,         // listen for another timeline; a master still sends its own beacon
  kSilence,      // as kScan, without that beacon: two nodes that send at once do not hear each other
  kLongSilence,  // as kSilence, for two superframes: hears also what crosses their boundary
};

// Back-off between actions that cost ranges: `at_once` more follow the first one directly, then each interval
// is twice the one before. After an interval of 2^burst_log2 superframes the next is 64: a disturbance that
// lasts this long is probably not a network to merge with. The intervals end at 2^longest_log2 superframes,
// so in the long run at most that share of the superframes is lost.
class Pause {
 public:
  constexpr Pause(std::uint8_t at_once, std::uint8_t burst_log2, std::uint8_t longest_log2) noexcept
      : at_once_(at_once), burst_log2_(burst_log2), longest_log2_(longest_log2) {}
  // No action is due before superframe `number`, and the pause after that one is the first.
  constexpr void restart(std::uint32_t number) noexcept {
    next_ = number;
    times_ = 0;
  }
  // Returns true if the action is due in superframe `number`; the next pause begins then.
  [[nodiscard]] bool ends(std::uint32_t number) noexcept;

 private:
  std::uint32_t next_ = 0;
  std::uint8_t times_ = 0;
  std::uint8_t at_once_;
  std::uint8_t burst_log2_;
  std::uint8_t longest_log2_;
};

class Coexistence {
 public:
  // `election` outlives this object. `hash`: schedule_hash().
  Coexistence(const Site& site, MasterElection& election, std::uint32_t hash) noexcept;

  // Starts the search, at power-up or when the time is lost.
  // Listens for `rounds` rounds of relaying more before it starts a session.
  void search(ClockTime now, std::uint32_t rounds = 0) noexcept;
  // As MasterElection::on_traffic(), except while this node displaces a network with an older schedule.
  void on_traffic(ClockTime now) noexcept {
    if (!displaces_older_) election_.on_traffic(now);
  }
  // Starts a session, as MasterElection::found().
  void found() noexcept;

  // Judges a beacon of this network, sent by `source`. `ahead`: how far its timeline is ahead of this node's;
  // ignored while searching.
  [[nodiscard]] Verdict judge(std::uint16_t source, const Beacon& beacon, Ticks ahead,
                              ClockTime now) noexcept;
  // In a network with a key, while not searching: judges an unverified beacon of another timeline, which may
  // be a recording. This node does not join that timeline, but may send merge requests to it.
  [[nodiscard]] Verdict judge_unverified(std::uint16_t source, const Beacon& beacon) noexcept;
  // In a network with a key, while not searching: judges a verified merge request.
  [[nodiscard]] Verdict judge_merge_request(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept;

  // Reports a frame of this network that does not fit the timeline: another session may be near.
  void suspect() noexcept { suspected_ = election_.number(); }
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
  // The present kScan is for all nodes of the session: the master's beacon says so.
  [[nodiscard]] bool quiet() const noexcept { return quiet_; }
  // No node is heard: the others may keep radio silence on purpose.
  void on_silence() noexcept;
  // Keeps radio silence from the next superframe to `until`, while merge requests are sent to another
  // session.
  void keep_silence(std::uint32_t until) noexcept;
  // Call when a relayed beacon is sent. Returns true if the beacon requests radio silence from the master for
  // the next two superframes, in which this node listens too.
  [[nodiscard]] bool ask_for_silence() noexcept;
  // Call after a beacon of this master was sent. Returns true if it was the last one; this node then
  // searches.
  [[nodiscard]] bool on_led(ClockTime now) noexcept;

  // This node may send a merge request in the shared slot of the other session's superframe `number`.
  [[nodiscard]] bool may_request_merge(std::uint32_t number) const noexcept;

 private:
  void restart_pauses(std::uint32_t number) noexcept;
  void follow(std::uint16_t source, const Beacon& beacon) noexcept;
  // Its session has dissolved: starts to search for the other session. `number`: of its last beacon.
  void leave_session(ClockTime now, std::uint32_t number) noexcept;
  [[nodiscard]] bool of_this_schedule(const Beacon& beacon) const noexcept;
  [[nodiscard]] bool gives_way(const Beacon& beacon, Ticks ahead) const noexcept;
  [[nodiscard]] Verdict judge_schedule(const Beacon& beacon, ClockTime now) noexcept;
  [[nodiscard]] Verdict judge_other_session(std::uint16_t source, const Beacon& beacon, Ticks ahead) noexcept;
  [[nodiscard]] Verdict judge_own_session(std::uint16_t source, const Beacon& beacon, Ticks ahead,
                                          ClockTime now) noexcept;
  // `may`: this node is entitled to send merge requests.
  [[nodiscard]] Verdict request_merge(bool may) noexcept;
  void watch_place(const Beacon& beacon) noexcept;
  [[nodiscard]] bool begin_scan(std::uint32_t number, bool may_scan) noexcept;

  const Site& site_;
  MasterElection& election_;
  std::uint32_t hash_;

  // Evidence of another timeline.
  std::optional<std::uint32_t> suspected_;  // superframe of the last frame that does not fit
  std::uint8_t unverified_polls_ = 0;       // superframes for which the report counts
  bool lacking_ = false;
  bool idle_ = false;

  // The pauses. Of two networks that scan for each other, each master sends its beacon in a superframe with a
  // probability of 1 - 5/8 * 3/4 = 0.53 (scan_duty()), so that n scans miss the other one in 0.47^n of cases.
  //
  // A frame at an unexpected time is strong evidence. Five scans in a row miss in 2 % of cases; in the long
  // run a disturbance costs 1 of 32 superframes.
  Pause scans_{4, 5, 5};
  // Anybody can send a POLL with a wrong MIC: five scans within 9 superframes, and in the long run 1 of 256.
  Pause unverified_scans_{2, 2, 8};
  // Frames are mostly missing because a node is off or has no LOS, and a scan costs more of them: four scans
  // within 8 superframes, which miss in 5 % of cases, and in the long run 1 of 256.
  Pause lacks_{1, 2, 8};
  // No frame came, so a scan costs only the chance to hear the own network again: three of four superframes
  // remain for that.
  Pause idles_{0, 2, 2};
  // Each request costs the session up to two rounds of radio silence. In an open network the beacon shows
  // that the other session is there: five in a row, because frames of other nodes may collide with each, then
  // rarely, because the other session may be unable to hear this one. In a network with a key the beacon may
  // be a recording, so the request is repeated as rarely as the scans of lacks_.
  Pause merge_requests_;
  // The others' radio silence lasts for up to two rounds. A tag that hears nobody is silent for three of four
  // superframes, then for 1 of 64 and fewer, because mostly nobody is there.
  Pause silences_{1, 1, 8};

  std::uint32_t silent_left_ = 0;  // superframes
  bool quiet_ = false;
  std::uint32_t led_ = 0;  // superframe of its last beacon as master
  // The master whose last beacon came in a shared slot, and when.
  std::uint16_t displaced_ = kNobody;
  std::uint32_t displaced_at_ = 0;
  bool asks_for_silence_ = false;
  bool listens_next_ = false;

  // Another schedule.
  std::uint32_t newer_schedule_ = 0;  // fingerprint of the newer schedule in the last beacon that had one
  std::uint32_t older_schedule_ = 0;
  bool displaces_older_ = false;  // while searching: a network with an older schedule is near
  ClockTime stale_until_;         // starts no session until then: a newer schedule is near

  // The session that this node has left.
  std::uint64_t avoided_ = 0;
  std::uint16_t avoided_master_ = kNobody;
  std::uint32_t avoided_at_ = 0;  // superframe of its master's last beacon
  ClockTime avoided_until_;
};

}  // namespace groma::mac
