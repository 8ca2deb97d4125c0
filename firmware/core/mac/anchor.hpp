// The anchor: keeps in step with the network, or leads it, and answers the tags that poll it.
//
//   the station's part (searching, beacon, shared slot) / slot 0 / slot 1 / ... in turn;
//   in a slot: POLL --> RESPONSE --> [FINAL]
//
// The RESPONSE tells the interval A2 - A1 that it will itself have ended, for a delayed transmission's stamp
// is known beforehand, and the closing interval A3 - A2 of the exchange before with this tag. Should the
// RESPONSE not leave at the stamp that it claims, its exchange is never closed and so gives no range.
#pragma once

#include <array>
#include <cstdint>
#include <optional>

#include "firmware/core/mac/membership.hpp"
#include "firmware/core/mac/station.hpp"
#include "firmware/core/mac/step.hpp"

namespace groma::mac {

class Anchor {
 public:
  // `counters` outlives the anchor.
  Anchor(const Site& site, groma_Counters& counters) noexcept;

  [[nodiscard]] Step start(ranging::ClockTime now) noexcept;
  [[nodiscard]] Step on_transmitted(ranging::ClockTime stamp) noexcept;
  [[nodiscard]] Step on_late(ranging::ClockTime now) noexcept;
  [[nodiscard]] Step on_received(const Reception& reception) noexcept;
  [[nodiscard]] Step on_timeout(ranging::ClockTime now) noexcept;
  [[nodiscard]] Step on_error(ranging::ClockTime now) noexcept { return on_timeout(now); }
  // The radio was stopped, whatever it was at, and is there again: goes on with what lies ahead, in step as
  // far as the clock filter carries. A master that was away for a while listens before it leads on.
  [[nodiscard]] Step resume(ranging::ClockTime now) noexcept;

  // What can be done beside other things, see step.hpp.
  void glance(std::span<const std::uint8_t> frame) noexcept {
    station_.glance(frame, phase_ == Phase::kControl ? station_.control_place() : place());
  }
  void complete() noexcept { station_.complete(); }
  std::size_t prepare() noexcept;

  void attach(ControlChannel& channel) noexcept { station_.attach(channel); }
  [[nodiscard]] const AnchorMembership& membership() const noexcept { return membership_; }
  // As the tag's.
  [[nodiscard]] std::optional<Action> ahead() const noexcept {
    return phase_ == Phase::kControl ? station_.control_ahead() : std::nullopt;
  }
  [[nodiscard]] const Station& station() const noexcept { return station_; }
  void set_health(const Health& health) noexcept { station_.set_health(health); }
  // The one under way.
  [[nodiscard]] std::uint32_t superframe_number() const noexcept { return station_.superframe_number(); }

 private:
  enum class Phase : std::uint8_t { kControl, kPoll, kResponse, kFinal };

  // The last exchange with one tag.
  struct Record {
    std::uint16_t tag = kNobody;
    std::uint16_t exchange = 0;
    std::uint32_t superframe = 0;
    bool valid = false;              // its RESPONSE left, at `responded`
    bool closing_valid = false;      // a FINAL told
    ranging::ClockTime responded{};  // A2
    ranging::Ticks closing{};        // A3 - A2
  };

  Action plan(ranging::ClockTime now) noexcept;
  // The answer to a POLL heard in this slot, if it asks for one.
  [[nodiscard]] std::optional<Action> answer(const Frame& frame, const Poll& poll,
                                             const Reception& reception) noexcept;
  // Listens for the slot's POLL; where none has come for a while, on to the slot's end: what is sent there
  // is another network's.
  [[nodiscard]] Action listen_in_slot(ranging::ClockTime due) const noexcept;
  void go_on_to(ranging::ClockTime now) noexcept;
  // Where the POLL of the slot under way is due.
  [[nodiscard]] bool in_time(const Reception& reception) const noexcept;
  // Of the slot under way, by who may poll in it.
  [[nodiscard]] bool is_of_slot(const Frame& frame, const Poll& poll,
                                const Reception& reception) const noexcept;
  // In the slot under way.
  [[nodiscard]] std::uint16_t expected_tag() const noexcept;
  // The record of that tag, or the one to be given up for it.
  [[nodiscard]] Record& record_of(std::uint16_t tag) noexcept;
  void close(const Frame& frame, const Final& final, const Reception& reception) noexcept;
  Step listen_on_or(ranging::ClockTime now) noexcept;
  Step doing(const Action& action) noexcept;
  void end_superframe() noexcept;

  Station station_;
  AnchorMembership membership_;
  Phase phase_ = Phase::kControl;
  Action doing_;
  [[nodiscard]] Place place() const noexcept { return {slots_of_, static_cast<std::uint8_t>(slot_)}; }

  std::uint32_t slots_of_ = 0;                   // superframe
  std::size_t next_slot_ = 0;                    // in it
  std::size_t slot_ = 0;                         // under way
  std::array<std::uint8_t, kMaxTags> silent_{};  // superframes in which no POLL came, of each slot
  std::uint32_t polls_missing_ = 0;              // superframes without a POLL that names this anchor
  ranging::ClockTime poll_heard_{};
  std::size_t polled_ = 0;      // anchors that the POLL named
  Record* answered_ = nullptr;  // of the POLL's sender
  std::array<Record, kMaxTags> records_{};
};

}  // namespace groma::mac
