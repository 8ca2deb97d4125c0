// One exchange of a tag with the anchors it polled, and the ranges computed from it.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/radio/link_quality.hpp"
#include "firmware/core/ranging/device_time.hpp"
#include "firmware/core/ranging/twr.hpp"

namespace groma::mac {

enum class RangeStatus : std::uint8_t {
  kOk,
  kNoResponse,          // the anchor's RESPONSE was not received
  kNoClosingTimestamp,  // the anchor missed the closing frame, or its next RESPONSE was not received
  kStale,               // the closing interval that the anchor returned belongs to another exchange
  kBadTimestamp,        // a timestamp was invalid, or the four intervals contradict each other
};

// One anchor's share of the exchange.
struct Leg {
  std::uint16_t anchor = 0;
  bool answered = false;
  bool timestamp_valid = false;
  Health health{};       // of the anchor's chip
  ClockTime received{};  // T2
  Ticks reply{};         // A2 - A1
  radio::LinkQuality quality{};
  enum class Closing : std::uint8_t { kNone, kStale, kHeld };
  Closing closing_state = Closing::kNone;
  Ticks closing{};  // A3 - A2
};

struct Exchange {
  std::uint16_t number = 0;
  std::uint32_t superframe = 0;
  std::uint8_t slot = 0;
  std::uint8_t count = 0;
  std::array<Leg, kMaxAnchors> legs{};
  ClockTime poll_sent{};                    // T1
  std::optional<ClockTime> closing_sent{};  // T3: transmission of the FINAL or of the next POLL
};

struct Range {
  RangeStatus status = RangeStatus::kNoResponse;
  ranging::DoubleSidedIntervals intervals{};  // for kOk
  ranging::FlightTime flight{};               // for kOk: valid at the leg's `received`
  std::int32_t clock_offset_ppb = 0;          // for kOk: anchor's clock against the tag's, from the intervals
};

// Longest time between a RESPONSE and the frame that closes its exchange: far below the 17.2 s at which the
// anchor's interval would wrap unnoticed.
inline constexpr Ticks kMaxClosing = Ticks::from_us(4'000'000);

// A range is kOk only if both clocks agree on the exchange's length to 100 ppm, their offset agrees with the
// carrier's, where the radio measures it, to 5 ppm plus timestamp noise, and the flight time corresponds to
// -10 m to 1 km. A timestamp of the wrong frame fails these tests.
[[nodiscard]] Range evaluate(const Exchange& exchange, const Leg& leg) noexcept;

}  // namespace groma::mac
