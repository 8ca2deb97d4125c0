// The tag: keeps in step with the master, polls its anchors in its slot, and collects what they answer.
//
//   searching --beacon--> waiting for a beacon / its slot --> POLL --> RESPONSE windows --> [FINAL] -->
//   waiting
//
// Each RESPONSE window is timed from the POLL: an anchor that does not answer costs its own range and nothing
// else. A RESPONSE counts only in its own window, from the anchor whose turn it is, and for the exchange
// under way.
#pragma once

#include <array>
#include <cstdint>

#include "firmware/core/mac/station.hpp"
#include "firmware/core/mac/step.hpp"

namespace groma::mac {

class Tag {
 public:
  // The site's schedule has a slot for site.id. `counters` outlives the tag.
  Tag(const Site& site, groma_Counters& counters) noexcept;

  [[nodiscard]] Step start(ranging::ClockTime now) noexcept;
  [[nodiscard]] Step on_transmitted(ranging::ClockTime stamp) noexcept;
  [[nodiscard]] Step on_late(ranging::ClockTime now) noexcept;
  [[nodiscard]] Step on_received(const Reception& reception) noexcept;
  [[nodiscard]] Step on_timeout(ranging::ClockTime now) noexcept;
  [[nodiscard]] Step on_error(ranging::ClockTime now) noexcept { return on_timeout(now); }
  // The radio was stopped, whatever it was at, and is there again: goes on with what lies ahead, in step as
  // far as the clock filter carries; a master goes on with its own count.
  [[nodiscard]] Step resume(ranging::ClockTime now) noexcept;

  [[nodiscard]] const Station& station() const noexcept { return station_; }
  // The one under way, of the master's count.
  [[nodiscard]] std::uint32_t superframe_number() const noexcept { return superframe_; }

 private:
  enum class Phase : std::uint8_t { kSearching, kBeacon, kPoll, kResponses, kFinal };

  // What comes next outside of an exchange, its preamble after `now`.
  Action plan(ranging::ClockTime now) noexcept;
  Action poll() noexcept;
  [[nodiscard]] Action response_window() noexcept;
  void take_response(const Frame& frame, const Response& response, const Reception& reception) noexcept;
  Step next_window(ranging::ClockTime now) noexcept;
  Step finish(ranging::ClockTime now) noexcept;
  Step listen_on_or(ranging::ClockTime now) noexcept;
  Step listening(const Action& action, const Exchange* completed = nullptr) noexcept;

  [[nodiscard]] Exchange& current() noexcept { return exchanges_[current_]; }
  [[nodiscard]] Exchange& previous() noexcept { return exchanges_[(current_ + 2) % 3]; }

  Station station_;
  std::size_t slot_ = 0;
  Phase phase_ = Phase::kSearching;
  Action listening_;
  std::uint32_t superframe_ = 0;  // of the next beacon or slot
  bool beacon_next_ = false;      // the beacon of superframe_ comes before its slot
  std::uint16_t next_number_ = 0;
  std::size_t window_ = 0;
  // Under way, the one before that waits for its closing stamps, and the one before that, just complete.
  std::array<Exchange, 3> exchanges_{};
  std::size_t current_ = 0;
  bool previous_valid_ = false;
};

}  // namespace groma::mac
