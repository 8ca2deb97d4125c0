// The noise of ranges as their innovations show it. What the configuration or the calibration tells is where
// it begins.
#pragma once

#include <array>
#include <cstddef>

#include "host/filter/config.hpp"
#include "host/filter/state.hpp"

namespace groma::filter {

class RangeTuning {
 public:
  RangeTuning(const SelfTuningConfig& config, double white_sigma_m);

  // Takes note of an innovation of a pair of slots, of that variance, white noise and all.
  void observe(int anchor, int tag, double t_s, double innovation_m, double variance_m2) noexcept;
  // The pairs' past is forgotten, what was learnt of the noise stays.
  void reset() noexcept;

  [[nodiscard]] double white_sigma_m() const noexcept { return white_sigma_m_; }
  // Factor upon the sigma of the slow error.
  [[nodiscard]] double slow_scale() const noexcept { return slow_scale_; }

 private:
  struct Last {
    double t_s = 0.0;
    double innovation_m = 0.0;
    bool heard = false;
  };

  SelfTuningConfig config_;
  double least_sigma_m_ = 0.0;
  double most_sigma_m_ = 0.0;
  double white_sigma_m_ = 0.0;
  double slow_scale_ = 1.0;
  double differences_ = 0.0;  // seen
  std::array<Last, static_cast<std::size_t>(kMaxAnchors) * kMaxTags> last_{};
};

}  // namespace groma::filter
