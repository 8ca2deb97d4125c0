#include "host/filter/odometry_watch.hpp"

#include <algorithm>
#include <cmath>

namespace groma::filter {

namespace {

using model::square;

}  // namespace

void OdometryWatch::reset() noexcept {
  excess_m2ps2_ = 0.0;
  turn_excess_rad2ps2_ = 0.0;
}

OdometryDoubt OdometryWatch::judge(const model::OdometrySample& before, const model::OdometrySample& row,
                                   const model::OdometryNoise& noise) noexcept {
  const double gap_s = std::max(row.t_s - before.t_s, 0.0);
  const double fade = std::exp(-gap_s / config_.lasts_s);
  excess_m2ps2_ *= fade;
  turn_excess_rad2ps2_ *= fade;

  const double sigma_mps = std::max(noise.sigma_vx_mps, noise.sigma_vy_mps);
  const double change_mps = std::hypot(row.vx_mps - before.vx_mps, row.vy_mps - before.vy_mps);
  const double turn_change_radps = std::abs(row.omega_radps - before.omega_radps);
  const double excess_mps =
      std::max(change_mps - config_.max_acceleration_mps2 * gap_s - config_.noise_sigmas * sigma_mps, 0.0);
  double turn_excess_radps = std::max(turn_change_radps - config_.max_turn_acceleration_radps2 * gap_s -
                                          config_.noise_sigmas * noise.sigma_omega_radps,
                                      0.0);
  // A velocity that is not the robot's has another direction, too.
  const double speed_mps = std::max({std::hypot(before.vx_mps, before.vy_mps),
                                     std::hypot(row.vx_mps, row.vy_mps), config_.least_speed_mps});
  turn_excess_radps = std::max(turn_excess_radps, excess_mps / speed_mps);
  if (excess_mps > 0.0 || turn_excess_radps > 0.0) ++jumps_;
  excess_m2ps2_ = std::max(excess_m2ps2_, square(excess_mps));
  turn_excess_rad2ps2_ = std::max(turn_excess_rad2ps2_, square(turn_excess_radps));

  // The error lasts; drawn anew with each row it has to be larger for the same way.
  const double rows = gap_s > 0.0 ? std::max(config_.lasts_s / std::max(gap_s, kLeastGap_s), 1.0) : 1.0;
  return {.velocity_m2ps2 = rows * excess_m2ps2_,
          .turn_rad2ps2 = rows * turn_excess_rad2ps2_,
          .position_m2 = square(excess_mps * config_.lasts_s),
          .heading_rad2 = square(turn_excess_radps * config_.lasts_s)};
}

}  // namespace groma::filter
