#include "host/filter/odometry_gate.hpp"

#include <algorithm>
#include <cmath>

#include "host/model/ablation.hpp"
#include "host/model/plausible.hpp"

namespace groma::filter {

namespace {

using model::square;

// "By hand" is explained in config.hpp.
//
// Physics: a fast robot (3.5 m/s, 4 rad/s) that reverses between two samples (see follows()). In simulated
// drives the largest change is 0.15 m/s and 0.07 rad/s, in recorded ones half of these limits.
constexpr double kMaxJump_mps = 7.0;
constexpr double kMaxJump_radps = 8.0;
// Dropped samples that are consistent with each other are accepted after this time and number. By hand: more
// than the 20 wrong samples in a row of the simulated Implausible.*.
constexpr double kAgreeing_s = 0.5;
constexpr std::size_t kAgreeingSamples = 20;

constexpr double kMaxTurnAcceleration_radps2 = 10.0;  // by hand
// By which two samples may differ due to their noise. Statistics: 4.2 sigmas of the difference (2e-5).
constexpr double kNoiseSigmas = 6.0;
constexpr double kLasts_s = 0.5;         // duration of an error after a jump. By hand; OdometryWatch.*
constexpr double kLeastSpeed_mps = 1.0;  // bounds the yaw-rate error of a slow robot. By hand
constexpr double kLeastGap_s = 1e-6;     // between two samples. Numerics: avoids a division by zero

}  // namespace

bool follows(const model::OdometrySample& before, const model::OdometrySample& sample) noexcept {
  return std::hypot(sample.vx_mps - before.vx_mps, sample.vy_mps - before.vy_mps) <= kMaxJump_mps &&
         std::abs(sample.omega_radps - before.omega_radps) <= kMaxJump_radps;
}

bool OdometryGate::accepts(const model::OdometrySample& sample) noexcept {
  if (!model::is_plausible(sample)) {
    dropped_count_ = 0;
    return false;
  }
  if (!follows(accepted_, sample) && !model::is_ablated(model::Mechanism::kOdometryGate)) {
    if (dropped_count_ == 0 || !follows(dropped_, sample)) {
      dropped_count_ = 0;
      dropped_since_s_ = sample.t_s;
    }
    dropped_ = sample;
    ++dropped_count_;
    if (dropped_count_ <= kAgreeingSamples || !(sample.t_s - dropped_since_s_ >= kAgreeing_s)) return false;
  }
  accepted_ = sample;
  dropped_count_ = 0;
  return true;
}

double white_factor(double lasts_s, double gap_s) noexcept {
  return gap_s > 0.0 ? std::max(lasts_s / std::max(gap_s, kLeastGap_s), 1.0) : 1.0;
}

OdometryInflation OdometryWatch::judge(const model::OdometrySample& before,
                                       const model::OdometrySample& sample,
                                       const model::OdometryNoise& noise) noexcept {
  const double gap_s = std::max(sample.t_s - before.t_s, 0.0);
  const double fade = std::exp(-gap_s / kLasts_s);
  excess_m2ps2_ *= fade;
  turn_excess_rad2ps2_ *= fade;

  const double sigma_mps = std::max(noise.sigma_vx_mps, noise.sigma_vy_mps);
  const double change_mps = std::hypot(sample.vx_mps - before.vx_mps, sample.vy_mps - before.vy_mps);
  const double turn_change_radps = std::abs(sample.omega_radps - before.omega_radps);
  const double excess_mps =
      std::max(change_mps - max_acceleration_mps2_ * gap_s - kNoiseSigmas * sigma_mps, 0.0);
  double turn_excess_radps = std::max(
      turn_change_radps - kMaxTurnAcceleration_radps2 * gap_s - kNoiseSigmas * noise.sigma_omega_radps, 0.0);
  // A wrong velocity has a wrong direction, too, so it also counts as yaw-rate error.
  const double speed_mps = std::max(
      {std::hypot(before.vx_mps, before.vy_mps), std::hypot(sample.vx_mps, sample.vy_mps), kLeastSpeed_mps});
  turn_excess_radps = std::max(turn_excess_radps, excess_mps / speed_mps);
  if (excess_mps > 0.0 || turn_excess_radps > 0.0) ++jumps_;
  excess_m2ps2_ = std::max(excess_m2ps2_, square(excess_mps));
  turn_excess_rad2ps2_ = std::max(turn_excess_rad2ps2_, square(turn_excess_radps));

  const double rows = white_factor(kLasts_s, gap_s);
  return {.velocity_m2ps2 = rows * excess_m2ps2_,
          .turn_rad2ps2 = rows * turn_excess_rad2ps2_,
          .position_m2 = square(excess_mps * kLasts_s),
          .heading_rad2 = square(turn_excess_radps * kLasts_s)};
}

}  // namespace groma::filter
