#include "host/calibration/robust_kernel.hpp"

#include <numbers>
#include <numeric>

namespace groma::calibration {
namespace {

constexpr double kInverseSqrtTwoPi = std::numbers::inv_sqrtpi / std::numbers::sqrt2;
// By hand; a unit of DW1000 timestamps, 15.65 ps, is 4.7 mm.
constexpr double kMinScale_m = 0.005;
// By hand: some 3 sigmas wide; 8, not 9, because one exponential then served core and wide (exp(-u^2/16)^8).
constexpr double kWideVariance = 8.0;
// 3 sigmas of the core: see the kinds in the header.
constexpr double kFirstBump = 3.0;
// Densities below this are negligible next to gross, and their products would be slow, subnormal floats.
constexpr double kNoDensity = 1e-30;

}  // namespace

double KernelShape::blocked() const noexcept {
  return std::accumulate(bumps.begin(), bumps.end(), 0.0);
}

KernelShape KernelShape::with_nlos(double share) const noexcept {
  KernelShape out = *this;
  out.bumps.fill(share / static_cast<double>(kBumps));
  return out;
}

const KindTable& KindTable::instance() noexcept {
  static const KindTable kTable;
  return kTable;
}

KindTable::KindTable() noexcept {
  center_ << 0.0, 0.0, KindVector::Zero().tail<kKinds - 2>();
  inverse_variance_ << 1.0, 1.0 / kWideVariance, KindVector::Zero().tail<kKinds - 2>();
  double center = kFirstBump;
  for (Eigen::Index kind = 2; kind < kKinds; ++kind, center *= 2.0) {
    center_(kind) = center;
    inverse_variance_(kind) = 1.0 / (center * center / (kFirstBump * kFirstBump) + 1.0);
  }
  const auto fill = [this](double begin, double low, double high, double per_scale) {
    const auto first = static_cast<std::size_t>(begin);
    const auto last = static_cast<std::size_t>((high - low) * per_scale);
    for (std::size_t i = 0; i <= last; ++i) {
      const auto offset = low + static_cast<double>(i) / per_scale - center_.array();
      const KindVector exact = kInverseSqrtTwoPi * inverse_variance_.array().sqrt() *
                               (-0.5 * inverse_variance_.array() * offset.square()).exp();
      nodes_[first + i] = (exact.array() < kNoDensity).select(KindVector::Zero(), exact).cast<float>();
    }
  };
  fill(0.0, kFineLow, kFineHigh, kNodesPerScale);
  fill(kAbove, kFineHigh, kHigh, 1.0);
  fill(kBelow, kLow, kFineLow, 1.0);
}

RobustKernel::RobustKernel(const KernelShape& shape) noexcept
    : table_(&KindTable::instance()),
      shape_(shape),
      inverse_scale_(1.0 / shape.scale_m),
      gross_density_(shape.gross * inverse_scale_ / kGrossScales) {
  KindVector factors;
  factors << shape.core(), shape.wide, Eigen::Map<const Eigen::Matrix<double, kBumps, 1>>(shape.bumps.data());
  factors *= inverse_scale_;
  const KindVector weight_factors = factors.cwiseProduct(table_->inverse_variance());
  factor_ = factors.cast<float>();
  weight_factor_ = weight_factors.cast<float>();
  influence_factor_ = weight_factors.cwiseProduct(table_->center()).cast<float>();
  KindVector curve = weight_factors.cwiseProduct(table_->inverse_variance());
  for (Eigen::Index power = 0; power < 3; ++power) {
    curve_factors_.col(power) = curve.cast<float>();
    curve = curve.cwiseProduct(table_->center());
  }
}

KernelShares RobustKernel::shares(double residual_m) const noexcept {
  KernelShares out;
  KindFloats densities;
  if (!table_->at(residual_m * inverse_scale_, densities)) return out;
  out.kinds = densities.cwiseProduct(factor_).cast<double>();
  const double inverse_total = 1.0 / (out.kinds.sum() + gross_density_);
  out.kinds *= inverse_total;
  out.gross = gross_density_ * inverse_total;
  return out;
}

KernelStatistics RobustKernel::statistics(std::span<const WeighedResidual> residuals,
                                          double parameters_used) const noexcept {
  KernelStatistics out{.parameters = parameters_used};
  for (const auto& [residual_m, weight] : residuals) {
    out.count += weight;
    KindFloats densities;
    if (!table_->at(residual_m * inverse_scale_, densities)) {
      out.gross += weight;
      continue;
    }
    densities.array() *= factor_.array();
    const double share = weight / (gross_density_ + static_cast<double>(densities.sum()));
    out.kinds += share * densities.cast<double>();
    out.gross += share * gross_density_;
    const double los = static_cast<double>(densities(0)) + static_cast<double>(densities(1)) / kWideVariance;
    out.square_m2 += share * los * residual_m * residual_m;
  }
  return out;
}

KernelStatistics& KernelStatistics::operator+=(const KernelStatistics& other) noexcept {
  count += other.count;
  parameters += other.parameters;
  kinds += other.kinds;
  gross += other.gross;
  square_m2 += other.square_m2;
  return *this;
}

KernelShape likeliest_shape(const KernelStatistics& statistics, const KernelPrior& prior) noexcept {
  KernelShape shape = prior.shape;
  const double total = statistics.count + prior.share_weight;
  if (!(total > 0.0)) return shape;
  const auto share = [&](double seen, double believed) {
    return (seen + prior.share_weight * believed) / total;
  };
  shape.wide = share(statistics.kinds(1), prior.shape.wide);
  for (std::size_t k = 0; k < kBumps; ++k) {
    shape.bumps[k] = share(statistics.kinds(2 + static_cast<Eigen::Index>(k)), prior.shape.bumps[k]);
  }
  shape.gross = share(statistics.gross, prior.shape.gross);
  // Bumps carry no information on the scale: the NLOS excess determines where they are.
  const double los = statistics.kinds(0) + statistics.kinds(1);
  const double free = los - std::min(statistics.parameters, 0.5 * los) + prior.scale_weight;
  const double prior_square_m2 = prior.scale_weight * prior.shape.scale_m * prior.shape.scale_m;
  shape.scale_m = std::max(kMinScale_m, std::sqrt((statistics.square_m2 + prior_square_m2) / free));
  return shape;
}

KernelShape fit_kernel(std::span<const WeighedResidual> residuals, const KernelPrior& prior,
                       int iterations) noexcept {
  KernelShape shape = prior.shape;
  for (int i = 0; i < iterations; ++i) {
    shape = likeliest_shape(RobustKernel(shape).statistics(residuals, 0.0), prior);
  }
  return shape;
}

}  // namespace groma::calibration
