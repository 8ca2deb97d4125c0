// A class for a range, by its received powers, as evidence of LOS or NLOS.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "host/model/types.hpp"

namespace groma::model {

// Combines how far the first path's power is below the total received power, and how strong the first path is
// for its length.
using PowerClass = std::uint8_t;
inline constexpr std::size_t kHiddenClasses = 3;     // of total power over first-path power
inline constexpr std::size_t kStrengthClasses = 17;  // of the first path's strength; the last: unknown
inline constexpr std::size_t kPowerClasses = kHiddenClasses * kStrengthClasses;
inline constexpr PowerClass kNoPowerClass = kPowerClasses;
// Width of a strength class. Strength is the first path's power, scaled to 1 m by the free-space path loss.
// By hand; NlosSite.PowersReveal... (powers 6 dB weaker in NLOS) and the filter's Powers tests hold with it.
inline constexpr double kStrengthStep_db = 3.0;

// A range's class; kNoPowerClass if the range carries neither powers nor a line-of-sight hint.
[[nodiscard]] PowerClass power_class(const RangeSample& range) noexcept;
[[nodiscard]] constexpr std::size_t hidden_class(PowerClass of) noexcept {
  return of / kStrengthClasses;
}
[[nodiscard]] constexpr std::size_t strength_class(PowerClass of) noexcept {
  return of % kStrengthClasses;
}

// Assumed shares of the hidden classes (LOS likely, uncertain, unlikely by the chip maker's rule), for LOS
// ranges and for NLOS ranges. By hand: a prior that counts as 30 ranges; the same tests hold with them.
inline constexpr std::array<double, kHiddenClasses> kPriorLos{0.8, 0.15, 0.05};
inline constexpr std::array<double, kHiddenClasses> kPriorNlos{0.4, 0.3, 0.3};

}  // namespace groma::model
