#include "host/calibration/robust_kernel.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace groma::calibration {
namespace {

constexpr double kInverseSqrtTwoPi = std::numbers::inv_sqrtpi / std::numbers::sqrt2;
constexpr double kMinScale_m = 0.005;
constexpr double kMaxExcess_m = 10.0;
// A blocked range's mean excess below this many scales could not be told from noise.
constexpr double kMinExcessScales = 3.0;

// Ratio of the normal density to its upper tail.
double inverse_mills(double x) noexcept {
  if (x < 8.0) {
    return kInverseSqrtTwoPi * std::exp(-0.5 * x * x) / (0.5 * std::erfc(x / std::numbers::sqrt2));
  }
  // Continued fraction: the tail itself would underflow.
  return x + 1.0 / (x + 2.0 / (x + 3.0 / (x + 4.0 / (x + 5.0 / x))));
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
  const double normal = std::exp(-0.5 * u * u);
  out.core = core_factor_ * normal;
  out.wide = wide_factor_ * std::exp(-0.5 * u * u / (kWideness * kWideness));
  // Normal noise plus an exponential excess: exp(k x - k^2/2) Q(x) / excess with k = scale/excess and
  // x = k - u; and Q(x) = phi(x) / mills(x) makes that phi(u) / (mills(x) excess).
  out.tail_at = shape_.scale_m * inverse_excess_ - u;
  out.mills = inverse_mills(out.tail_at);
  if (out.tail_at < -8.0) {
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

KernelShape fit_kernel(std::span<const double> residuals_m, const KernelPrior& prior, double parameters_used,
                       int iterations) {
  KernelShape shape = prior.shape;
  if (residuals_m.empty()) return shape;
  const double n = static_cast<double>(residuals_m.size());
  for (int i = 0; i < iterations; ++i) {
    const RobustKernel kernel(shape);
    double narrow = 0.0;
    double wide = 0.0;
    double blocked = 0.0;
    double gross = 0.0;
    double square_m2 = 0.0;
    double excess_m = 0.0;
    for (const double r : residuals_m) {
      const KernelShares s = kernel.shares(r);
      narrow += s.core;
      wide += s.wide;
      blocked += s.blocked;
      gross += s.gross;
      square_m2 += (s.core + s.wide / (kWideness * kWideness)) * r * r;
      // A blocked range shows the core's noise too: what is left of it beside the excess.
      const double excess = kernel.expected_excess_m(r);
      excess_m += s.blocked * excess;
    }
    const double pseudo = prior.share_weight;
    const double total = n + pseudo;
    shape.wide = (wide + pseudo * prior.shape.wide) / total;
    shape.blocked = (blocked + pseudo * prior.shape.blocked) / total;
    shape.gross = (gross + pseudo * prior.shape.gross) / total;
    const double prior_square = prior.shape.scale_m * prior.shape.scale_m;
    const double used = std::min(parameters_used, 0.5 * (narrow + wide));
    const double scale = std::sqrt((square_m2 + prior.scale_weight * prior_square) /
                                   std::max(narrow + wide - used + prior.scale_weight, 1e-9));
    shape.scale_m = std::max(scale, kMinScale_m);
    const double prior_blocked = std::max(pseudo * prior.shape.blocked, 1e-9);
    shape.excess_m = std::clamp((excess_m + prior_blocked * prior.shape.excess_m) / (blocked + prior_blocked),
                                kMinExcessScales * shape.scale_m, kMaxExcess_m);
  }
  return shape;
}

}  // namespace groma::calibration
