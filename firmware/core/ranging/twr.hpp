// Two-way ranging: times of flight from intervals measured by two free-running clocks.
#pragma once

#include <compare>
#include <cstdint>
#include <optional>

#include "firmware/core/ranging/device_time.hpp"

namespace groma::ranging {

inline constexpr double kSpeedOfLight_mps = 299'792'458.0;

// A time of flight in 1/256 tick (0.018 mm), which avoids rounding to whole ticks (4.7 mm).
class FlightTime {
 public:
  static constexpr int kFractionBits = 8;

  constexpr FlightTime() noexcept = default;
  constexpr explicit FlightTime(std::int64_t in_256ths) noexcept : in_256ths_(in_256ths) {}

  [[nodiscard]] constexpr std::int64_t in_256ths() const noexcept { return in_256ths_; }
  [[nodiscard]] constexpr float distance_m() const noexcept {
    constexpr auto kMetresPer256th =
        static_cast<float>(kSpeedOfLight_mps / static_cast<double>(Ticks::kPerSecond) / 256.0);
    return static_cast<float>(in_256ths_) * kMetresPer256th;
  }
  friend constexpr FlightTime operator+(FlightTime a, FlightTime b) noexcept {
    return FlightTime(a.in_256ths_ + b.in_256ths_);
  }
  friend constexpr FlightTime operator-(FlightTime a, FlightTime b) noexcept {
    return FlightTime(a.in_256ths_ - b.in_256ths_);
  }
  friend constexpr bool operator==(FlightTime, FlightTime) noexcept = default;
  friend constexpr std::strong_ordering operator<=>(FlightTime a, FlightTime b) noexcept {
    return a.in_256ths_ <=> b.in_256ths_;
  }

 private:
  std::int64_t in_256ths_ = 0;
};

// The intervals of one double-sided exchange. The tag sends at T1, receives the answer at T2 and sends again
// at T3. The anchor receives at A1, answers at A2 and receives again at A3. The tag's clock measures the two
// tag intervals, the anchor's clock the others.
struct DoubleSidedIntervals {
  Ticks tag_round;     // T2 - T1
  Ticks anchor_reply;  // A2 - A1
  Ticks anchor_round;  // A3 - A2
  Ticks tag_reply;     // T3 - T2
};

// tof = (Ra Rb - Da Db) / (Ra + Rb + Da + Db), rounded to the nearest 1/256 tick: the asymmetric double-sided
// formula. Its error is about tof times the clocks' offset, for any delays. If the distance changes
// uniformly, the result is the time of flight of the answer, from A2 to T2. Nothing if an interval is not
// within 1 and 2^40 - 1 ticks.
[[nodiscard]] std::optional<FlightTime> double_sided(const DoubleSidedIntervals& intervals) noexcept;

// tof = (Tround - Treply (1 - e)) / 2 to within 1/256 tick. e is the responder's clock against the
// initiator's, in parts per 10^9 (positive: fast; |e| up to 10^6). Its error is Treply / 2 times that of e.
// Nothing if an interval is not within 1 and 2^40 - 1 ticks.
[[nodiscard]] std::optional<FlightTime> single_sided(Ticks round, Ticks reply,
                                                     std::int32_t clock_offset_ppb) noexcept;

// The anchor's clock against the tag's in parts per 10^9, positive if the anchor is fast, from the intervals
// T1 to T3 and A1 to A3; rounded, saturated at +-10^6. Intervals as in double_sided().
[[nodiscard]] std::int32_t clock_offset_ppb(const DoubleSidedIntervals& intervals) noexcept;

}  // namespace groma::ranging
