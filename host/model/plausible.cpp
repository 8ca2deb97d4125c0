#include "host/model/plausible.hpp"

#include <cmath>
#include <numbers>

#include "host/model/pose.hpp"

namespace groma::model {

namespace {

// is_coordinate, is_angle and is_variance are false for NaN.
bool is_coordinate(double value_m) noexcept {
  return std::abs(value_m) <= kMaxCoordinate_m;
}

bool is_angle(double value_rad) noexcept {
  return std::abs(value_rad) <= kMaxAngle_rad;
}

bool is_variance(double variance) noexcept {
  return variance >= kMinVariance && variance <= kMaxVariance;
}

bool is_tilt(double value_rad) noexcept {
  return std::isnan(value_rad) ||
         (is_angle(value_rad) && std::abs(wrap_angle(value_rad)) < std::numbers::pi / 2.0);
}

}  // namespace

bool is_plausible(const OdometrySample& sample) noexcept {
  return std::isfinite(sample.t_s) && std::hypot(sample.vx_mps, sample.vy_mps) <= kMaxSpeed_mps &&
         std::abs(sample.omega_radps) <= kMaxYawRate_radps;
}

bool is_plausible(const YawRateSample& sample) noexcept {
  return std::isfinite(sample.t_s) && std::abs(sample.omega_radps) <= kMaxYawRate_radps;
}

bool is_plausible(const PositionSample& sample) noexcept {
  return std::isfinite(sample.t_s) && is_coordinate(sample.x_m) && is_coordinate(sample.y_m) &&
         is_variance(sample.covariance_m2[0]) && is_variance(sample.covariance_m2[2]) &&
         is_covariance(sample.covariance_m2);
}

bool is_plausible(const PoseSample& sample) noexcept {
  if (!std::isfinite(sample.t_s) || !is_coordinate(sample.x_m) || !is_coordinate(sample.y_m) ||
      !(std::isnan(sample.z_m) || is_coordinate(sample.z_m)) || !is_angle(sample.yaw_rad) ||
      !is_tilt(sample.roll_rad) || !is_tilt(sample.pitch_rad)) {
    return false;
  }
  if (!sample.covariance) return true;
  const auto& [xx, xy, xt, yy, yt, tt] = *sample.covariance;
  return is_variance(xx) && is_variance(yy) && is_variance(tt) && is_covariance(*sample.covariance);
}

}  // namespace groma::model
