#include "host/calibration/robust_kernel.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <numbers>

namespace groma::calibration {
namespace {

constexpr double kInverseSqrtTwoPi = std::numbers::inv_sqrtpi / std::numbers::sqrt2;
constexpr double kMinScale_m = 0.005;
constexpr double kMaxExcess_m = 10.0;
// Below this argument the upper tail is one.
constexpr double kFullTail = -5.5;
// A blocked range's mean excess below this many scales could not be told from noise.
constexpr double kMinExcessScales = 3.0;

// Ratio h of the normal density to its upper tail; h' = h (h - x).
double exact_inverse_mills(double x) noexcept {
  return kInverseSqrtTwoPi * std::exp(-0.5 * x * x) / (0.5 * std::erfc(x / std::numbers::sqrt2));
}

// The same, tabulated: cubic Hermite between nodes, since the derivative is known; off by less than 1e-7.
class InverseMills {
 public:
  InverseMills() {
    for (std::size_t i = 0; i < kNodes; ++i) {
      const double x = -kReach + kStep * static_cast<double>(i);
      value_[i] = exact_inverse_mills(x);
      slope_[i] = kStep * value_[i] * (value_[i] - x);
    }
  }

  [[nodiscard]] double operator()(double x) const noexcept {
    if (x <= -kReach) return 0.0;
    // Continued fraction: the tail itself would underflow.
    if (!(x < kReach)) return x + 1.0 / (x + 2.0 / (x + 3.0 / (x + 4.0 / (x + 5.0 / x))));
    const double position = (x + kReach) / kStep;
    const auto i = static_cast<std::size_t>(position);
    const double t = position - static_cast<double>(i);
    const double rise = value_[i + 1] - value_[i];
    const double bend = slope_[i] - rise;
    const double twist = rise - slope_[i + 1];
    return value_[i] + t * (rise + (1.0 - t) * ((1.0 - t) * bend + t * twist));
  }

 private:
  static constexpr double kReach = 8.0;
  static constexpr double kStep = 1.0 / 16.0;
  static constexpr std::size_t kNodes = 257;
  std::array<double, kNodes> value_{};
  std::array<double, kNodes> slope_{};
};

double inverse_mills(double x) noexcept {
  static const InverseMills kTable;
  return kTable(x);
}

}  // namespace

// Each already multiplied by its kind's share.
struct RobustKernel::Densities {
  double core = 0.0;
  double wide = 0.0;
  double blocked = 0.0;
  double gross = 0.0;
  double mills = 0.0;    // of the blocked kind's argument
  double tail_at = 0.0;  // that argument
  double total = 0.0;
};

RobustKernel::RobustKernel(const KernelShape& shape)
    : shape_(shape),
      inverse_scale_(1.0 / shape.scale_m),
      inverse_wide_(1.0 / (kWideness * shape.scale_m)),
      inverse_excess_(1.0 / shape.excess_m),
      core_factor_(shape.core() * kInverseSqrtTwoPi * inverse_scale_),
      wide_factor_(shape.wide * kInverseSqrtTwoPi * inverse_wide_),
      gross_density_(shape.gross / kGrossWidth_m) {}

RobustKernel::Densities RobustKernel::densities(double residual_m) const noexcept {
  const double u = residual_m * inverse_scale_;
  Densities out;
  const double wide = std::exp(-0.5 * u * u / (kWideness * kWideness));
  const double wide_square = wide * wide;
  const double wide_fourth = wide_square * wide_square;
  const double normal = wide_fourth * wide_fourth;
  out.core = core_factor_ * normal;
  out.wide = wide_factor_ * wide;
  // Normal noise plus an exponential excess: exp(k x - k^2/2) Q(x) / excess with k = scale/excess and
  // x = k - u; and Q(x) = phi(x) / mills(x) makes that phi(u) / (mills(x) excess).
  out.tail_at = shape_.scale_m * inverse_excess_ - u;
  out.mills = inverse_mills(out.tail_at);
  if (out.tail_at < kFullTail) {
    const double k = shape_.scale_m * inverse_excess_;
    out.blocked = shape_.blocked * inverse_excess_ * std::exp(0.5 * k * k - residual_m * inverse_excess_);
  } else {
    out.blocked = shape_.blocked * inverse_excess_ * kInverseSqrtTwoPi * normal / out.mills;
  }
  out.gross = gross_density_;
  out.total = out.core + out.wide + out.blocked + out.gross;
  return out;
}

KernelValue RobustKernel::at(double residual_m) const noexcept {
  const Densities d = densities(residual_m);
  const double inverse_total = 1.0 / d.total;
  const double core = d.core * inverse_total;
  const double wide = d.wide * inverse_total;
  const double blocked = d.blocked * inverse_total;

  const double core_slope = residual_m * inverse_scale_ * inverse_scale_;
  const double wide_slope = residual_m * inverse_wide_ * inverse_wide_;
  const double blocked_slope = inverse_excess_ - d.mills * inverse_scale_;

  KernelValue out;
  out.cost = -std::log(d.total);
  out.slope = core * core_slope + wide * wide_slope + blocked * blocked_slope;
  out.weight = core * inverse_scale_ * inverse_scale_ + wide * inverse_wide_ * inverse_wide_ +
               blocked * d.mills * (d.mills - d.tail_at) * inverse_scale_ * inverse_scale_;
  const double mean_square = core * core_slope * core_slope + wide * wide_slope * wide_slope +
                             blocked * blocked_slope * blocked_slope;
  out.curvature = out.weight - (mean_square - out.slope * out.slope);
  return out;
}

KernelShares RobustKernel::shares(double residual_m) const noexcept {
  const Densities d = densities(residual_m);
  const double inverse_total = 1.0 / d.total;
  return {.core = d.core * inverse_total,
          .wide = d.wide * inverse_total,
          .blocked = d.blocked * inverse_total,
          .gross = d.gross * inverse_total};
}

double RobustKernel::expected_excess_m(double residual_m) const noexcept {
  // The excess given r is a normal of mean r - scale^2/excess, cut at zero.
  const double x = shape_.scale_m * inverse_excess_ - residual_m * inverse_scale_;
  return shape_.scale_m * (inverse_mills(x) - x);
}

KernelStatistics& KernelStatistics::operator+=(const KernelStatistics& other) noexcept {
  count += other.count;
  parameters += other.parameters;
  narrow += other.narrow;
  wide += other.wide;
  blocked += other.blocked;
  gross += other.gross;
  square_m2 += other.square_m2;
  excess_m += other.excess_m;
  return *this;
}

KernelStatistics kernel_statistics(const RobustKernel& kernel, std::span<const double> residuals_m,
                                   double parameters_used) noexcept {
  KernelStatistics out;
  out.count = static_cast<double>(residuals_m.size());
  out.parameters = parameters_used;
  for (const double r : residuals_m) {
    const KernelShares s = kernel.shares(r);
    out.narrow += s.core;
    out.wide += s.wide;
    out.blocked += s.blocked;
    out.gross += s.gross;
    out.square_m2 += (s.core + s.wide / (kWideness * kWideness)) * r * r;
    if (s.blocked > 1e-6) out.excess_m += s.blocked * kernel.expected_excess_m(r);
  }
  return out;
}

KernelShape likeliest_shape(const KernelStatistics& statistics, const KernelPrior& prior) noexcept {
  KernelShape shape = prior.shape;
  const double total = statistics.count + prior.weight;
  if (!(total > 0.0)) return shape;
  shape.wide = (statistics.wide + prior.weight * prior.shape.wide) / total;
  shape.blocked = (statistics.blocked + prior.weight * prior.shape.blocked) / total;
  shape.gross = (statistics.gross + prior.weight * prior.shape.gross) / total;
  const double in_sight = statistics.narrow + statistics.wide;
  const double free = in_sight - std::min(statistics.parameters, 0.5 * in_sight) + prior.weight;
  const double prior_square_m2 = prior.shape.scale_m * prior.shape.scale_m;
  shape.scale_m =
      std::max(kMinScale_m, std::sqrt((statistics.square_m2 + prior.weight * prior_square_m2) / free));
  const double prior_blocked = std::max(prior.weight * prior.shape.blocked, 1e-9);
  shape.excess_m = std::clamp(
      (statistics.excess_m + prior_blocked * prior.shape.excess_m) / (statistics.blocked + prior_blocked),
      kMinExcessScales * shape.scale_m, std::max(kMaxExcess_m, kMinExcessScales * shape.scale_m));
  return shape;
}

KernelShape fit_kernel(std::span<const double> residuals_m, const KernelPrior& prior, int iterations) {
  KernelShape shape = prior.shape;
  for (int i = 0; i < iterations; ++i) {
    shape = likeliest_shape(kernel_statistics(RobustKernel(shape), residuals_m, 0.0), prior);
  }
  return shape;
}

}  // namespace groma::calibration
