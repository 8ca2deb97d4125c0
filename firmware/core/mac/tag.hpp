// The tag: keeps in step with the network, polls its anchors in its slot, and collects what they answer.
//
//   the station's part (searching, beacon, shared slot) --> POLL --> RESPONSE windows --> [FINAL] --> the
//   station's part
//
// Each RESPONSE window is timed from the POLL: an anchor that does not answer costs its own range and nothing
// else. A RESPONSE counts only in its own window, from the anchor whose turn it is, and for the exchange
// under way.
#pragma once

#include <array>
#include <cstdint>
#include <optional>

#include "firmware/core/mac/membership.hpp"
#include "firmware/core/mac/station.hpp"
#include "firmware/core/mac/step.hpp"

namespace groma::mac {

class Tag {
 public:
  // `counters` outlives the tag. Polls once the schedule or a beacon gives it a slot.
  Tag(const Site& site, groma_Counters& counters) noexcept;

  [[nodiscard]] Step start(ranging::ClockTime now) noexcept;
  [[nodiscard]] Step on_transmitted(ranging::ClockTime stamp) noexcept;
  [[nodiscard]] Step on_late(ranging::ClockTime now) noexcept;
  [[nodiscard]] Step on_received(const Reception& reception) noexcept;
  [[nodiscard]] Step on_timeout(ranging::ClockTime now) noexcept;
  [[nodiscard]] Step on_error(ranging::ClockTime now) noexcept { return on_timeout(now); }
  // What can be done beside other things, see step.hpp.
  void glance(std::span<const std::uint8_t> frame) noexcept;
  void complete() noexcept { station_.complete(); }
  std::size_t prepare() noexcept;
  // After what a Step asked for is armed: takes back what the last frame brought where its code does not fit.
  // Its bytes are still there.
  void check() noexcept;
  // The radio was stopped, whatever it was at, and is there again: goes on with what lies ahead, in step as
  // far as the clock filter carries.
  [[nodiscard]] Step resume(ranging::ClockTime now) noexcept;

  // What follows the listening under way, whatever comes of it: so that it can be armed before it is known
  // what came. Nothing where that depends.
  [[nodiscard]] std::optional<Action> ahead() const noexcept;

  [[nodiscard]] const Station& station() const noexcept { return station_; }
  void set_health(const Health& health) noexcept { station_.set_health(health); }
  void attach(ControlChannel& channel) noexcept { station_.attach(channel); }
  // While it is lent somebody else polls in its slot and in its name.
  void lend(bool lent) noexcept { lent_ = lent; }

  // Learns from the last exchange and chooses the next one's anchors: where there is time for it. It is done
  // with the POLL otherwise.
  void choose_anchors() noexcept;
  [[nodiscard]] TagMembership& membership() noexcept { return membership_; }
  [[nodiscard]] const TagMembership& membership() const noexcept { return membership_; }

  // The one under way, or after its slot the next one.
  [[nodiscard]] std::uint32_t superframe_number() const noexcept { return station_.superframe_number(); }

 private:
  enum class Phase : std::uint8_t { kControl, kPoll, kResponses, kFinal };

  // What comes next outside of an exchange, its preamble after `now`.
  Action plan(ranging::ClockTime now) noexcept;
  Action poll(std::uint32_t superframe, std::size_t slot) noexcept;
  [[nodiscard]] Action response_window(std::size_t index) const noexcept;
  void take_response(const Frame& frame, const Response& response, const Reception& reception) noexcept;
  // Of the exchange before; nothing: it did not poll that anchor.
  [[nodiscard]] Leg* previous_leg(std::uint16_t anchor) noexcept;
  void watch_answers() noexcept;
  Step next_window(ranging::ClockTime now) noexcept;
  Step finish(ranging::ClockTime now) noexcept;

  [[nodiscard]] Exchange& current() noexcept { return exchanges_[current_]; }
  [[nodiscard]] const Exchange& current() const noexcept { return exchanges_[current_]; }
  [[nodiscard]] Exchange& previous() noexcept { return exchanges_[(current_ + 2) % 3]; }

  Station station_;
  TagMembership membership_;
  Phase phase_ = Phase::kControl;
  std::uint8_t usual_answers_ = 0;  // RESPONSEs in one exchange
  bool was_poor_ = false;
  std::uint8_t unanswered_ = 0;  // exchanges in a row
  std::uint16_t next_number_ = 0;
  std::size_t window_ = 0;
  // Under way, the one before that waits for its closing stamps, and the one before that, just complete.
  std::array<Exchange, 3> exchanges_{};
  std::size_t current_ = 0;
  bool previous_valid_ = false;
  bool lent_ = false;
  // The RESPONSE taken last, until check(): where it is from, and what it filled in.
  struct Unchecked {
    std::span<const std::uint8_t> frame{};
    Place place{};
    Leg* leg = nullptr;
    Leg* closed = nullptr;  // of the exchange before; nothing: it did not poll that anchor
  };
  Unchecked unchecked_;
  std::uint8_t windows_over_ = 0;  // of the exchange before: what became of them is to be learnt from
  std::uint8_t next_count_ = 0;    // chosen for the next POLL; 0: still to be done
  std::array<std::uint16_t, kMaxAnchors> next_anchors_{};
};

}  // namespace groma::mac
