// The anchor: keeps in step with the master, or is the master, and answers the tags that poll it.
//
//   searching --beacon--> beacon / slot 0 / slot 1 / ... in turn; in a slot: POLL --> RESPONSE --> [FINAL]
//
// The RESPONSE tells the interval A2 - A1 that it will itself have ended, for a delayed transmission's stamp
// is known beforehand, and the closing interval A3 - A2 of the exchange before with this tag. Should the
// RESPONSE not leave at the stamp that it claims, its exchange is never closed and so gives no range.
#pragma once

#include <array>
#include <cstdint>
#include <optional>

#include "firmware/core/mac/station.hpp"
#include "firmware/core/mac/step.hpp"

namespace groma::mac {

class Anchor {
 public:
  // The site's schedule names site.id among its anchors. `counters` outlives the anchor.
  Anchor(const Site& site, groma_Counters& counters) noexcept;

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
  [[nodiscard]] bool is_master() const noexcept {
    return station_.site().id == station_.site().schedule.master_id;
  }

 private:
  enum class Phase : std::uint8_t { kSearching, kBeacon, kPoll, kResponse, kFinal };

  // The last exchange with one tag.
  struct Record {
    bool valid = false;  // its RESPONSE left, at `responded`
    std::uint16_t exchange = 0;
    ranging::ClockTime responded{};           // A2
    std::optional<ranging::Ticks> closing{};  // A3 - A2, where a FINAL told
  };

  Action plan(ranging::ClockTime now) noexcept;
  [[nodiscard]] Action beacon() noexcept;
  // The answer to a POLL heard in this slot, if it asks for one.
  [[nodiscard]] std::optional<Action> answer(const Frame& frame, const Poll& poll,
                                             const Reception& reception) noexcept;
  void close(const Frame& frame, const Final& final, const Reception& reception) noexcept;
  Step listen_on_or(ranging::ClockTime now) noexcept;
  Step doing(const Action& action) noexcept;

  Station station_;
  Phase phase_ = Phase::kSearching;
  Action doing_;
  std::uint32_t superframe_ = 0;  // under way
  std::size_t next_slot_ = 0;     // in it; past the last one: the next superframe's beacon
  std::size_t slot_ = 0;          // under way
  ranging::ClockTime poll_heard_{};
  std::size_t polled_ = 0;  // anchors that the POLL named
  std::array<Record, kMaxTags> records_{};
};

}  // namespace groma::mac
