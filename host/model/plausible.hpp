// Bounds on the samples of a ground robot. A sample beyond them is a fault of its source: it is dropped and
// counted.
#pragma once

#include "host/model/types.hpp"

namespace groma::model {

// By hand: ten times the values of industrial robots.
inline constexpr double kMaxSpeed_mps = 30.0;
inline constexpr double kMaxYawRate_radps = 30.0;
// Physics: twice the circumference of the Earth.
inline constexpr double kMaxCoordinate_m = 8e7;
// For a yaw that counts whole turns: by hand, 160000 of them.
inline constexpr double kMaxAngle_rad = 1e6;
// Variance of a position or an angle (m^2, rad^2): sigmas of 0.01 mm and of 1e9 m. By hand: no sensor
// is as good as the first, and the second means unknown.
inline constexpr double kMinVariance = 1e-10;
inline constexpr double kMaxVariance = 1e18;

[[nodiscard]] bool is_plausible(const OdometrySample& sample) noexcept;
[[nodiscard]] bool is_plausible(const YawRateSample& sample) noexcept;
// Also checks that the covariance is valid.
[[nodiscard]] bool is_plausible(const PositionSample& sample) noexcept;
// Also checks the covariance, if any; z, roll and pitch may be NaN. |roll| and |pitch| have to be below pi/2.
[[nodiscard]] bool is_plausible(const PoseSample& sample) noexcept;

}  // namespace groma::model
