// A crystal clock with an initial phase, a frequency offset and a frequency drift.
#pragma once

#include <cstdint>
#include <vector>

#include "firmware/sim/time.hpp"

namespace groma::sim {

// The frequency offset grows from from_s to until_s (world time) and stays at the value reached.
struct DriftRamp {
  double ppm_per_s = 0.0;
  double from_s = 0.0;
  double until_s = 0.0;
};

struct ClockSpec {
  double offset_ppm = 0.0;       // positive: fast
  double drift_ppm_per_s = 0.0;  // added to the offset from drift_from_s to drift_until_s of world time
  double drift_from_s = 0.0;
  double drift_until_s = 0.0;
  std::uint64_t first_tick = 0;         // the 40-bit DW1000 counter's value at time 0
  std::vector<DriftRamp> more_ramps{};  // added to each other and to drift_ppm_per_s
};

// A triangle wave of the offset with slope ppm_per_s, between 0 and |height_ppm| with the sign of the slope.
// It lasts from from_s until until_s at the latest; the offset is 0 after the last whole triangle.
[[nodiscard]] std::vector<DriftRamp> up_and_down(double ppm_per_s, double height_ppm, double from_s,
                                                 double until_s);

// Maps world time to local time and back in integers. The frequency is constant over pieces of 2^30 units
// (3.4 ms), and its offset is a multiple of 2^-48. Both maps are therefore exact, monotonic and independent
// of earlier calls.
class NodeClock {
 public:
  NodeClock() noexcept : NodeClock(ClockSpec{}) {}
  // The offset must stay within +-1000 ppm, drift included.
  explicit NodeClock(const ClockSpec& spec) noexcept;

  // Units of this clock since time 0 (1/5 of a nominal tick, as SimTime), rounded down. t must be >= 0.
  [[nodiscard]] std::int64_t local_units(SimTime t) const noexcept;
  // Ticks since time 0 plus first_tick, unwrapped, rounded down.
  [[nodiscard]] std::int64_t ticks(SimTime t) const noexcept;
  // The same plus `plus_ticks`, rounded to the nearest tick.
  [[nodiscard]] std::int64_t nearest_tick(SimTime t, double plus_ticks) const noexcept;

  // The first instant at which ticks() reaches the given value; 0 if that was before time 0.
  [[nodiscard]] SimTime time_of_tick(std::int64_t tick) const noexcept;
  // The first instant at which local_units() reaches the given value.
  [[nodiscard]] SimTime time_of_local(std::int64_t units) const noexcept;

  // Frequency over nominal, minus 1.
  [[nodiscard]] double offset(SimTime t) const noexcept;

 private:
  // Whole units, and their fraction in units of 2^-48.
  struct Phase {
    std::int64_t units;
    std::uint64_t fraction;
  };
  [[nodiscard]] Phase phase(SimTime t) const noexcept;
  [[nodiscard]] std::int64_t offset_of_piece(std::int64_t piece) const noexcept;

  struct Ramp {
    std::int64_t offset_a_piece;  // 2^-48, added at each piece's end while the ramp lasts
    std::int64_t first;           // pieces
    std::int64_t pieces;
  };

  std::int64_t offset_;  // 2^-48
  std::vector<Ramp> ramps_;
  std::int64_t first_tick_;
};

}  // namespace groma::sim
