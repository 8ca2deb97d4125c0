// What a tag and an anchor have in common: their place in the site, sending and taking frames, keeping in
// step, and all of a superframe but its tag slots.
//
//   searching --beacon--> | beacon | shared | (tag slots: the machine's own) | beacon | shared | ...
//
// The machine asks control() for what is next, and hands to the station the events of what that gave. Where
// control() gives nothing, the tag slots of superframe_number() are next; end_superframe() ends them.
#pragma once

#include <array>
#include <cstdint>
#include <optional>

#include "firmware/core/mac/control_channel.hpp"
#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/freshness.hpp"
#include "firmware/core/mac/mastership.hpp"
#include "firmware/core/mac/seal.hpp"
#include "firmware/core/mac/site.hpp"
#include "firmware/core/mac/step.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/mac/synchronizer.hpp"
#include "groma.pb.h"

namespace groma::mac {

class Station {
 public:
  // What a node needs between two things to do.
  static constexpr ranging::Ticks kToGetReady = ranging::Ticks::from_us(300);

  // Counts into `counters`, which outlives it, as what the site points to.
  Station(const Site& site, groma_Counters& counters) noexcept;
  Station(const Station&) = delete;
  Station& operator=(const Station&) = delete;
  ~Station() = default;

  // Up to two, which outlive it.
  void attach(ControlChannel& channel) noexcept;

  [[nodiscard]] const Site& site() const noexcept { return site_; }
  [[nodiscard]] const groma_Schedule& schedule() const noexcept { return *site_.schedule; }
  [[nodiscard]] const Superframe& superframe() const noexcept { return superframe_; }
  [[nodiscard]] std::uint32_t hash() const noexcept { return hash_; }
  [[nodiscard]] groma_Counters& counters() noexcept { return counters_; }
  [[nodiscard]] const Synchronizer& sync() const noexcept { return sync_; }
  [[nodiscard]] const Mastership& mastership() const noexcept { return mastership_; }

  // Of this node's chip, for others to know.
  [[nodiscard]] const Health& health() const noexcept { return health_; }
  void set_health(const Health& health) noexcept { health_ = health; }

  // The network's time when this node's clock shows `local`, now or not long ago: the count of superframes
  // times their duration, and what has passed of the last, in ticks of the network's time. Nothing while
  // searching.
  [[nodiscard]] std::optional<ranging::Ticks> network_time(ranging::ClockTime local) const noexcept {
    if (sync_.state() == SyncState::kSearching) return std::nullopt;
    return sync_.network_time(local);
  }

  // ---- the superframe's course ---------------------------------------------------------------------------

  // Begins to search.
  void start(ranging::ClockTime now) noexcept;
  // The radio was stopped and is there again.
  void resume(ranging::ClockTime now) noexcept;
  // Not before `now`; nothing: the tag slots are next.
  [[nodiscard]] std::optional<Action> control(ranging::ClockTime now) noexcept;
  // The listening that control() will most likely ask for next, so that it can be armed before it is known
  // what the one under way brings; nothing where that is open.
  [[nodiscard]] std::optional<Action> control_ahead() const noexcept;
  void end_superframe() noexcept;
  // What control() gave last is under way.
  [[nodiscard]] bool in_control() const noexcept { return phase_ != Phase::kSlots; }
  // The slots come next.
  [[nodiscard]] bool before_slots() const noexcept { return phase_ == Phase::kShared; }
  // The one under way.
  [[nodiscard]] std::uint32_t superframe_number() const noexcept { return number_; }

  // The events of what control() gave. What is next comes from control() again, or is the action returned.
  void on_control_transmitted(ranging::ClockTime stamp) noexcept;
  void on_control_late() noexcept;
  [[nodiscard]] std::optional<Action> on_control_received(const Reception& reception) noexcept;
  void on_control_timeout() noexcept;

  // A frame heard in a tag slot that is none of the slot's. True: the timeline is another one now, or none;
  // go on with control().
  [[nodiscard]] bool overhear(const Frame& frame, const Reception& reception) noexcept;
  // Frames that should have come did not, or all is well. `idle`: none came, so that there is nothing that a
  // scan could disturb.
  void on_lack(bool lacking, bool idle) noexcept { mastership_.on_lack(lacking, idle); }
  // Neither a beacon nor an answer came: the others may be quiet for a reason.
  void on_silence() noexcept {
    if (sync_.state() == SyncState::kCoasting) mastership_.on_silence();
  }

  // ---- slots ---------------------------------------------------------------------------------------------

  // May poll in the slot, as far as this node knows.
  [[nodiscard]] bool may_poll(std::uint16_t tag, std::size_t slot) const noexcept;
  // Who may, kNobody where nobody may; of several the schedule's first.
  [[nodiscard]] std::uint16_t owner_of(std::size_t slot) const noexcept;
  // Where this tag may poll.
  [[nodiscard]] std::optional<std::size_t> slot_of(std::uint16_t tag) const noexcept;
  // Of each slot: kBroadcast: who has it by the schedule; kNobody: free.
  [[nodiscard]] const std::array<std::uint16_t, kMaxTags>& holders() const noexcept { return holders_; }

  // ---- frames --------------------------------------------------------------------------------------------

  // A frame of this network that is for this node or for all, or for whoever passes it on, and with the code
  // that the network's key asks for at `place`, where it was heard; what is not is counted and nothing. A
  // RESPONSE's code is left to is_genuine() with kResponseLater. With kNobodysSlot, where nobody polls, a
  // POLL whose code does not fit may be another session's.
  enum class Check : std::uint8_t { kNow, kResponseLater, kNobodysSlot };
  [[nodiscard]] std::optional<Frame> accept(const Reception& reception, Place place,
                                            Check check = Check::kNow) noexcept;
  // Its code fits, or none is asked for; counted where it does not.
  [[nodiscard]] bool is_genuine(std::span<const std::uint8_t> frame, Place place) noexcept;

  // Frames carry codes.
  [[nodiscard]] bool keyed() const noexcept { return seal_.on(); }
  // In idle time: what is heard, and said, next most likely, so that its code takes the least time then.
  // Without them, for the beacon's and the shared slot.
  void expect_heard(std::uint16_t source, FrameType type, Place place) noexcept {
    seal_.expect_received(source, type, place);
  }
  void expect_said(FrameType type, Place place) noexcept { seal_.expect_sent(site_.id, type, place); }
  void prepare_control() noexcept;
  // To be called for each frame before accept(): the check of its code begins, and goes on by itself.
  void glance(std::span<const std::uint8_t> frame, Place place) noexcept { seal_.glance(frame, place); }
  // Of the beacon's or the shared slot under way.
  [[nodiscard]] Place control_place() const noexcept {
    return {number_, phase_ == Phase::kShared ? Place::kShared : Place::kBeacon};
  }

  // `place`: of a tag slot's frame; the others tell it by their kind. Its code is put in by complete().
  [[nodiscard]] Action transmit(ranging::ClockTime stamp, std::uint16_t destination, const Body& body,
                                Place place, const Callees* callees = nullptr) noexcept;
  void complete() noexcept { seal_.finish_signing(outgoing_); }
  // The last stamp on the grid that is not after `latest`.
  [[nodiscard]] ranging::ClockTime stamp_not_after(ranging::ClockTime latest) const noexcept {
    return ranging::transmit_stamp_not_after(latest, site_.transmit_antenna_delay);
  }

  // Listens for a frame of up to `bytes` whose RMARKER is due at `due`, `slack` beside the guard on each
  // side.
  [[nodiscard]] Action listen(ranging::ClockTime due, std::size_t bytes, ranging::Ticks slack) const noexcept;
  // The rest of a listening that a frame of no use has ended; nothing: it is over.
  [[nodiscard]] static std::optional<Action> listen_on(const Action& interrupted,
                                                       ranging::ClockTime now) noexcept;

  [[nodiscard]] ranging::ClockTime poll_due(std::uint32_t superframe, std::size_t slot) const noexcept {
    return sync_.start(superframe) + superframe_.poll(slot);
  }
  // A frame due then has its preamble still to come.
  [[nodiscard]] bool ahead(ranging::ClockTime due, ranging::ClockTime now) const noexcept {
    return due - superframe_.phy().before_rmarker() > now;
  }
  // The time is known well enough to send in superframe `number`, and known to be of now.
  [[nodiscard]] bool sure(std::uint32_t number) const noexcept { return fresh() && timed(number); }
  // What was heard is known to be no recording.
  [[nodiscard]] bool fresh() const noexcept { return freshness_.fresh(); }

 private:
  enum class Phase : std::uint8_t { kSearching, kScanning, kInviting, kBeacon, kShared, kSlots };
  enum class Next : std::uint8_t { kBeacon, kShared, kSlots };

  [[nodiscard]] Action search(ranging::ClockTime now) noexcept;
  [[nodiscard]] std::optional<Action> beacon_slot(ranging::ClockTime now) noexcept;
  [[nodiscard]] std::optional<Action> invite(ranging::ClockTime now) noexcept;
  // It is this node's turn to call in a shared slot of the others' that begins between these.
  [[nodiscard]] bool calls_within(ranging::ClockTime from, ranging::ClockTime to) const noexcept;
  [[nodiscard]] bool invites_beside(ranging::ClockTime due) const noexcept;
  void next_of_others() noexcept;
  [[nodiscard]] Action invitation(ranging::ClockTime stamp, const Callees& callees) noexcept;
  void call(const Callees& callees, ranging::ClockTime shared, std::uint32_t rounds) noexcept;
  // Whom to call may not be there, and nothing is amiss.
  [[nodiscard]] bool discreet() const noexcept { return hearsay_ && !mastership_.lacking(); }
  [[nodiscard]] std::optional<Action> scan(ranging::ClockTime now, std::uint32_t superframes = 1) noexcept;
  [[nodiscard]] std::optional<Action> shared_slot(ranging::ClockTime now) noexcept;
  // A JOIN or a DATA of the first channel that has one, in the shared slot.
  [[nodiscard]] std::optional<Action> from_channels(ranging::ClockTime stamp, bool own_turn) noexcept;
  [[nodiscard]] Beacon make_beacon(ranging::Ticks lateness, bool shared) noexcept;
  [[nodiscard]] Action send_beacon(ranging::ClockTime due, bool shared) noexcept;
  // False: there is nothing to follow yet.
  [[nodiscard]] bool found_if_time(ranging::ClockTime now) noexcept;

  // True: the place in the timeline is another, or none.
  bool take_beacon(const Frame& frame, const Beacon& beacon, const Reception& reception) noexcept;
  bool take_stamp(const BeaconStamp& stamp, std::uint64_t session, Verdict verdict, bool persuasive) noexcept;
  void take_content(const Frame& frame, const Beacon& beacon) noexcept;
  [[nodiscard]] bool timed(std::uint32_t number) const noexcept {
    return sync_.margin(number) <= superframe_.guard();
  }
  [[nodiscard]] bool is_for_this_node(const Frame& frame) const noexcept;
  [[nodiscard]] bool authentic(const Frame& frame, const Reception& reception, Place place,
                               Check check) noexcept;
  [[nodiscard]] ranging::Ticks place_in_superframe(const Beacon& beacon) const noexcept;
  [[nodiscard]] bool authentic(const Beacon& beacon, const Reception& reception) noexcept;
  [[nodiscard]] bool is_called(const Beacon& beacon, const Reception& reception) noexcept;
  // By how much the timeline that the beacon tells of is ahead of this node's.
  [[nodiscard]] ranging::Ticks ahead_by(const Beacon& beacon, ranging::ClockTime heard) const noexcept;
  void take_poll(const Poll& poll) noexcept;
  void forget_holders() noexcept;
  void miss() noexcept;

  Site site_;
  Superframe superframe_;
  std::uint32_t hash_;
  Synchronizer sync_;
  Mastership mastership_;
  Seal seal_;
  Freshness freshness_;
  groma_Counters& counters_;
  std::array<ControlChannel*, 3> channels_{};  // the first is freshness_ where the network has a key
  ControlChannel* sender_ = nullptr;           // whose frame is under way

  Phase phase_ = Phase::kSearching;
  Next next_ = Next::kBeacon;
  bool own_beacon_ = false;  // under way
  // Another session that is to come over: its next shared slot, and in which of its superframes that is.
  struct Others {
    ranging::ClockTime shared;
    Callees callees{};
    std::uint32_t left = 0;  // of its shared slots in which this one's nodes are quiet
  };
  std::optional<Others> others_;  // while searching: of an older schedule
  bool hearsay_ = false;          // the last beacon's code fits, but it may have been said long ago
  bool scanning_ = false;         // once the own beacon is out
  std::uint32_t number_ = 0;
  Action listening_;
  std::uint32_t holders_told_ = 0;  // superframe in which they left the master
  std::array<std::uint16_t, kMaxTags> holders_{};
  std::uint8_t sequence_ = 0;
  Health health_{};
  FrameBytes outgoing_;
};

}  // namespace groma::mac
