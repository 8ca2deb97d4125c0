// Tracks the master's clock by the timestamps of its beacons.
//
// A Kalman filter with two states: this node's clock at the master's reference instant, and its rate against
// the master's clock (docs/explanation/network.md#the-clock-filter).
#pragma once

#include <cmath>
#include <cstdint>
#include <optional>

#include "firmware/core/ranging/device_time.hpp"

namespace groma::mac {

using ranging::ClockTime;
using ranging::Ticks;

class ClockTracker {
 public:
  // Initializes the filter: this node's clock showed `local` at the instant `master` (in ticks of the
  // master's clock, any origin). `master_offset_ppb`: the master's clock against this one's, from the
  // carrier, with standard deviation `offset_sigma_ppb`.
  void seed(Ticks master, ClockTime local, std::int32_t master_offset_ppb,
            std::int32_t offset_sigma_ppb = 1'000) noexcept {
    const float rate_sigma_tps = static_cast<float>(offset_sigma_ppb) * kTicksPerSecondPerPpb;
    reference_master_ = master;
    reference_local_ = local;
    fraction_ticks_ = 0.0F;
    rate_ticks_per_s_ = -static_cast<float>(master_offset_ppb) * kTicksPerSecondPerPpb;
    covariance_ = {kTimestampSigma_ticks * kTimestampSigma_ticks, 0.0F, rate_sigma_tps * rate_sigma_tps};
  }

  // Updates with a later instant. `path_sigma_ticks`: standard deviation in addition to the timestamp's own.
  // Returns false and leaves the state unchanged if the innovation exceeds 5 us plus 6 sigma: a reflection,
  // another master, or a clock that jumped.
  bool update(Ticks master, ClockTime local_time, float path_sigma_ticks = 0.0F) noexcept {
    const float dt = seconds_since_reference(master);
    const Covariance prior = predicted(dt);
    const float correction = fraction_ticks_ + rate_ticks_per_s_ * dt;
    const Ticks whole = local_time - (reference_local_ + (master - reference_master_));
    const float innovation = static_cast<float>(whole.count()) - correction;

    const float noise = kTimestampSigma_ticks * kTimestampSigma_ticks + path_sigma_ticks * path_sigma_ticks;
    const float variance = prior.offset + noise;
    if (std::fabs(innovation) > kGateFloor_ticks + kGateSigmas * std::sqrt(variance)) return false;

    const float gain_offset = prior.offset / variance;
    const float gain_rate = prior.cross / variance;
    // The timestamp becomes the reference, so that the fraction stays small and exact.
    reference_master_ = master;
    reference_local_ = local_time;
    fraction_ticks_ = (gain_offset - 1.0F) * innovation;
    rate_ticks_per_s_ += gain_rate * innovation;
    // Joseph form: stays positive in single precision.
    const float keep = 1.0F - gain_offset;
    covariance_ = {keep * keep * prior.offset + gain_offset * gain_offset * noise,
                   keep * (prior.cross - gain_rate * prior.offset) + gain_offset * gain_rate * noise,
                   prior.rate - 2.0F * gain_rate * prior.cross + gain_rate * gain_rate * variance};
    return true;
  }

  // The following instants arrive by another path: increases the offset's variance and leaves the rate's.
  void widen(float offset_sigma_ticks) noexcept {
    covariance_.offset += offset_sigma_ticks * offset_sigma_ticks;
  }

  // Moves the reference to `master` without changing predictions, so that a clock without further updates
  // stays exact.
  void rebase(Ticks master) noexcept {
    const float dt = seconds_since_reference(master);
    const float correction = fraction_ticks_ + rate_ticks_per_s_ * dt;
    const Ticks whole(std::llround(correction));
    covariance_ = predicted(dt);
    reference_local_ += (master - reference_master_) + whole;
    reference_master_ = master;
    fraction_ticks_ = correction - static_cast<float>(whole.count());
  }

  // This node's clock at the master's instant, rounded to a tick; valid up to 20 s from the last update.
  [[nodiscard]] ClockTime local(Ticks master) const noexcept {
    // Whole ticks stay integers; only the correction, a few millionths of them, is a float.
    const float correction = fraction_ticks_ + rate_ticks_per_s_ * seconds_since_reference(master);
    return reference_local_ + (master - reference_master_) + Ticks(std::llround(correction));
  }
  // The standard deviation of local(), rounded up.
  [[nodiscard]] Ticks sigma(Ticks master) const noexcept {
    return Ticks(std::llround(std::ceil(std::sqrt(predicted(seconds_since_reference(master)).offset))));
  }

  // Inverse of local(): the master's instant when this node's clock shows `local`, to a few ticks.
  [[nodiscard]] Ticks master(ClockTime local_time) const noexcept {
    const Ticks elapsed = local_time - reference_local_;
    const float seconds = static_cast<float>(elapsed.count()) / kTicksPerSecond;
    // The neglected term, the rate squared, amounts to 8 ns over 20 s.
    const float relative = rate_ticks_per_s_ / kTicksPerSecond;
    const float correction = (fraction_ticks_ + rate_ticks_per_s_ * seconds) * (1.0F - relative);
    return reference_master_ + elapsed - Ticks(std::llround(correction));
  }

  // This node's clock against the master's, in parts per 10^9; positive: this one is fast.
  [[nodiscard]] std::int32_t skew_ppb() const noexcept {
    return static_cast<std::int32_t>(std::lround(rate_ticks_per_s_ / kTicksPerSecondPerPpb));
  }

 private:
  static constexpr auto kTicksPerSecond = static_cast<float>(Ticks::kPerSecond);
  static constexpr float kTicksPerSecondPerPpb = kTicksPerSecond * 1e-9F;
  // Standard deviation of a receive timestamp, including reflections: 0.2 ns.
  static constexpr float kTimestampSigma_ticks = 13.0F;
  // Random walk of the rate, in ticks per second (tps): 0.1 ppm in one second, enough to follow a ramp of 1
  // ppm/s.
  static constexpr float kWalk_tps = 100.0F * kTicksPerSecondPerPpb;
  // A timestamp this far off may still be valid: an overconfident filter must not reject it.
  static constexpr float kGateFloor_ticks = 5e-6F * kTicksPerSecond;
  static constexpr float kGateSigmas = 6.0F;

  // Covariance of (offset, rate), in ticks and ticks per second.
  struct Covariance {
    float offset = 0.0F;
    float cross = 0.0F;
    float rate = 0.0F;
  };
  [[nodiscard]] float seconds_since_reference(Ticks master) const noexcept {
    return static_cast<float>((master - reference_master_).count()) / kTicksPerSecond;
  }
  [[nodiscard]] Covariance predicted(float dt) const noexcept {
    // White noise on the rate's derivative.
    constexpr float kDensity = kWalk_tps * kWalk_tps;
    const float span = std::fabs(dt);
    return {covariance_.offset + 2.0F * dt * covariance_.cross + dt * dt * covariance_.rate +
                kDensity * span * span * span / 3.0F,
            covariance_.cross + dt * covariance_.rate + kDensity * span * dt / 2.0F,
            covariance_.rate + kDensity * span};
  }

  // The clock shows reference_local_ + fraction_ticks_ at the master's instant reference_master_.
  Ticks reference_master_;
  ClockTime reference_local_;
  float fraction_ticks_ = 0.0F;
  float rate_ticks_per_s_ = 0.0F;
  Covariance covariance_;
};

}  // namespace groma::mac
