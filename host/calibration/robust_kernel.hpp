// The density of a range residual, and the robust cost that it makes: shape and scale are learnt from the
// residuals themselves, and too long is not treated as too short.
#pragma once

#include <span>

namespace groma::calibration {

// Four kinds of range, mixed:
//   core     N(0, scale^2), in sight
//   wide     N(0, (kWideness scale)^2), in sight but disturbed
//   blocked  the core's noise plus an exponential excess of mean excess_m: never short, only long
//   gross    anything, uniform over kGrossWidth_m
struct KernelShape {
  double scale_m = 0.1;
  double excess_m = 1.0;
  double wide = 0.05;  // shares; the core has what they leave
  double blocked = 0.05;
  double gross = 0.005;

  [[nodiscard]] double core() const noexcept { return 1.0 - wide - blocked - gross; }
};

inline constexpr double kWideness = 2.8284271247461903;  // its square is 8: one exponential serves both
inline constexpr double kGrossWidth_m = 100.0;

// At one residual r = measured - predicted.
struct KernelValue {
  double cost = 0.0;       // -log density
  double slope = 0.0;      // by r, 1/m
  double weight = 0.0;     // curvature of the majorizing parabola, 1/m^2: never negative
  double curvature = 0.0;  // true second derivative, 1/m^2: negative where the kernel redescends
};

// Shares of one residual among the kinds; they sum to one.
struct KernelShares {
  double core = 0.0;
  double wide = 0.0;
  double blocked = 0.0;
  double gross = 0.0;
};

class RobustKernel {
 public:
  RobustKernel() : RobustKernel(KernelShape{}) {}
  explicit RobustKernel(const KernelShape& shape);

  [[nodiscard]] KernelValue at(double residual_m) const noexcept;
  [[nodiscard]] KernelShares shares(double residual_m) const noexcept;
  // Mean of the exponential excess given the residual and that the range was blocked.
  [[nodiscard]] double expected_excess_m(double residual_m) const noexcept;
  [[nodiscard]] const KernelShape& shape() const noexcept { return shape_; }

 private:
  struct Densities;
  [[nodiscard]] Densities densities(double residual_m) const noexcept;

  KernelShape shape_;
  double inverse_scale_;
  double inverse_wide_;
  double inverse_excess_;
  double core_factor_;  // share times the normal density's constant
  double wide_factor_;
  double gross_density_;
};

// What residuals tell of a kernel's shape: sums of the expectation step. Sums of parts are the sum of all.
struct KernelStatistics {
  double count = 0.0;
  double parameters = 0.0;  // degrees of freedom that the fit behind the residuals took
  double narrow = 0.0;      // shares summed
  double wide = 0.0;
  double blocked = 0.0;
  double gross = 0.0;
  double square_m2 = 0.0;  // of core and wide residuals, each over its own width
  double excess_m = 0.0;   // of blocked ones

  KernelStatistics& operator+=(const KernelStatistics& other) noexcept;
};
[[nodiscard]] KernelStatistics kernel_statistics(const RobustKernel& kernel,
                                                 std::span<const double> residuals_m,
                                                 double parameters_used) noexcept;

// What is believed of a kernel before its residuals are seen: as much as so many residuals would tell.
struct KernelPrior {
  KernelShape shape;
  double weight = 10.0;
};

// The maximization step: the shape that prior and statistics make likeliest.
[[nodiscard]] KernelShape likeliest_shape(const KernelStatistics& statistics,
                                          const KernelPrior& prior) noexcept;

// Expectation maximization from prior.shape over the residuals.
[[nodiscard]] KernelShape fit_kernel(std::span<const double> residuals_m, const KernelPrior& prior,
                                     int iterations);

}  // namespace groma::calibration
