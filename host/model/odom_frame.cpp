#include "host/model/odom_frame.hpp"

#include <algorithm>
#include <cmath>

namespace groma::model {

void OdomFrame::take(const OdometrySample& sample) noexcept {
  if (last_) {
    const double held_s = std::clamp(sample.t_s - last_->t_s, 0.0, kLongestHold_s);
    // By the arc of constant velocities, or its chord's direction where it is almost straight.
    const double turn_rad = last_->omega_radps * held_s;
    const double half_rad = 0.5 * turn_rad;
    const double chord = std::abs(half_rad) > 1e-6 ? std::sin(half_rad) / half_rad : 1.0;
    const double heading_rad = at_.theta_rad + half_rad;
    const double dx_m = chord * held_s * last_->vx_mps;
    const double dy_m = chord * held_s * last_->vy_mps;
    at_.x_m += std::cos(heading_rad) * dx_m - std::sin(heading_rad) * dy_m;
    at_.y_m += std::sin(heading_rad) * dx_m + std::cos(heading_rad) * dy_m;
    at_.theta_rad = wrap_angle(at_.theta_rad + turn_rad);
  }
  last_ = sample;
}

std::optional<OdomPose> OdomFrame::pose() const noexcept {
  if (!last_) return std::nullopt;
  const double half_rad = 0.5 * at_.theta_rad;
  return OdomPose{
      last_->t_s, {{at_.x_m, at_.y_m, 0.0}, {0.0, 0.0, std::sin(half_rad), std::cos(half_rad)}}, true};
}

}  // namespace groma::model
