// What the powers of a range say of its way, as a class.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "host/model/types.hpp"

namespace groma::model {

// By how far the first path is below the whole power, and by how strong that path is for its length.
using PowerClass = std::uint8_t;
inline constexpr std::size_t kHiddenClasses = 3;     // of the power beside the first path
inline constexpr std::size_t kStrengthClasses = 17;  // of the first path's strength; the last: not known
inline constexpr std::size_t kPowerClasses = kHiddenClasses * kStrengthClasses;
inline constexpr PowerClass kNoPowerClass = kPowerClasses;
// Of one strength class: the first path's power, brought to a length of 1 m as in free space.
inline constexpr double kStrengthStep_db = 3.0;

// A range's class; kNoPowerClass where it carries nothing.
[[nodiscard]] PowerClass power_class(const RangeSample& range) noexcept;
[[nodiscard]] constexpr std::size_t hidden_class(PowerClass of) noexcept {
  return of / kStrengthClasses;
}
[[nodiscard]] constexpr std::size_t strength_class(PowerClass of) noexcept {
  return of % kStrengthClasses;
}

// Shares of the hidden classes as the chip's maker tells them: likely in sight, uncertain, unlikely.
inline constexpr std::array<double, kHiddenClasses> kBelievedInSight{0.8, 0.15, 0.05};
inline constexpr std::array<double, kHiddenClasses> kBelievedBlocked{0.4, 0.3, 0.3};

}  // namespace groma::model
