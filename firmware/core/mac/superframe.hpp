// When each frame of a site's superframe is due, computed from the schedule and the air times of the frames.
//
//   | BEACON | shared | slot 0 | slot 1 | ...
//
//   BEACON: | guard BEACON turn-round 100 us |     shared: | guard BEACON, JOIN or DATA turn-round 100 us |
//   slot:   | guard POLL turn-round RESPONSE gap RESPONSE gap ... RESPONSE gap | [turn-round FINAL
//   turn-round] |
//
// The first BEACON is the master's. The shared slot is taken in turns, by the superframe's number: one
// superframe it is open to all, in the next ones the back-ups, by rank, relay the beacon. All instants are in
// ticks of the network's time, multiples of 512 (the transmit grid), and are those of RMARKERs. In a slot
// everything follows from the POLL as it was sent or heard; a POLL that names fewer anchors than the schedule
// allows only ends earlier.
//
// After the beacon and after the shared slot there are the turn-round (or the gap, where that is longer) and
// 100 us for whoever takes a beacon into the clock filter before making the next frame. In a network with a
// key a frame's code is checked before another is made, which takes an nRF52832 some 100 us for both: the
// beacon is followed by as much again, for a message in the shared slot, and so is the last slot, for the
// next beacon. Within a tag's slot the schedule's turn-round has room for it, or has not.
//
// Whoever heard a FINAL out has the next POLL to listen for, or a beacon to make: it is followed by the
// turn-round, or the gap where that is longer. A slot that RESPONSEs end needs no more than the gap: an
// anchor that was asked has sent.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>

#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/mac/frame.hpp"
#include "firmware/core/ranging/device_time.hpp"
#include "groma.pb.h"

namespace groma::mac {

enum class ScheduleFault : std::uint8_t {
  kNone,
  kNoTags,
  kNoAnchors,
  kBadId,         // 0 or 65535 is no id, and ids are up to 65534
  kRepeatedId,    // tags and anchors share one number space
  kBadMaster,     // the master is not among the anchors
  kBadMethod,     // not a method this node knows
  kBadTurnRound,  // outside of 150 to 5000 us
  kBadGap,        // outside of 50 to 2000 us
  kBadGuard,      // outside of 5 to 1000 us
  kBadBackup,     // a back-up is not among the anchors, or is the master
  kBadSlots,      // outside of 0 to 16, or a tag's slot beyond them
  kBadResponses,  // outside of 0 to 16
};

// What is wrong and what would be right, at most 63 characters; empty for kNone.
[[nodiscard]] const char* describe(ScheduleFault fault) noexcept;

[[nodiscard]] ScheduleFault check(const groma_Schedule& schedule) noexcept;

// A hash over all that has to be equal at each node: the schedule with its epoch, the network and the
// preamble. Nodes that disagree about it stay silent rather than collide.
[[nodiscard]] std::uint32_t schedule_hash(const groma_Schedule& schedule, std::uint32_t network_id,
                                          dw1000::Preamble preamble) noexcept;

class Superframe {
 public:
  // The schedule is one that check() has passed. `secured`: each frame carries a code.
  Superframe(const groma_Schedule& schedule, dw1000::Phy phy, bool secured = false) noexcept;

  [[nodiscard]] ranging::Ticks duration() const noexcept {
    return slots_start_ + static_cast<std::int64_t>(slot_count_) * tag_slot_ + end_time_;
  }
  [[nodiscard]] std::size_t slot_count() const noexcept { return slot_count_; }
  [[nodiscard]] ranging::Ticks tag_slot() const noexcept { return tag_slot_; }
  // Anchors that a POLL may name.
  [[nodiscard]] std::size_t responses() const noexcept { return responses_; }

  // From the superframe's start, to the RMARKER.
  [[nodiscard]] ranging::Ticks beacon() const noexcept { return first_frame_; }
  [[nodiscard]] ranging::Ticks shared() const noexcept { return control_slot_ + first_frame_; }
  [[nodiscard]] ranging::Ticks poll(std::size_t slot) const noexcept {
    return slots_start_ + static_cast<std::int64_t>(slot) * tag_slot_ + first_frame_;
  }

  // Whose the shared slot is: 0: open to all; n: of the back-up of rank n, from 1.
  [[nodiscard]] std::size_t shared_turn(std::uint32_t superframe) const noexcept {
    return superframe % (backups_ + 1);
  }

  // From the RMARKER of a POLL that names `count` anchors: to the RESPONSE of the one at `index`, and to the
  // FINAL.
  [[nodiscard]] ranging::Ticks response(std::size_t index, std::size_t count) const noexcept;
  [[nodiscard]] ranging::Ticks final(std::size_t count) const noexcept;

  [[nodiscard]] bool has_final() const noexcept { return has_final_; }
  [[nodiscard]] ranging::Ticks guard() const noexcept { return guard_; }
  [[nodiscard]] dw1000::Phy phy() const noexcept { return phy_; }
  // On the air, of a frame with so many bytes but for its code.
  [[nodiscard]] std::size_t on_air(std::size_t bytes) const noexcept { return bytes + code_bytes_; }
  // The largest frame of a beacon's or a shared slot, with its code.
  [[nodiscard]] std::size_t control_bytes() const noexcept { return control_bytes_; }

 private:
  dw1000::Phy phy_;
  bool has_final_;
  std::size_t code_bytes_;
  std::size_t slot_count_;
  std::size_t responses_;
  std::uint32_t backups_;
  std::size_t control_bytes_;
  ranging::Ticks guard_;
  ranging::Ticks turn_round_;
  ranging::Ticks gap_;
  ranging::Ticks first_frame_;       // from a slot's start to the RMARKER of its first frame
  ranging::Ticks response_spacing_;  // from RMARKER to RMARKER
  ranging::Ticks control_slot_;      // the beacon's
  ranging::Ticks slots_start_;
  ranging::Ticks tag_slot_;
  ranging::Ticks end_time_{};  // after the last slot
};

// The slot that the schedule gives to a tag; nothing where it does not name the tag.
[[nodiscard]] std::optional<std::size_t> configured_slot(const groma_Schedule& schedule,
                                                         std::uint16_t tag) noexcept;

// The rank of an anchor: 0 is the master's, 1 and up the back-ups'; nothing for others.
[[nodiscard]] std::optional<std::size_t> rank_of(const groma_Schedule& schedule,
                                                 std::uint16_t anchor) noexcept;

}  // namespace groma::mac
