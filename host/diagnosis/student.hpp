// Student's t distribution with 3 degrees of freedom, for residuals whose scale is unknown and of which some
// are outliers. The scale is estimated with everything else, so that no configured sigma is trusted.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <span>

#include "host/model/log_product.hpp"
#include "host/model/types.hpp"

namespace groma::diagnosis {

inline constexpr double kFreedom = 3.0;

// Weight of a residual in least squares, 4/3 at zero.
[[nodiscard]] inline double student_weight(double residual, double scale) noexcept {
  return (kFreedom + 1.0) / (kFreedom + model::square(residual / scale));
}
// Sum of -log densities, without their constants.
class StudentCost {
 public:
  explicit StudentCost(double scale) noexcept : scale_(scale) {}

  void add(double residual) noexcept {
    factors_.multiply(1.0 + model::square(residual / scale_) / kFreedom);
    ++count_;
  }
  [[nodiscard]] double sum() const noexcept {
    return 0.5 * (kFreedom + 1.0) * factors_.logarithm() + static_cast<double>(count_) * std::log(scale_);
  }
  [[nodiscard]] std::size_t count() const noexcept { return count_; }

 private:
  double scale_;
  model::LogProduct factors_;
  std::size_t count_ = 0;
};
// The maximum-likelihood scale of the finite residuals, by the EM iteration from `scale`; not below `least`.
[[nodiscard]] inline double student_scale(std::span<const double> residuals, double scale, double least,
                                          int iterations = 1) noexcept {
  for (int i = 0; i < iterations; ++i) {
    double sum = 0.0;
    double count = 0.0;
    for (const double residual : residuals) {
      if (!std::isfinite(residual)) continue;
      sum += student_weight(residual, scale) * residual * residual;
      count += 1.0;
    }
    if (count == 0.0) return scale;
    scale = std::max(least, std::sqrt(sum / count));
  }
  return scale;
}

}  // namespace groma::diagnosis
