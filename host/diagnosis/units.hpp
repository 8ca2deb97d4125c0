// Units that are mistaken for SI units, as factors (given over true).
#pragma once

#include <array>
#include <cmath>
#include <numbers>
#include <optional>
#include <string_view>

namespace groma::diagnosis {

struct Unit {
  std::string_view name;
  double factor;  // how many of it are in the SI unit
};
inline constexpr std::array<Unit, 4> kLengthUnits{
    {{"feet", 1.0 / 0.3048}, {"inches", 1.0 / 0.0254}, {"centimetres", 100.0}, {"millimetres", 1000.0}}};
inline constexpr std::array<Unit, 3> kTimeUnits{
    {{"milliseconds", 1e3}, {"microseconds", 1e6}, {"nanoseconds", 1e9}}};
inline constexpr Unit kDegrees{"degrees", 180.0 / std::numbers::pi};

// The unit whose factor is within `tolerance` (relative) of this one; none if there is none.
template <class Units>
[[nodiscard]] std::optional<Unit> unit_of(const Units& units, double factor, double tolerance) noexcept {
  for (const Unit& unit : units) {
    if (std::abs(std::log(factor / unit.factor)) < std::log1p(tolerance)) return unit;
  }
  return std::nullopt;
}

}  // namespace groma::diagnosis
