// The noise of ranges as their innovations show it, and that of odometry as its rows do. What the
// configuration or the calibration tells is where it begins.
#pragma once

#include <array>
#include <cstddef>

#include "host/filter/config.hpp"
#include "host/filter/state.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

class RangeTuning {
 public:
  explicit RangeTuning(double white_sigma_m) : told_sigma_m_(white_sigma_m), white_sigma_m_(white_sigma_m) {}

  // Takes note of an innovation of a pair of slots, of that variance, white noise and all.
  void observe(int anchor, int tag, double t_s, double innovation_m, double variance_m2) noexcept;
  // The pairs' past is forgotten, what was learnt of the noise stays.
  void reset() noexcept { last_.fill({}); }

  [[nodiscard]] double white_sigma_m() const noexcept { return white_sigma_m_; }
  // Factor upon the sigma of the slow error.
  [[nodiscard]] double slow_scale() const noexcept { return slow_scale_; }

 private:
  struct Last {
    double t_s = 0.0;
    double innovation_m = 0.0;
    bool heard = false;
  };

  double told_sigma_m_;
  double white_sigma_m_;
  double slow_scale_ = 1.0;
  double differences_ = 0.0;  // seen
  std::array<Last, kMaxPairs> last_{};
};

// The white noise of odometry rows. No robot changes its acceleration much from one row to the next: of
// four rows at even times the third difference is noise, of variance 20 sigma^2. vx and vy share a factor
// upon what was told, as many robots measure one alone; omega has its own.
class OdometryTuning {
 public:
  explicit OdometryTuning(const model::OdometryNoise& told) : told_(told) {}

  // Takes note of the next row.
  void observe(const model::OdometrySample& row) noexcept;
  // The rows are forgotten, what was learnt of the noise stays.
  void reset() noexcept { rows_ = 0; }

  // From a tenth to ten times what was told.
  [[nodiscard]] model::OdometryNoise noise() const noexcept;

 private:
  struct Factor {
    double value = 1.0;
    double differences = 0.0;  // seen
  };

  static void adjust(Factor& factor, double difference, double told) noexcept;

  model::OdometryNoise told_;
  Factor velocity_;
  Factor turn_;
  std::array<model::OdometrySample, 3> last_{};  // newest first
  std::size_t rows_ = 0;                         // of last_ that hold one
};

}  // namespace groma::filter
