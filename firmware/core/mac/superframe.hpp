// The place of each frame in a site's superframe, computed from the schedule and the frames' air times.
//
//   | BEACON | shared | slot 0 | slot 1 | ...
//
// docs/reference/air.md has each slot's parts and the formulas, docs/explanation/network.md the reasons. All
// instants are those of RMARKERs, in ticks of network time, and multiples of 512 (kTransmitGrid). All
// instants in a slot follow from the POLL as sent or heard.
//
// After a last RESPONSE the gap is enough, because the polled anchors have sent. A receiver starts
// Phy::receiver_start() before its guard, still in the time that follows the frame before.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <optional>
#include <span>
#include <type_traits>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/radio/phy.hpp"
#include "firmware/core/ranging/device_time.hpp"
#include "groma.pb.h"

namespace groma::mac {

// A schedule outside of these limits is refused: no board can keep it. Below what the image was measured to
// keep (air_plan.hpp), a node takes the schedule, counts what is late, and logs that.
//
// The lower limits are, for turnaround and gap, the time that the fastest known radio needs if its processor
// needs none at all (its driver's least_turnaround_us() for a POLL to one anchor and its RESPONSE, and
// kLeastGap_us). For the guard: 1 for flights of 100 m and clocks 40 ppm apart over the 7 ms of 16
// RESPONSEs; 1 for 5 sigma of a beacon's path (synchronizer.hpp), because a node sends only if its clock is
// known to within the guard.
inline constexpr std::uint32_t kLeastTurnaround_us = 90;
inline constexpr std::uint32_t kLeastGap_us = 35;
inline constexpr std::uint32_t kLeastGuard_us = 2;
inline constexpr std::uint32_t kMostTurnaround_us = 5'000;
inline constexpr std::uint32_t kMostGap_us = 2'000;
inline constexpr std::uint32_t kMostGuard_us = 1'000;

// The usual schedule: what the image keeps on a module with reserve, derived in docs/explanation/ranging.md.
// The gap is the time in which a tag reads a RESPONSE and arms the receiver for the next one. `secured`:
// frames carry a MIC.
inline constexpr std::uint32_t kUsualTurnaround_us = 350;
inline constexpr std::uint32_t kUsualGuard_us = 30;
[[nodiscard]] constexpr std::uint32_t usual_gap_us(bool arm_ahead, bool secured) noexcept {
  if (arm_ahead) return 220;
  return secured ? 320 : 300;
}

// The number of an enumeration that was decoded from the wire. It may be none of the enumerators, and reading
// it as an enumeration is then undefined behaviour.
template <class E>
[[nodiscard]] std::uint32_t number_of(const E& value) noexcept {
  std::underlying_type_t<E> number{};
  std::memcpy(&number, &value, sizeof number);
  return static_cast<std::uint32_t>(number);
}

// The field that is not valid and its valid values, at most 63 characters; empty for a valid schedule.
[[nodiscard]] const char* fault_of(const groma_Schedule& schedule) noexcept;

// A hash of everything that has to be equal at all nodes: the schedule with its epoch, the network and the
// preamble. Nodes that disagree stay silent instead of colliding.
[[nodiscard]] std::uint32_t schedule_hash(const groma_Schedule& schedule, std::uint32_t network_id,
                                          radio::Preamble preamble) noexcept;

class Superframe {
 public:
  // fault_of(`schedule`) is empty. `secured`: each frame carries a MIC.
  Superframe(const groma_Schedule& schedule, const radio::Phy& phy, bool secured = false) noexcept;

  [[nodiscard]] Ticks duration() const noexcept {
    return slots_start_ + static_cast<std::int64_t>(slot_count_) * tag_slot_ + end_time_;
  }
  [[nodiscard]] std::size_t slot_count() const noexcept { return slot_count_; }
  [[nodiscard]] Ticks tag_slot() const noexcept { return tag_slot_; }
  // Most anchors that a POLL may name.
  [[nodiscard]] std::size_t responses() const noexcept { return responses_; }

  // From the superframe's start to the RMARKER.
  [[nodiscard]] Ticks beacon() const noexcept { return first_frame_; }
  [[nodiscard]] Ticks shared() const noexcept { return control_slot_ + first_frame_; }
  [[nodiscard]] Ticks poll(std::size_t slot) const noexcept {
    return slots_start_ + static_cast<std::int64_t>(slot) * tag_slot_ + first_frame_;
  }

  // The same for a beacon, wherever it was sent.
  [[nodiscard]] Ticks rmarker(const Beacon& of) const noexcept {
    return of.merge_request ? of.place : (of.shared ? shared() : beacon()) + Ticks(of.tx_offset_dtu);
  }

  // From the RMARKER of a POLL that names `count` anchors to that of the RESPONSE at `index`, or of the
  // FINAL.
  [[nodiscard]] Ticks response(std::size_t index, std::size_t count) const noexcept;
  [[nodiscard]] Ticks final(std::size_t count) const noexcept;

  [[nodiscard]] bool has_final() const noexcept { return has_final_; }
  [[nodiscard]] Ticks guard() const noexcept { return guard_; }
  [[nodiscard]] const radio::Phy& phy() const noexcept { return phy_; }
  // Size on the air of a frame of `bytes` bytes without MIC.
  [[nodiscard]] std::size_t on_air(std::size_t bytes) const noexcept { return bytes + mic_bytes_; }
  // The largest frame in a beacon slot or a shared slot, including its MIC.
  [[nodiscard]] std::size_t control_bytes() const noexcept { return control_bytes_; }

 private:
  radio::Phy phy_;
  bool has_final_;
  std::size_t mic_bytes_;
  std::size_t slot_count_;
  std::size_t responses_;
  std::size_t control_bytes_;
  Ticks guard_;
  Ticks turnaround_;
  Ticks gap_;
  Ticks first_frame_;       // from a slot's start to the RMARKER of its first frame
  Ticks response_spacing_;  // from RMARKER to RMARKER
  Ticks end_time_;          // after the last slot
  Ticks control_slot_;      // length of the beacon slot
  Ticks slots_start_;
  Ticks tag_slot_;
};

[[nodiscard]] inline std::span<const std::uint16_t> tags_of(const groma_Schedule& schedule) noexcept {
  return std::span(schedule.tag_ids).first(std::min<std::size_t>(schedule.tag_ids_count, kMaxTags));
}
[[nodiscard]] inline std::span<const std::uint16_t> anchors_of(const groma_Schedule& schedule) noexcept {
  return std::span(schedule.anchor_ids).first(schedule.anchor_ids_count);
}
[[nodiscard]] inline std::span<const std::uint16_t> backups_of(const groma_Schedule& schedule) noexcept {
  return std::span(schedule.backup_ids).first(schedule.backup_ids_count);
}
// The number of slots in a superframe.
[[nodiscard]] std::size_t slot_count_of(const groma_Schedule& schedule) noexcept;

// The slot that the schedule assigns to a tag; nothing if it does not name the tag.
[[nodiscard]] std::optional<std::size_t> configured_slot(const groma_Schedule& schedule,
                                                         std::uint16_t tag) noexcept;

// The rank of an anchor: 0 for the master, from 1 for the back-ups; nothing for others.
[[nodiscard]] std::optional<std::size_t> rank_of(const groma_Schedule& schedule,
                                                 std::uint16_t anchor) noexcept;

}  // namespace groma::mac
