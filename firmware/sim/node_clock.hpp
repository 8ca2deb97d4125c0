// A crystal as it is: started at some phase, off by some parts in a million, drifting with temperature.
#pragma once

#include <cstdint>
#include <vector>

#include "firmware/sim/time.hpp"

namespace groma::sim {

// A stretch of world time over which the offset grows, and stays at what it has grown to.
struct DriftRamp {
  double ppm_per_s = 0.0;
  double from_s = 0.0;
  double until_s = 0.0;
};

struct ClockSpec {
  double offset_ppm = 0.0;       // fast is positive
  double drift_ppm_per_s = 0.0;  // added to the offset from drift_from_s to drift_until_s of world time
  double drift_from_s = 0.0;
  double drift_until_s = 0.0;
  std::uint64_t first_tick = 0;         // the 40-bit DW1000 counter's value at time 0
  std::vector<DriftRamp> more_ramps{};  // they add up, with each other and with drift_ppm_per_s
};

// Up and down at ppm_per_s, a triangle between 0 and `height_ppm` (of the slope's sign) from from_s until
// until_s at the latest; back at 0 after the last whole one.
[[nodiscard]] std::vector<DriftRamp> up_and_down(double ppm_per_s, double height_ppm, double from_s,
                                                 double until_s);

// Maps world time to the clock's own and back, in whole numbers: the frequency is constant over pieces of
// 2^30 units (3.4 ms) and a whole number of 2^-48 parts there, so that both ways are exact, strictly in order
// and free of history.
class NodeClock {
 public:
  NodeClock() noexcept : NodeClock(ClockSpec{}) {}
  // Offsets stay within +-1000 ppm over the drift.
  explicit NodeClock(const ClockSpec& spec) noexcept;

  // Units of this clock since time 0 (of 1/5 nominal tick, as SimTime), rounded down. t not negative.
  [[nodiscard]] std::int64_t local_units(SimTime t) const noexcept;
  // Ticks since time 0 plus first_tick, not wrapped, rounded down.
  [[nodiscard]] std::int64_t ticks(SimTime t) const noexcept;
  // The same with a real number of ticks added before it is rounded to the nearest tick.
  [[nodiscard]] std::int64_t nearest_tick(SimTime t, double plus_ticks) const noexcept;

  // The first instant at which ticks() reaches the given value; 0 if it was before the beginning.
  [[nodiscard]] SimTime time_of_tick(std::int64_t tick) const noexcept;
  // The first instant at which local_units() reaches the given value.
  [[nodiscard]] SimTime time_of_local(std::int64_t units) const noexcept;

  // Frequency over nominal, minus 1.
  [[nodiscard]] double offset(SimTime t) const noexcept;

 private:
  // Units and their fraction in 2^-48.
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
