// How nodes of different timelines on one channel find each other and become one network: pure decisions on
// top of the election within a session.
//
// docs/explanation/network.md has the rules. Receive windows are narrow, so nodes of another timeline are
// heard only in scans: superframes in which this node listens all the time. Scans cost ranges. Evidence
// (frames at unexpected times, missing frames) triggers them, and pauses bound their cost.
#pragma once

#include <algorithm>
#include <cstdint>
#include <optional>
#include <utility>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/hash.hpp"
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
  [[nodiscard]] bool ends(std::uint32_t number) noexcept {
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
  Coexistence(const Site& site, MasterElection& election, std::uint32_t hash) noexcept
      : site_(site),
        election_(election),
        hash_(hash),
        merge_requests_(site.network_key.empty() ? Pause(4, 8, 8) : Pause(1, 2, 8)) {}

  // Starts the search, at power-up or when the time is lost. `rounds` as MasterElection::search().
  void search(ClockTime now, std::uint32_t rounds = 0) noexcept {
    suspected_.reset();
    lacking_ = displaces_older_ = false;
    unverified_polls_ = 0;
    silent_left_ = 0;
    election_.search(now, stale_until_, rounds);
  }
  // As MasterElection::on_traffic(), except while this node displaces a network with an older schedule.
  void on_traffic(ClockTime now) noexcept {
    if (!displaces_older_) election_.on_traffic(now);
  }
  // Starts a session, as MasterElection::found().
  void found() noexcept {
    election_.found();
    restart_pauses(0);
  }

  // Judges a beacon of this network, sent by `source`. `ahead`: how far its timeline is ahead of this node's;
  // ignored while searching.
  [[nodiscard]] Verdict judge(std::uint16_t source, const Beacon& beacon, Ticks ahead,
                              ClockTime now) noexcept {
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
  // In a network with a key, while not searching: judges an unverified beacon of another timeline, which may
  // be a recording. This node does not join that timeline, but may send merge requests to it.
  [[nodiscard]] Verdict judge_unverified(std::uint16_t source, const Beacon& beacon) noexcept {
    return request_merge(of_this_schedule(beacon) && election_.is_credible(source, beacon));
  }
  // In a network with a key, while not searching: judges a verified merge request. Aligned parts of one
  // session: judge() decides by rank. Parts that have drifted apart: the one ahead stays, so that no count
  // goes back.
  [[nodiscard]] Verdict judge_merge_request(std::uint16_t source, const Beacon& beacon,
                                            Ticks ahead) noexcept {
    if (!election_.is_credible(source, beacon)) return Verdict::kStale;
    if (beacon.session == election_.session() && election_.aligned(ahead)) return Verdict::kIgnore;
    if (gives_way(beacon, ahead)) {
      follow(source, beacon);
      return Verdict::kAdopt;
    }
    return silent_left_ != 0 ? Verdict::kIgnore : Verdict::kRequestMerge;
  }

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
  //
  // All nodes of a session scan in the same superframes, so that they do not drown out what they listen for.
  // A master mostly omits its beacon then, because two nodes that send at once do not hear each other. Scans
  // are random, because two sessions that scan at once do not hear each other either.
  [[nodiscard]] Duty begin(std::uint32_t number) noexcept {
    if (election_.begin(number)) return Duty::kTakeOver;
    if (election_.overdue(number)) lacking_ = true;
    if (election_.dissolving()) return Duty::kGoOn;
    quiet_ = silent_left_ != 0;
    const std::uint32_t chance =
        chance_of(election_.session() ^ std::uint64_t{election_.master()} << 32, number);
    const bool may_scan = chance % 8 < 5;
    // This node hears no beacon of its network, does not poll, is not polled, and can never lead: a scan
    // costs nothing.
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
  // The present kScan is for all nodes of the session: the master's beacon says so.
  [[nodiscard]] bool quiet() const noexcept { return quiet_; }
  // No node is heard: the others may keep radio silence on purpose.
  void on_silence() noexcept {
    if (silences_.ends(election_.number())) silent_left_ = std::max(silent_left_, std::uint32_t{1});
  }
  // Keeps radio silence from the next superframe to `until`, while merge requests are sent to another
  // session.
  void keep_silence(std::uint32_t until) noexcept {
    const auto most = static_cast<std::int32_t>(2 * election_.beaconers() + 1);
    silent_left_ =
        static_cast<std::uint32_t>(std::clamp<std::int32_t>(since(until, election_.number()), 0, most));
  }
  // Call when a relayed beacon is sent. Returns true if the beacon requests radio silence from the master for
  // the next two superframes, in which this node listens too.
  [[nodiscard]] bool ask_for_silence() noexcept {
    listens_next_ = !election_.leads() && std::exchange(asks_for_silence_, false);
    return listens_next_;
  }
  // Call after a beacon of this master was sent. Returns true if it was the last one; this node then
  // searches.
  [[nodiscard]] bool on_led(ClockTime now) noexcept {
    led_ = election_.number();
    if (!election_.dissolving()) return false;
    leave_session(now, led_);
    return true;
  }

  // This node may send a merge request in the shared slot of the other session's superframe `number`.
  // A rank exists once in a site, so its turn is free in the other session.
  [[nodiscard]] bool may_request_merge(std::uint32_t number) const noexcept {
    if (!election_.rank() || election_.dissolving()) return false;
    const bool open = election_.turn(number) == 0;
    if (election_.leads() && (open || *election_.rank() == 0)) return open;
    return election_.owns_turn(number);
  }

 private:
  // Superframes in which the nodes of a new session do not scan for missing frames.
  static constexpr std::uint32_t kSettling = 16;
  // For this time after a beacon with a newer schedule a node starts no session, and for this time after it
  // left a session it does not return: in superframes of 20 ms a hundred, more than the pauses between scans_
  // and twelve rounds of relaying by seven back-ups take.
  static constexpr Ticks kQuiet = Ticks::from_us(2'000'000);

  // Equal at all nodes of a session, different in each superframe and session.
  [[nodiscard]] static std::uint32_t chance_of(std::uint64_t session, std::uint32_t number) noexcept {
    return mix(static_cast<std::uint32_t>(session >> 32) * 0x9E37'79B9U ^
               static_cast<std::uint32_t>(session) * 0x85EB'CA6BU ^ number) >>
           16;
  }
  void restart_pauses(std::uint32_t number) noexcept {
    for (Pause* pause : {&scans_, &unverified_scans_, &merge_requests_, &silences_}) pause->restart(number);
    for (Pause* pause : {&lacks_, &idles_}) pause->restart(number + kSettling);
  }
  void follow(std::uint16_t source, const Beacon& beacon) noexcept {
    if (election_.role() == Role::kSearching || election_.session() != beacon.session) {
      silent_left_ = 0;
      restart_pauses(beacon.superframe);
    }
    suspected_.reset();
    election_.follow(source, beacon);
  }
  // Its session has dissolved: starts to search for the other session. `number`: of its last beacon.
  void leave_session(ClockTime now, std::uint32_t number) noexcept {
    // The next relay of the other session may be two rounds away, and more if it is the schedule's master,
    // which has only every second turn of another rank.
    constexpr std::uint32_t kRounds = 4;
    avoided_ = election_.session();
    avoided_master_ = election_.master();
    avoided_at_ = number;
    avoided_until_ = now + kQuiet;
    search(now, kRounds);
  }
  [[nodiscard]] bool of_this_schedule(const Beacon& beacon) const noexcept {
    return beacon.epoch == site_.schedule->epoch && beacon.schedule_hash == hash_;
  }
  // This node's session gives way to the beacon's session.
  [[nodiscard]] bool gives_way(const Beacon& beacon, Ticks ahead) const noexcept {
    const bool older = election_.aligned(ahead) ? beacon.session < election_.session() : ahead > Ticks(0);
    return older || election_.lost_master(election_.number());
  }
  // Nodes with two different schedules would collide. The newer schedule wins: a node with the older one
  // stops transmitting, and a node with the newer one informs the others.
  [[nodiscard]] Verdict judge_schedule(const Beacon& beacon, ClockTime now) noexcept {
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
  [[nodiscard]] Verdict judge_other_session(std::uint16_t source, const Beacon& beacon,
                                            Ticks ahead) noexcept {
    if (!gives_way(beacon, ahead)) return request_merge(election_.proven() && !election_.dissolving());
    if (election_.leads()) {
      election_.dissolve();
      return Verdict::kIgnore;
    }
    follow(source, beacon);
    return Verdict::kAdopt;
  }
  [[nodiscard]] Verdict judge_own_session(std::uint16_t source, const Beacon& beacon, Ticks ahead,
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
  // `may`: this node is entitled to send merge requests.
  [[nodiscard]] Verdict request_merge(bool may) noexcept {
    const bool due = may && silent_left_ == 0 && merge_requests_.ends(election_.number());
    return due ? Verdict::kRequestMerge : Verdict::kIgnore;
  }
  // If the master is heard in successive shared slots but never in the beacon slot, beacons of another
  // session may collide with its own. They can be heard only while the master is silent.
  void watch_place(const Beacon& beacon) noexcept {
    const auto recent = static_cast<std::int32_t>(4 * election_.beaconers());
    asks_for_silence_ =
        beacon.shared && beacon.master == displaced_ && since(beacon.superframe, displaced_at_) <= recent;
    displaced_ = beacon.shared ? beacon.master : kNobody;
    displaced_at_ = beacon.superframe;
  }
  // Returns true, and begins the pause that follows, if the evidence requires a scan.
  [[nodiscard]] bool begin_scan(std::uint32_t number, bool may_scan) noexcept {
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
