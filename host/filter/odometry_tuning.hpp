// The noise of odometry, from its samples.
#pragma once

#include <array>
#include <cstddef>

#include "host/model/types.hpp"

namespace groma::filter {

// The white noise of odometry samples. A robot's acceleration hardly changes between samples, so the third
// difference of four equidistant samples is noise of variance 20 sigma^2. vx and vy share one factor on their
// nominal sigmas, because many robots measure only one of them; omega has its own.
class OdometryTuning {
 public:
  explicit OdometryTuning(const model::OdometryNoise& nominal) : nominal_(nominal) {}

  // Adapts to the next sample.
  void observe(const model::OdometrySample& sample) noexcept;
  // Forgets the samples; the noise estimates stay.
  void reset() noexcept { rows_ = 0; }

  // Within a tenth to ten times the nominal sigmas.
  [[nodiscard]] model::OdometryNoise noise() const noexcept;

 private:
  struct Factor {
    double value = 1.0;
    double differences = 0.0;  // number so far
  };

  static void adjust(Factor& factor, double difference, double nominal) noexcept;

  model::OdometryNoise nominal_;
  Factor velocity_;
  Factor turn_;
  std::array<model::OdometrySample, 3> last_{};  // newest first
  std::size_t rows_ = 0;                         // number of valid entries of last_
};

}  // namespace groma::filter
