// Adaptive noise: the noise of ranges from their innovations, and that of odometry from its samples. Both
// start at the nominal values of the calibration or the configuration.
#pragma once

#include <array>
#include <cstddef>
#include <limits>

#include "host/filter/config.hpp"
#include "host/filter/state.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

class RangeTuning {
 public:
  explicit RangeTuning(double white_sigma_m)
      : nominal_sigma_m_(white_sigma_m), white_sigma_m_(white_sigma_m) {}

  // Adapts to an innovation of a pair; variance_m2: S, with the white noise.
  void observe(int anchor, int tag, double t_s, double innovation_m, double variance_m2) noexcept;
  // Forgets the pairs' last innovations; the noise estimates stay.
  void reset() noexcept { last_.fill({}); }
  // Forgets those of a slot's pairs: another anchor is active there.
  void renew(int slot) noexcept;

  [[nodiscard]] double white_sigma_m() const noexcept { return white_sigma_m_; }

 private:
  struct Last {
    double t_s = -std::numeric_limits<double>::infinity();
    double innovation_m = 0.0;
  };

  double nominal_sigma_m_;
  double white_sigma_m_;
  double differences_ = 0.0;  // number so far
  std::array<Last, kMaxPairs> last_{};
};

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
