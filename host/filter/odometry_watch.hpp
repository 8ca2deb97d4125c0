// How far a row of odometry is to be believed, by what odometry tells itself: no robot changes its velocity
// faster than its wheels can push. Where rows do, wheels slip, or what computes them went astray.
#pragma once

#include <cstddef>

#include "host/filter/config.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// Variances that a row's noise has beyond OdometryNoise, and what the pose deserves at once.
struct OdometryDoubt {
  double velocity_m2ps2 = 0.0;  // of each axis, white from row to row
  double turn_rad2ps2 = 0.0;
  double position_m2 = 0.0;  // of each axis, for what went wrong before it showed
  double heading_rad2 = 0.0;
};

// Between two rows at least, where their noise is by their number a second.
inline constexpr double kLeastGap_s = 1e-6;

class OdometryWatch {
 public:
  explicit OdometryWatch(const OdometryWatchConfig& config) : config_(config) {}

  // Of a row that follows another one, both of that white noise.
  OdometryDoubt judge(const model::OdometrySample& before, const model::OdometrySample& row,
                      const model::OdometryNoise& noise) noexcept;
  void reset() noexcept;
  // Rows that jumped.
  [[nodiscard]] std::size_t jumps() const noexcept { return jumps_; }

 private:
  OdometryWatchConfig config_;
  double excess_m2ps2_ = 0.0;  // fading squares of what jumps were too large by
  double turn_excess_rad2ps2_ = 0.0;
  std::size_t jumps_ = 0;
};

}  // namespace groma::filter
