// The simulation's time in integers. A DW1000 tick and a 64 MHz processor cycle are whole numbers of its
// units.
#pragma once

#include <cstdint>
#include <limits>

namespace groma::sim {

// Units of 1/(5 x 63.8976 GHz), 3.13 ps, since the start of the simulation. 63 bits last 334 days.
using SimTime = std::int64_t;

inline constexpr SimTime kUnitsPerSecond = 319'488'000'000;
inline constexpr SimTime kUnitsPerMillisecond = kUnitsPerSecond / 1'000;
inline constexpr SimTime kUnitsPerMicrosecond = kUnitsPerSecond / 1'000'000;
inline constexpr SimTime kUnitsPerTick = 5;  // of a DW1000 at its nominal frequency
inline constexpr SimTime kNever = std::numeric_limits<SimTime>::max();

// Rounded to the nearest unit.
[[nodiscard]] constexpr SimTime from_seconds(double t_s) noexcept {
  const double units = t_s * static_cast<double>(kUnitsPerSecond);
  return static_cast<SimTime>(units < 0.0 ? units - 0.5 : units + 0.5);
}

[[nodiscard]] constexpr double to_seconds(SimTime t) noexcept {
  return static_cast<double>(t) / static_cast<double>(kUnitsPerSecond);
}

}  // namespace groma::sim
