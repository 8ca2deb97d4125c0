// How nodes join and leave the running network, by messages in the shared slots and by beacons: the tag's
// side and the anchor's (docs/explanation/joining.md).
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>

#include "firmware/core/mac/anchor_set.hpp"
#include "firmware/core/mac/control_channel.hpp"
#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/repeated_join.hpp"
#include "firmware/core/mac/slot_map.hpp"
#include "groma.pb.h"

namespace groma::mac {

class TagMembership final : public ControlChannel {
 public:
  // `slots`, this node's slot map, outlives this object. `lender`: uses the slot of that tag instead of one
  // of its own; kNobody: its own.
  TagMembership(std::uint16_t id, const groma_Schedule& schedule, const SlotMap& slots,
                std::uint16_t lender = kNobody) noexcept;

  // The slot in which the tag may poll in superframe `number`.
  [[nodiscard]] std::optional<std::size_t> slot(std::uint32_t number) const noexcept {
    return leaving_ ? std::nullopt : slots_.valid_slot_of(owner_, number);
  }
  // The slot is another tag's.
  [[nodiscard]] bool borrows() const noexcept { return owner_ != id_; }
  // Stops polling permanently and announces it.
  void leave() noexcept;

  [[nodiscard]] AnchorSet& anchors() noexcept { return anchors_; }
  [[nodiscard]] const AnchorSet& anchors() const noexcept { return anchors_; }

  [[nodiscard]] std::optional<Outgoing> open_slot(std::uint32_t number) noexcept override {
    return join_.turn(number);
  }
  void on_sent(std::uint32_t /*number*/, bool sent) noexcept override { join_.on_sent(sent); }
  void on_control(const Frame& frame, std::uint32_t number, bool leading) noexcept override;
  void on_beacon(const Frame& frame, const Beacon& beacon) noexcept override;

 private:
  std::uint16_t id_;
  std::uint16_t owner_;  // of the slot in which this node polls
  const SlotMap& slots_;
  AnchorSet anchors_;
  RepeatedJoin join_;
  bool leaving_ = false;
};

class AnchorMembership final : public ControlChannel {
 public:
  // `slots`, this node's slot map, outlives this object. At the master this object changes it.
  AnchorMembership(std::uint16_t id, const groma_Schedule& schedule, SlotMap& slots) noexcept;

  [[nodiscard]] const SlotMap& slots() const noexcept { return slots_; }
  // A POLL was heard in its slot; `named`: it asks for this anchor's answer.
  void on_poll(std::uint16_t tag, std::size_t slot, bool named) noexcept;

  [[nodiscard]] std::optional<Outgoing> open_slot(std::uint32_t number) noexcept override;
  [[nodiscard]] std::optional<Outgoing> own_turn(std::uint32_t number) noexcept override;
  void on_sent(std::uint32_t /*number*/, bool sent) noexcept override {
    relayed_.on_sent(sent);
    announcement_.on_sent(sent);
  }
  void on_control(const Frame& frame, std::uint32_t number, bool leading) noexcept override;
  void on_beacon(const Frame& frame, const Beacon& beacon) noexcept override;
  void on_beacon_out(Beacon& beacon, bool leading) noexcept override;

 private:
  void announce(std::uint32_t number) noexcept;
  void consider_passing_on(const Frame& frame, const Join& join, std::uint32_t number) noexcept;

  std::uint16_t id_;
  bool beaconer_;  // this node relays beacons
  bool listed_;    // among the schedule's anchors, which all tags know
  std::uint32_t next_announcement_ = 0;
  enum class Announcing : std::uint8_t { kNotYet, kSoon, kDone };
  Announcing announcing_ = Announcing::kNotYet;
  SlotMap& slots_;
  RepeatedJoin announcement_;
  RepeatedJoin relayed_;                   // a tag's request
  std::uint32_t passed_on_since_ = 0;      // superframe of the last request to be relayed
  std::array<std::uint64_t, 4> passed_{};  // origin and lower half of the nonce of the last requests
  std::size_t next_passed_ = 0;
};

}  // namespace groma::mac
