// The anchor: follows the network's time or leads it, and answers the tags that poll it.
//
//   Station (search, beacon, shared slot) / slot 0 / slot 1 / ... in turn;
//   in a slot: POLL --> RESPONSE --> [FINAL]
//
// If a RESPONSE does not leave at the timestamp that it states, its exchange is never closed and gives no
// range.
#pragma once

#include <array>
#include <cstdint>
#include <optional>

#include "firmware/core/mac/membership.hpp"
#include "firmware/core/mac/station.hpp"
#include "firmware/core/mac/step.hpp"

namespace groma::mac {

class Anchor final : public Station {
 public:
  // `counters` outlives the anchor.
  Anchor(const Site& site, groma_Counters& counters) noexcept;

  std::size_t precompute() noexcept;
  // As Tag::next_rx_window().
  [[nodiscard]] std::optional<Action> next_rx_window() const noexcept {
    return in_slots() ? std::nullopt : control_ahead();
  }
  [[nodiscard]] const AnchorMembership& membership() const noexcept { return membership_; }

 private:
  enum class Phase : std::uint8_t { kPoll, kResponse, kFinal };  // of the slot
  static constexpr int kSilent = 4;  // superframes without a POLL after which a slot counts as unused

  // The last exchange with one tag.
  struct Record {
    std::uint16_t tag = kNobody;
    std::uint16_t exchange = 0;
    std::uint32_t superframe = 0;
    bool valid = false;          // the RESPONSE was sent at `responded`
    bool closing_valid = false;  // a FINAL came in
    ClockTime responded{};       // A2
    Ticks closing{};             // A3 - A2
  };

  [[nodiscard]] std::optional<Action> slot_action(ClockTime now) noexcept override;
  [[nodiscard]] Place slot_place() const noexcept override {
    return {slots_of_, static_cast<std::uint8_t>(slot_)};
  }
  [[nodiscard]] Step slot_transmitted(ClockTime timestamp) noexcept override;
  [[nodiscard]] Step slot_received(const Reception& reception) noexcept override;
  void forget_exchanges() noexcept override;

  // The answer to a POLL heard in this slot, if the POLL asks for one.
  [[nodiscard]] std::optional<Action> answer(const Frame& frame, const Poll& poll,
                                             const Reception& reception) noexcept;
  // Listens for the slot's POLL. If none has come for a while, listens to the end of the slot: a frame there
  // belongs to another network.
  [[nodiscard]] Action listen_in_slot(ClockTime due) const noexcept;
  void enter_next_slot() noexcept;
  void go_on_to(ClockTime now) noexcept;
  // The slot's POLL is due no earlier or later than by this.
  [[nodiscard]] Ticks tolerance() const noexcept { return superframe().guard() + sync().margin(slots_of_); }
  // The reception is where the POLL of the present slot is due.
  [[nodiscard]] bool in_time(const Reception& reception) const noexcept;
  // The tag in whose slot the POLL is sent: its sender, or the present slot's owner, which lent it.
  [[nodiscard]] std::uint16_t owner_for(const Frame& frame, const Poll& poll) const noexcept {
    return poll.lent ? slots().owner_of(slot_) : frame.source;
  }
  // The POLL is in the present slot and its sender may poll there.
  [[nodiscard]] bool is_of_slot(const Frame& frame, const Poll& poll,
                                const Reception& reception) const noexcept;
  // The sender of the next POLL in the present slot.
  [[nodiscard]] std::uint16_t expected_tag() const noexcept;
  // The record of that tag, or the oldest one, cleared for it.
  [[nodiscard]] Record& record_of(std::uint16_t tag) noexcept;
  void close(const Frame& frame, const Final& final, const Reception& reception) noexcept;

  AnchorMembership membership_;
  Phase phase_ = Phase::kPoll;
  std::uint32_t slots_of_ = 0;                     // superframe that the slot indices refer to
  std::size_t next_slot_ = 0;                      // index of the next slot
  std::size_t slot_ = 0;                           // index of the present slot
  std::array<std::uint8_t, kMaxTags> silent_{};    // of each slot: superframes without a POLL
  std::array<std::uint16_t, kMaxTags> pollers_{};  // of each slot: the sender of its last POLL
  std::uint32_t polls_missing_ = 0;                // superframes without a POLL that names this anchor
  ClockTime poll_heard_{};
  std::size_t polled_ = 0;      // number of anchors in the POLL
  Record* answered_ = nullptr;  // of the POLL's sender
  std::array<Record, kMaxTags> records_{};
};

}  // namespace groma::mac
