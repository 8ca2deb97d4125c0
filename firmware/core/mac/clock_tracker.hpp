// Follows the master's clock through the stamps of its beacons.
//
// Two states, a Kalman filter: when this node's clock shows the master's reference instant, and by how much
// it runs faster. The first beacon's carrier offset seeds the rate, so that one beacon is enough to meet the
// next. Between beacons the rate walks at random, as crystals with temperature do.
#pragma once

#include <cstdint>
#include <optional>

#include "firmware/core/ranging/device_time.hpp"

namespace groma::mac {

class ClockTracker {
 public:
  // Starts anew: a master's instant (in ticks of its clock since any origin of its own) was seen at `local`.
  // `master_offset_ppb`: the master's clock against this one's, from the carrier, with its standard
  // deviation.
  void seed(ranging::Ticks master, ranging::ClockTime local, std::int32_t master_offset_ppb,
            std::int32_t offset_sigma_ppb = 1'000) noexcept;

  // A further instant, later than the one before, whose standard deviation beside the stamp's own is
  // `path_sigma_ticks`. Returns false and leaves the state alone if the stamp is further from its prediction
  // than 5 us and 6 sigma: a reflection, another master, or a clock that jumped.
  bool update(ranging::Ticks master, ranging::ClockTime local, float path_sigma_ticks = 0.0F) noexcept;

  // The instants to come arrive by another path: what is known of the offset is known that much less well,
  // and of the rate as well as before.
  void widen(float offset_sigma_ticks) noexcept;

  // Counts from `master` on without any change to what is predicted: so that a clock that is not updated any
  // more stays exact however long it runs.
  void rebase(ranging::Ticks master) noexcept;

  // Nothing before the first seed().
  [[nodiscard]] bool seeded() const noexcept { return seeded_; }

  // When this node's clock shows the master's instant, rounded to a tick; up to 20 s from the last update.
  [[nodiscard]] ranging::ClockTime local(ranging::Ticks master) const noexcept;
  // The standard deviation of that, rounded up.
  [[nodiscard]] ranging::Ticks sigma(ranging::Ticks master) const noexcept;

  // The inverse: the master's instant at which this node's clock shows `local`, to a few ticks.
  [[nodiscard]] ranging::Ticks master(ranging::ClockTime local) const noexcept;

  // This node's clock against the master's, in parts per 10^9; positive: this one is fast.
  [[nodiscard]] std::int32_t skew_ppb() const noexcept;

 private:
  // Covariance over (offset, rate), in ticks and ticks a second.
  struct Covariance {
    float offset = 0.0F;
    float cross = 0.0F;
    float rate = 0.0F;
  };
  [[nodiscard]] float seconds_since_reference(ranging::Ticks master) const noexcept;
  [[nodiscard]] Covariance predicted(float dt_s) const noexcept;

  bool seeded_ = false;
  // The clock shows reference_local_ + fraction_ at the master's instant reference_master_.
  ranging::Ticks reference_master_;
  ranging::ClockTime reference_local_;
  float fraction_ticks_ = 0.0F;
  float rate_ticks_per_s_ = 0.0F;
  Covariance covariance_;
};

}  // namespace groma::mac
