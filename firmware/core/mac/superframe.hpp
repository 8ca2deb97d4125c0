// When each frame of a site's superframe is due, computed from the schedule and the air times of the frames.
//
//   | guard BEACON turn-round | slot of tag 0 | slot of tag 1 | ...
//
//   slot: | guard POLL turn-round RESPONSE gap RESPONSE gap ... RESPONSE gap | [turn-round FINAL gap] |
//
// All instants are in ticks of the master's clock, multiples of 512 (the transmit grid), and are those of
// RMARKERs. In a slot everything follows from the POLL as it was sent or heard; a POLL that names fewer
// anchors than the schedule has only ends earlier.
#pragma once

#include <cstddef>
#include <cstdint>

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
  // The schedule is one that check() has passed.
  Superframe(const groma_Schedule& schedule, dw1000::Phy phy) noexcept;

  [[nodiscard]] ranging::Ticks duration() const noexcept {
    return beacon_slot_ + static_cast<std::int64_t>(tag_count_) * tag_slot_;
  }
  [[nodiscard]] std::size_t tag_count() const noexcept { return tag_count_; }
  [[nodiscard]] ranging::Ticks tag_slot() const noexcept { return tag_slot_; }

  // From the superframe's start.
  [[nodiscard]] ranging::Ticks beacon() const noexcept { return first_frame_; }
  [[nodiscard]] ranging::Ticks poll(std::size_t slot) const noexcept {
    return beacon_slot_ + static_cast<std::int64_t>(slot) * tag_slot_ + first_frame_;
  }

  // From the RMARKER of a POLL that names `count` anchors: to the RESPONSE of the one at `index`, and to the
  // FINAL.
  [[nodiscard]] ranging::Ticks response(std::size_t index, std::size_t count) const noexcept;
  [[nodiscard]] ranging::Ticks final(std::size_t count) const noexcept;

  [[nodiscard]] bool has_final() const noexcept { return has_final_; }
  [[nodiscard]] ranging::Ticks guard() const noexcept { return guard_; }
  [[nodiscard]] dw1000::Phy phy() const noexcept { return phy_; }

 private:
  dw1000::Phy phy_;
  bool has_final_;
  std::size_t tag_count_;
  ranging::Ticks guard_;
  ranging::Ticks turn_round_;
  ranging::Ticks gap_;
  ranging::Ticks first_frame_;       // from a slot's start to the RMARKER of its first frame
  ranging::Ticks response_spacing_;  // from RMARKER to RMARKER
  ranging::Ticks beacon_slot_;
  ranging::Ticks tag_slot_;
};

}  // namespace groma::mac
