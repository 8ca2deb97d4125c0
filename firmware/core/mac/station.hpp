// The common part of tag and anchor: sending and accepting frames, synchronization, and all of a superframe
// except its tag slots, in which it calls the functions slot_...() of the derived class.
//
//   searching --beacon--> | beacon | shared | tag slots | beacon | shared | ...
//
// step.hpp describes the events and their order.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/coexistence.hpp"
#include "firmware/core/mac/control_channel.hpp"
#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/frame_authenticator.hpp"
#include "firmware/core/mac/master_election.hpp"
#include "firmware/core/mac/replay_guard.hpp"
#include "firmware/core/mac/site.hpp"
#include "firmware/core/mac/slot_map.hpp"
#include "firmware/core/mac/step.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/mac/synchronizer.hpp"
#include "groma.pb.h"

namespace groma::mac {

class Station {
 public:
  Station(const Station&) = delete;
  Station& operator=(const Station&) = delete;

  // Up to two channels, which outlive the station.
  void attach(ControlChannel& channel) noexcept;

  // Starts the search.
  [[nodiscard]] Step start(ClockTime now) noexcept;
  [[nodiscard]] Step on_transmitted(ClockTime timestamp) noexcept;
  [[nodiscard]] Step on_late(ClockTime now) noexcept;
  [[nodiscard]] Step on_received(const Reception& reception) noexcept;
  [[nodiscard]] Step on_timeout(ClockTime now) noexcept;
  // Call after the radio was stopped and restarted: continues with the next action, with the time of the
  // clock filter. A master that was away for a while listens before it leads again.
  [[nodiscard]] Step resume(ClockTime now) noexcept;
  // Call before resume() if this node's clock has continued by another one, with an error of some us.
  void on_clock_restart() noexcept;
  // Run in the background of other work.
  void begin_verify(std::span<const std::uint8_t> frame) noexcept {
    authenticator_.begin_verify(frame, in_slots() ? slot_place() : control_place());
  }
  void finish_signing() noexcept { authenticator_.finish_signing(outgoing_); }

  // Of this node's chip, sent to others.
  void set_health(const Health& health) noexcept { health_ = health; }

  [[nodiscard]] const Superframe& superframe() const noexcept { return superframe_; }
  [[nodiscard]] const Synchronizer& sync() const noexcept { return sync_; }
  [[nodiscard]] const MasterElection& election() const noexcept { return election_; }
  // The superframe in progress; after a tag's slot the next one.
  [[nodiscard]] std::uint32_t superframe_number() const noexcept { return number_; }
  // Replay has been excluded for this session.
  [[nodiscard]] bool fresh() const noexcept { return replay_guard_.fresh(); }
  // Network time when this node's clock shows `local`, now or recently: the superframe number times the
  // duration, plus the time into the superframe, in ticks of network time. Nothing while searching.
  [[nodiscard]] std::optional<Ticks> network_time(ClockTime local) const noexcept {
    if (sync_.state() == SyncState::kSearching) return std::nullopt;
    return sync_.network_time(local);
  }

  // Listens in a slot of this kind for a frame of up to `bytes` whose RMARKER is due at `due`: hunts for its
  // preamble from guard plus `slack` before to guard plus `slack` after. The receiver starts earlier by
  // Phy::receiver_start().
  [[nodiscard]] Action listen(SlotKind slot, ClockTime due, std::size_t bytes, Ticks slack) const noexcept;

 protected:
  // Time that a node needs between two actions.
  static constexpr Ticks kToGetReady = Ticks::from_us(300);

  // An accepted frame. `unverified`: a beacon of another timeline, which may be a replay although its MIC is
  // valid.
  struct Accepted : Frame {
    bool unverified = false;
  };

  // `counters` outlives the station, as does what the site points to.
  Station(const Site& site, groma_Counters& counters) noexcept;
  ~Station() = default;

  // ---- the derived class ---------------------------------------------------------------------------------

  // The next action in the tag slots of superframe_number(), with its preamble after `now`. Nothing: they are
  // over, and end_superframe() was called.
  [[nodiscard]] virtual std::optional<Action> slot_action(ClockTime now) noexcept = 0;
  // Where the present action's frame is sent or heard.
  [[nodiscard]] virtual Place slot_place() const noexcept = 0;
  // Events of the last action in the tag slots.
  [[nodiscard]] virtual Step slot_transmitted(ClockTime timestamp) noexcept = 0;
  [[nodiscard]] virtual Step slot_received(const Reception& reception) noexcept = 0;
  [[nodiscard]] virtual Step slot_timeout(ClockTime now) noexcept { return plan(now); }
  // It was late, or the radio was stopped.
  [[nodiscard]] virtual Step slot_abandoned(ClockTime now) noexcept { return plan(now); }
  // No exchange may span this instant.
  virtual void forget_exchanges() noexcept = 0;

  // ---- for the derived class -----------------------------------------------------------------------------

  // The next action, with its preamble after `now`.
  [[nodiscard]] Step plan(ClockTime now) noexcept;
  [[nodiscard]] Step act(const Action& action) noexcept {
    action_ = action;
    return {action, nullptr};
  }
  void end_superframe() noexcept;
  // The last action is in the tag slots.
  [[nodiscard]] bool in_slots() const noexcept { return phase_ == Phase::kSlots; }
  // The tag slots are next.
  [[nodiscard]] bool before_slots() const noexcept { return phase_ == Phase::kShared; }
  // The listening in the beacon slot or the shared slot that most likely follows the present one, so that it
  // can be armed before that has ended; nothing if it depends on its result.
  [[nodiscard]] std::optional<Action> control_ahead() const noexcept;

  // Handles a frame heard in a tag slot to which it does not belong. Returns true if the timeline changed or
  // was lost: continue with plan().
  [[nodiscard]] bool overhear(const Accepted& frame, const Reception& reception) noexcept;

  // Returns a frame that belongs to this network, is addressed to this node, to all or to relays, and has the
  // MIC that the network key requires at `place`, where it was heard. Other frames are counted, and nothing
  // is returned. In an unused slot a POLL with a wrong MIC may belong to another session.
  [[nodiscard]] std::optional<Accepted> accept(const Reception& reception, Place place,
                                               bool unused_slot = false) noexcept;
  // `place`: where the frame is sent. finish_signing() adds the MIC; before a replay has been excluded, to a
  // challenge alone.
  [[nodiscard]] Action transmit(ClockTime timestamp, std::uint16_t destination, const Body& body, Place place,
                                const MergeTarget& merge_target = {}) noexcept;
  // The last timestamp on the transmit grid that is not after `latest`.
  [[nodiscard]] ClockTime timestamp_not_after(ClockTime latest) const noexcept {
    return ranging::transmit_timestamp_not_after(latest, site_.transmit_antenna_delay,
                                                 superframe_.phy().transmit_grid());
  }
  // The remainder of the present listening, which an unusable frame interrupted; nothing: it is over.
  [[nodiscard]] std::optional<Action> listen_on(ClockTime now) const noexcept;

  // Frames carry MICs.
  [[nodiscard]] bool keyed() const noexcept { return authenticator_.on(); }
  // Precomputes cipher blocks for the beacon slot and the shared slot. Call in idle time.
  void prepare_control() noexcept;

  [[nodiscard]] ClockTime poll_due(std::uint32_t superframe, std::size_t slot) const noexcept {
    return sync_.start(superframe) + superframe_.poll(slot);
  }
  // The preamble of a frame due at `due` is still to come.
  [[nodiscard]] bool ahead(ClockTime due, ClockTime now) const noexcept {
    return due - superframe_.phy().before_rmarker() > now;
  }
  // This node may send in superframe `number`: it knows the time well enough, and the time is not that of a
  // recording.
  [[nodiscard]] bool sure(std::uint32_t number) const noexcept { return fresh() && timed(number); }

  [[nodiscard]] const Site& site() const noexcept { return site_; }
  [[nodiscard]] groma_Counters& counters() noexcept { return counters_; }
  [[nodiscard]] const Health& health() const noexcept { return health_; }
  [[nodiscard]] Coexistence& coexistence() noexcept { return coexistence_; }
  [[nodiscard]] FrameAuthenticator& authenticator() noexcept { return authenticator_; }
  // Follows the beacons. At the master a channel may change it in on_control() and on_beacon_out().
  [[nodiscard]] SlotMap& slots() noexcept { return slots_; }
  [[nodiscard]] const SlotMap& slots() const noexcept { return slots_; }

 private:
  enum class Phase : std::uint8_t { kSearching, kScanning, kBeacon, kShared, kSlots };
  enum class Next : std::uint8_t { kBeacon, kShared, kSlots };
  // How far to trust a beacon whose MIC is valid.
  enum class Trust : std::uint8_t { kNone, kUnverified, kFull };

  [[nodiscard]] std::span<ControlChannel* const> channels() const noexcept {
    return std::span(channels_).first(channel_count_);
  }

  // station.cpp: the sequence of a superframe.
  void begin_search(ClockTime now) noexcept;
  // Returns false while there is no session to follow or start.
  [[nodiscard]] bool start_session_if_due(ClockTime now) noexcept;
  // The next action outside of the tag slots; nothing: they are next.
  [[nodiscard]] std::optional<Action> control(ClockTime now) noexcept;
  [[nodiscard]] std::optional<Action> control_received(const Reception& reception) noexcept;
  void control_timeout() noexcept;
  [[nodiscard]] std::optional<Action> beacon_slot(ClockTime now) noexcept;
  [[nodiscard]] std::optional<Action> scan(ClockTime now, std::uint32_t superframes = 1) noexcept;
  [[nodiscard]] std::optional<Action> shared_slot(ClockTime now) noexcept;
  // A JOIN or a DATA for the shared slot, of the first channel that has one.
  [[nodiscard]] std::optional<Action> from_channels(ClockTime timestamp, bool own_turn) noexcept;
  [[nodiscard]] Beacon make_beacon(Ticks tx_offset, bool shared) noexcept;
  [[nodiscard]] Action send_beacon(ClockTime due, bool shared) noexcept;
  void release_sender(bool sent) noexcept;
  void miss() noexcept;
  // Of the present beacon slot or shared slot.
  [[nodiscard]] Place control_place() const noexcept {
    return {number_, phase_ == Phase::kShared ? Place::kShared : Place::kBeacon};
  }

  // station.cpp: merge requests.
  [[nodiscard]] std::optional<Action> request_in_turn(ClockTime now) noexcept;
  // A shared slot of the others in which this node may send a merge request begins between these instants.
  [[nodiscard]] bool requests_within(ClockTime from, ClockTime to) const noexcept;
  void next_of_others() noexcept;
  [[nodiscard]] Action merge_request(ClockTime timestamp) noexcept;
  void send_merge_requests(std::uint32_t rounds, bool only_requester_silent) noexcept;

  // station_frames.cpp. Returns true if the place in the timeline changed or was lost.
  bool take_beacon(const Accepted& frame, const Beacon& beacon, const Reception& reception) noexcept;
  // Of a session that has to join this one or fall silent. Returns as take_beacon().
  bool request_merge(const Beacon& beacon, ClockTime heard, bool unverified) noexcept;
  void take_content(const Frame& frame, const Beacon& beacon, bool adopted) noexcept;
  // A frame of this network at an unexpected time.
  void on_stray(const Frame& frame) noexcept;
  [[nodiscard]] bool is_for_this_node(const Frame& frame) const noexcept;
  // Counts a frame that is not authentic.
  [[nodiscard]] bool authenticate(Accepted& frame, const Reception& reception, Place place,
                                  bool unused_slot) noexcept;
  // This node is synchronized, and not with a recording.
  [[nodiscard]] bool knows_time() const noexcept { return sync_.state() != SyncState::kSearching && fresh(); }
  [[nodiscard]] Trust trust_in(const Beacon& beacon, ClockTime heard) const noexcept;

  // The superframe at `t` on this node's timeline.
  [[nodiscard]] std::uint32_t superframe_at(ClockTime t) const noexcept {
    return static_cast<std::uint32_t>(sync_.network_time(t).count() / superframe_.duration().count());
  }
  [[nodiscard]] bool timed(std::uint32_t number) const noexcept {
    return sync_.margin(number) <= superframe_.guard();
  }

  Site site_;
  Superframe superframe_;
  std::uint32_t hash_;
  Synchronizer sync_;
  MasterElection election_;
  Coexistence coexistence_;
  SlotMap slots_;
  FrameAuthenticator authenticator_;
  ReplayGuard replay_guard_;
  groma_Counters& counters_;
  std::array<ControlChannel*, 3> channels_{};  // the first is replay_guard_ where the network has a key
  std::size_t channel_count_ = 0;
  ControlChannel* sender_ = nullptr;  // whose frame is being sent

  Phase phase_ = Phase::kSearching;
  Next next_ = Next::kBeacon;
  // Another session, the target of merge requests: its next shared slot, and the number of its superframe.
  struct Others {
    ClockTime shared;
    MergeTarget merge_target{};
    std::uint32_t left = 0;  // how many of its shared slots this session's nodes stay silent for
  };
  std::optional<Others> others_;  // while searching: of an older schedule
  bool scanning_ = false;         // after the own beacon has been sent
  std::uint32_t number_ = 0;
  Action action_;  // the last one
  std::uint8_t sequence_ = 0;
  Health health_{};
  FrameBytes outgoing_;
};

}  // namespace groma::mac
