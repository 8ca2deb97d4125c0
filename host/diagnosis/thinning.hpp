// Thinning of samples whose tags and anchors come in a cycle.
#pragma once

#include <cmath>
#include <cstdint>
#include <numbers>

namespace groma::diagnosis {

// Whether the sample of this number is kept, of a share of all. Multiples of the golden ratio are spread
// evenly over every cycle, where each third sample would be of one tag of three.
[[nodiscard]] inline bool is_kept(std::uint64_t number, double share) noexcept {
  const double turns = static_cast<double>(number) * (std::numbers::phi - 1.0);
  return turns - std::floor(turns) < share;
}

}  // namespace groma::diagnosis
