// Tracks the master's clock by the timestamps of its beacons.
//
// A Kalman filter with two states: this node's clock at the master's reference instant, and its rate against
// the master's clock (docs/explanation/network.md#the-clock-filter).
#pragma once

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
            std::int32_t offset_sigma_ppb = 1'000) noexcept;

  // Updates with a later instant. `path_sigma_ticks`: standard deviation in addition to the timestamp's own.
  // Returns false and leaves the state unchanged if the innovation exceeds 5 us plus 6 sigma: a reflection,
  // another master, or a clock that jumped.
  bool update(Ticks master, ClockTime local, float path_sigma_ticks = 0.0F) noexcept;

  // The following instants arrive by another path: increases the offset's variance and leaves the rate's.
  void widen(float offset_sigma_ticks) noexcept;

  // Moves the reference to `master` without changing predictions, so that a clock without further updates
  // stays exact.
  void rebase(Ticks master) noexcept;

  // This node's clock at the master's instant, rounded to a tick; valid up to 20 s from the last update.
  [[nodiscard]] ClockTime local(Ticks master) const noexcept;
  // The standard deviation of local(), rounded up.
  [[nodiscard]] Ticks sigma(Ticks master) const noexcept;

  // Inverse of local(): the master's instant when this node's clock shows `local`, to a few ticks.
  [[nodiscard]] Ticks master(ClockTime local) const noexcept;

  // This node's clock against the master's, in parts per 10^9; positive: this one is fast.
  [[nodiscard]] std::int32_t skew_ppb() const noexcept;

 private:
  // Covariance of (offset, rate), in ticks and ticks per second.
  struct Covariance {
    float offset = 0.0F;
    float cross = 0.0F;
    float rate = 0.0F;
  };
  [[nodiscard]] float seconds_since_reference(Ticks master) const noexcept;
  [[nodiscard]] Covariance predicted(float dt_s) const noexcept;

  // The clock shows reference_local_ + fraction_ticks_ at the master's instant reference_master_.
  Ticks reference_master_;
  ClockTime reference_local_;
  float fraction_ticks_ = 0.0F;
  float rate_ticks_per_s_ = 0.0F;
  Covariance covariance_;
};

}  // namespace groma::mac
