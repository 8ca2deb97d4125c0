// What no ground robot's samples exceed. A sample beyond these bounds is a fault of its source: it is dropped
// and counted.
#pragma once

#include "host/model/types.hpp"

namespace groma::model {

// Ten times what industrial robots do.
inline constexpr double kMaxSpeed_mps = 30.0;
inline constexpr double kMaxYawRate_radps = 30.0;
// Twice the circumference of the Earth.
inline constexpr double kMaxCoordinate_m = 8e7;
// Of a yaw that counts whole turns.
inline constexpr double kMaxAngle_rad = 1e6;
// Of a position's or an angle's variance (m^2, rad^2): a sigma of 0.01 mm, and one of 1e9 m.
inline constexpr double kMinVariance = 1e-10;
inline constexpr double kMaxVariance = 1e18;

[[nodiscard]] bool is_plausible(const OdometrySample& sample) noexcept;
[[nodiscard]] bool is_plausible(const YawRateSample& sample) noexcept;
// With a covariance that can be one.
[[nodiscard]] bool is_plausible(const PositionSample& sample) noexcept;
// With a covariance that can be one, if any; z, roll and pitch may be NaN. A robot does not lie on its side.
[[nodiscard]] bool is_plausible(const PoseSample& sample) noexcept;

}  // namespace groma::model
