// The tag: follows the network's time, polls its anchors in its slot, and collects their answers.
//
//   Station (search, beacon, shared slot) --> POLL --> RESPONSE windows --> [FINAL] --> Station
//
// Each RESPONSE window is timed from the POLL: an anchor that does not answer costs only its own range. A
// RESPONSE counts only in its own window, from the anchor whose turn it is, and for the exchange in progress.
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
  // `counters` outlives the tag. The tag polls once the schedule or a beacon assigns it a slot, unless that
  // is lent.
  Tag(const Site& site, groma_Counters& counters) noexcept;

  [[nodiscard]] Step start(ranging::ClockTime now) noexcept;
  [[nodiscard]] Step on_transmitted(ranging::ClockTime timestamp) noexcept;
  [[nodiscard]] Step on_late(ranging::ClockTime now) noexcept;
  [[nodiscard]] Step on_received(const Reception& reception) noexcept;
  [[nodiscard]] Step on_timeout(ranging::ClockTime now) noexcept;
  [[nodiscard]] Step on_error(ranging::ClockTime now) noexcept { return on_timeout(now); }
  // Run in the background of other work, see step.hpp.
  void begin_verify(std::span<const std::uint8_t> frame) noexcept;
  void finish_signing() noexcept { station_.finish_signing(); }
  std::size_t precompute() noexcept;
  // Call after the radio was stopped and restarted: continues with the next action, with the time of the
  // clock filter.
  [[nodiscard]] Step resume(ranging::ClockTime now) noexcept;

  // The action that follows the listening in progress whatever it brings, so that it can be armed before its
  // result is known. Nothing if it depends on the result.
  [[nodiscard]] std::optional<Action> next_rx_window() const noexcept;

  [[nodiscard]] const Station& station() const noexcept { return station_; }
  void set_health(const Health& health) noexcept { station_.set_health(health); }
  // Call before resume() if this node's clock has continued by another one, with an error of some us.
  void on_clock_restart() noexcept;
  void attach(ControlChannel& channel) noexcept { station_.attach(channel); }

  // Evaluates the last exchange and chooses the anchors of the next one. Call when there is time; otherwise
  // the POLL does it.
  void choose_anchors() noexcept;
  [[nodiscard]] TagMembership& membership() noexcept { return membership_; }
  [[nodiscard]] const TagMembership& membership() const noexcept { return membership_; }

  // The superframe in progress; after the tag's slot the next one.
  [[nodiscard]] std::uint32_t superframe_number() const noexcept { return station_.superframe_number(); }

 private:
  enum class Phase : std::uint8_t { kControl, kPoll, kResponses, kFinal };

  // The next action outside of an exchange, with its preamble after `now`.
  Action plan(ranging::ClockTime now) noexcept;
  [[nodiscard]] bool has_lent() const noexcept {
    const auto* until_us = station_.site().lent_until_us;
    return until_us != nullptr && until_us->has_value();
  }
  Action poll(std::uint32_t superframe, std::size_t slot) noexcept;
  [[nodiscard]] Action response_window(std::size_t index) const noexcept;
  void take_response(const Frame& frame, const Response& response, const Reception& reception) noexcept;
  // The anchor's leg in the previous exchange; null: the anchor was not polled in it.
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
  // The exchange in progress, the one before, which waits for its closing timestamps, and the completed one
  // before that.
  std::array<Exchange, 3> exchanges_{};
  std::size_t current_ = 0;
  bool previous_valid_ = false;
  std::uint8_t windows_over_ = 0;  // windows of the last exchange that choose_anchors() has not evaluated
  std::uint8_t next_count_ = 0;    // chosen for the next POLL; 0: not chosen yet
  std::array<std::uint16_t, kMaxAnchors> next_anchors_{};
};

}  // namespace groma::mac
