// Timestamps of messages, in seconds and nanoseconds.
#pragma once

#include <cmath>
#include <cstdint>

namespace groma::ros2 {

inline constexpr std::uint64_t kNsPerS = 1'000'000'000;

// Times that a message can hold: 31 bits of seconds.
[[nodiscard]] constexpr bool has_timestamp(double t_s) noexcept {
  return t_s >= 0.0 && t_s < 2147483648.0;
}

// Requires has_timestamp().
[[nodiscard]] inline std::uint64_t to_ns(double t_s) noexcept {
  // In two parts, because the product of a time since 1970 has no room for nanoseconds.
  const double whole_s = std::floor(t_s);
  return static_cast<std::uint64_t>(whole_s) * kNsPerS +
         static_cast<std::uint64_t>(std::llround((t_s - whole_s) * 1e9));
}

}  // namespace groma::ros2
