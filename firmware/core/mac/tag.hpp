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

class Tag final : public Station {
 public:
  // `counters` outlives the tag. The tag polls once the schedule or a beacon assigns it a slot, unless that
  // is lent.
  Tag(const Site& site, groma_Counters& counters) noexcept;

  std::size_t precompute() noexcept;
  // The action that follows the listening in progress whatever it brings, so that it can be armed before its
  // result is known. Nothing if it depends on the result.
  [[nodiscard]] std::optional<Action> next_rx_window() const noexcept;

  // Evaluates the last exchange and chooses the anchors of the next one. Call when there is time; otherwise
  // the POLL does it.
  void choose_anchors() noexcept;
  [[nodiscard]] TagMembership& membership() noexcept { return membership_; }
  [[nodiscard]] const TagMembership& membership() const noexcept { return membership_; }

 private:
  enum class Phase : std::uint8_t { kPoll, kResponses, kFinal };  // of the slot

  [[nodiscard]] std::optional<Action> slot_action(ClockTime now) noexcept override;
  [[nodiscard]] Place slot_place() const noexcept override { return {current().superframe, current().slot}; }
  [[nodiscard]] Step slot_transmitted(ClockTime timestamp) noexcept override;
  [[nodiscard]] Step slot_received(const Reception& reception) noexcept override;
  [[nodiscard]] Step slot_timeout(ClockTime now) noexcept override { return next_window(now); }
  // A POLL that was not sent leaves no exchange behind.
  [[nodiscard]] Step slot_abandoned(ClockTime now) noexcept override {
    return phase_ == Phase::kPoll ? plan(now) : finish(now);
  }
  void forget_exchanges() noexcept override;

  Action poll(std::uint32_t superframe, std::size_t slot) noexcept;
  [[nodiscard]] ClockTime response_due(std::size_t index) const noexcept {
    return current().poll_sent + superframe().response(index, current().count);
  }
  [[nodiscard]] Action response_window(std::size_t index) const noexcept;
  void take_response(const Frame& frame, const Response& response, const Reception& reception) noexcept;
  void watch_answers() noexcept;
  Step next_window(ClockTime now) noexcept;
  Step finish(ClockTime now) noexcept;

  [[nodiscard]] Exchange& current() noexcept { return exchanges_[current_]; }
  [[nodiscard]] const Exchange& current() const noexcept { return exchanges_[current_]; }
  [[nodiscard]] Exchange& previous() noexcept { return exchanges_[(current_ + 2) % 3]; }

  TagMembership membership_;
  Phase phase_ = Phase::kPoll;
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
