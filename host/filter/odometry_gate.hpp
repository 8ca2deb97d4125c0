// Which odometry samples can be the robot's at all, whatever it drives on: one that no robot can do is
// dropped, and the sample before it holds on. What wheels cannot push but a robot might do is up to
// OdometryWatch.
#pragma once

#include <cstddef>

#include "host/filter/config.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// Whether a robot can change from one sample's velocities to the other's, whatever the time between them.
[[nodiscard]] bool follows(const OdometryGateConfig& config, const model::OdometrySample& before,
                           const model::OdometrySample& sample) noexcept;

class OdometryGate {
 public:
  explicit OdometryGate(const OdometryGateConfig& config) : config_(config) {}

  // Whether the sample can follow the last one that was accepted; before the first, a robot that stands.
  // Dropped samples that follow each other for long enough are believed: no wrong sample locks out the right
  // ones.
  [[nodiscard]] bool accepts(const model::OdometrySample& sample) noexcept;
  void reset() noexcept { *this = OdometryGate(config_); }

 private:
  OdometryGateConfig config_;
  model::OdometrySample accepted_{};
  // The last of those that were dropped since, which follow each other, their number, and the first one's
  // time.
  model::OdometrySample dropped_{};
  std::size_t dropped_count_ = 0;
  double dropped_since_s_ = 0.0;
};

}  // namespace groma::filter
