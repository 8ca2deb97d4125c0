// Mixture density of a range residual, and the robust cost -log density. Shape and scale are estimated from
// the residuals themselves; the density is asymmetric, because NLOS makes ranges too long.
#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/model/median.hpp"

namespace groma::calibration {

// Kinds of range in the mixture; s is the scale:
//   core   N(0, s^2), LOS
//   wide   N(0, 8 s^2), LOS with a disturbance
//   bumps  N(c s, ((c/3)^2 + 1) s^2) with c = 3, 6, 12 ... 96, NLOS: their shares follow any distribution of
//          the excess, and none has its peak at the core's
//   gross  outliers, uniform over 1000 s
// Origin: NLOS shorter than 3 s is no different from noise (3 sigmas); bumps reach to 9.6 m, outliers over
// 100 m at s = 0.1 m, about the bounds of an earlier exponential kernel. Bumps instead of an exponential
// lower the RMSE at 30 % NLOS from 1.23 to 1.20 times the bound (calibration_campaign).
inline constexpr std::size_t kBumps = 6;
inline constexpr double kGrossScales = 1000.0;

// Kinds except gross, in the order above.
inline constexpr Eigen::Index kKinds = 2 + static_cast<Eigen::Index>(kBumps);
using KindVector = Eigen::Matrix<double, kKinds, 1>;
// For the inner loop: a float is as precise as the table.
using KindFloats = Eigen::Matrix<float, kKinds, 1>;

// Shares by hand: only a start, estimated in each calibration; the CalibrationCampaign tests hold with them
// (NEES 1.0 at 0, 15 and 30 % NLOS).
struct KernelShape {
  double scale_m = 0.1;
  double wide = 0.02;  // shares; the core has the rest
  std::array<double, kBumps> bumps{0.005, 0.005, 0.005, 0.005, 0.005, 0.005};
  double gross = 0.005;

  [[nodiscard]] double blocked() const noexcept;
  [[nodiscard]] double core() const noexcept { return 1.0 - wide - blocked() - gross; }
  // The same with this share divided evenly among the bumps.
  [[nodiscard]] KernelShape with_nlos(double share) const noexcept;
};

// Densities of the kinds at u = r/s, unit scale, tabulated and linear between nodes, with an error below 5e-4
// of each kind's peak.
class KindTable {
 public:
  [[nodiscard]] static const KindTable& instance() noexcept;

  // False if u is outside the table, where only gross remains.
  [[nodiscard]] bool at(double u, KindFloats& densities) const noexcept {
    if (!(u > kLow && u < kHigh)) return false;
    double position = (u - kFineLow) * kNodesPerScale;
    if (u < kFineLow) {
      position = kBelow + u - kLow;
    } else if (u >= kFineHigh) {
      position = kAbove + u - kFineHigh;
    }
    const auto node = static_cast<std::size_t>(position);
    const auto fraction = static_cast<float>(position - static_cast<double>(node));
    densities = nodes_[node] + fraction * (nodes_[node + 1] - nodes_[node]);
    return true;
  }
  [[nodiscard]] const KindVector& center() const noexcept { return center_; }
  [[nodiscard]] const KindVector& inverse_variance() const noexcept { return inverse_variance_; }

 private:
  KindTable() noexcept;

  // Nodes in three pieces: dense where the narrow kinds are, then one per scale above and below. Numerics:
  // the error of linear interpolation, h^2/8 of the largest second derivative, is 1.2e-4 of the core's peak
  // at 1/32 and below 4.9e-4 of the bump's at 48, sigma 16, at 1. The ends are 7 and 9.5 sigmas from the
  // widest bump's center.
  static constexpr double kLow = -128.0;
  static constexpr double kFineLow = -16.0;
  static constexpr double kFineHigh = 60.0;
  static constexpr double kHigh = 400.0;
  static constexpr double kNodesPerScale = 32.0;
  static constexpr double kAbove = (kFineHigh - kFineLow) * kNodesPerScale + 1.0;
  static constexpr double kBelow = kAbove + (kHigh - kFineHigh) + 1.0;
  static constexpr auto kNodes = static_cast<std::size_t>(kBelow + (kFineLow - kLow) + 1.0);

  std::array<KindFloats, kNodes> nodes_;
  KindVector center_;
  KindVector inverse_variance_;
};

// At one residual r = measured - predicted. The cost is -log density.
struct KernelValue {
  double density = 0.0;  // 1/m
  double slope = 0.0;    // of the cost by r, 1/m
  double weight = 0.0;   // curvature of the majorizing parabola, 1/m^2: never negative
};

// Posterior probabilities of the kinds for one residual; they sum to one.
struct KernelShares {
  KindVector kinds = KindVector::Zero();
  double gross = 1.0;

  [[nodiscard]] double los() const noexcept { return kinds(0) + kinds(1); }
};

// The same for kLanes residuals side by side.
inline constexpr Eigen::Index kLanes = 8;
using Lanes = Eigen::Array<double, kLanes, 1>;
struct KernelLanes {
  Lanes density;
  Lanes slope;
  Lanes weight;
};

// A residual and its weight.
struct WeighedResidual {
  double residual_m = 0.0;
  double weight = 1.0;
};

// Sums of the expectation step over residuals; those of parts add up to those of all.
struct KernelStatistics {
  double count = 0.0;
  double parameters = 0.0;                // degrees of freedom used by the fit
  KindVector kinds = KindVector::Zero();  // sums of the posterior probabilities
  double gross = 0.0;
  double square_m2 = 0.0;  // of core and wide residuals, each over its variance at s = 1

  KernelStatistics& operator+=(const KernelStatistics& other) noexcept;
};
class RobustKernel {
 public:
  RobustKernel() : RobustKernel(KernelShape{}) {}
  explicit RobustKernel(const KernelShape& shape) noexcept;

  [[nodiscard]] KernelValue at(double residual_m) const noexcept {
    const double u = residual_m * inverse_scale_;
    KernelValue out{.density = gross_density_};
    KindFloats densities;
    if (!table_->at(u, densities)) return out;
    out.density += static_cast<double>(factor_.dot(densities));
    const auto weighted = static_cast<double>(weight_factor_.dot(densities));
    const double share = inverse_scale_ / out.density;
    out.slope = share * (u * weighted - static_cast<double>(influence_factor_.dot(densities)));
    out.weight = share * inverse_scale_ * weighted;
    return out;
  }
  // A NaN residual has the density of gross, and no slope or weight.
  [[nodiscard]] KernelLanes at(const Lanes& residual_m) const noexcept {
    Lanes u = residual_m * inverse_scale_;
    Lanes density = Lanes::Zero();
    Lanes weighted = Lanes::Zero();
    Lanes influence = Lanes::Zero();
    for (Eigen::Index lane = 0; lane < kLanes; ++lane) {
      KindFloats densities;
      if (!table_->at(u(lane), densities)) {
        u(lane) = 0.0;
        continue;
      }
      density(lane) = static_cast<double>(factor_.dot(densities));
      weighted(lane) = static_cast<double>(weight_factor_.dot(densities));
      influence(lane) = static_cast<double>(influence_factor_.dot(densities));
    }
    KernelLanes out;
    out.density = density + gross_density_;
    const Lanes share = inverse_scale_ / out.density;
    out.slope = share * (u * weighted - influence);
    out.weight = share * inverse_scale_ * weighted;
    return out;
  }
  // Second derivative of the cost, 1/m^2: negative where the kernel redescends.
  [[nodiscard]] double curvature(double residual_m) const noexcept {
    const double u = residual_m * inverse_scale_;
    KindFloats densities;
    if (!table_->at(u, densities)) return 0.0;
    const double total = gross_density_ + static_cast<double>(factor_.dot(densities));
    // Moments of the shares over the variances and over their squares.
    const double inverse = static_cast<double>(weight_factor_.dot(densities)) / total;
    const double mean = u * inverse - static_cast<double>(influence_factor_.dot(densities)) / total;
    const double square = (u * u * static_cast<double>(curve_factors_.col(0).dot(densities)) -
                           2.0 * u * static_cast<double>(curve_factors_.col(1).dot(densities)) +
                           static_cast<double>(curve_factors_.col(2).dot(densities))) /
                          total;
    return (inverse - square + mean * mean) * inverse_scale_ * inverse_scale_;
  }
  [[nodiscard]] KernelShares shares(double residual_m) const noexcept;
  [[nodiscard]] KernelStatistics statistics(std::span<const WeighedResidual> residuals,
                                            double parameters_used) const noexcept;
  [[nodiscard]] const KernelShape& shape() const noexcept { return shape_; }

 private:
  const KindTable* table_;
  KernelShape shape_;
  double inverse_scale_;
  double gross_density_;
  KindFloats factor_;            // shares over the scale
  KindFloats weight_factor_;     // the same over each kind's variance
  KindFloats influence_factor_;  // the same times each kind's center
  // Shares over the scale and each variance squared: times 1, the center and its square.
  Eigen::Matrix<float, kKinds, 3> curve_factors_;
};

// Sum of costs, with one logarithm for many of them.
class CostSum {
 public:
  void add(const KernelValue& value) noexcept { multiply(value.density); }
  // Adds the first `count` lanes.
  void add(const Lanes& density, Eigen::Index count) noexcept {
    // Four at a time: the product of four densities is neither too small nor too large for a double.
    constexpr Eigen::Index kAtOnce = 4;
    if (count == kLanes) {
      multiply(density.head<kAtOnce>().prod());
      multiply(density.tail<kAtOnce>().prod());
      return;
    }
    for (Eigen::Index lane = 0; lane < count; ++lane) multiply(density(lane));
  }
  [[nodiscard]] double cost() const noexcept { return cost_ - std::log(product_); }

 private:
  void multiply(double density) noexcept {
    product_ *= density;
    if (product_ > kSmall && product_ < kLarge) return;
    cost_ -= std::log(product_);
    product_ = 1.0;
  }

  // Numerics: one more factor of such a size does not leave the range of a double, 1e-308 to 1e308.
  static constexpr double kSmall = 1e-150;
  static constexpr double kLarge = 1e150;
  double cost_ = 0.0;
  double product_ = 1.0;
};

// Prior of a kernel's shape, weighted as this many residuals; every caller sets the weights.
struct KernelPrior {
  KernelShape shape;
  double scale_weight = 10.0;
  double share_weight = 10.0;
};

// Maximization step: the most likely shape given prior and statistics.
[[nodiscard]] KernelShape likeliest_shape(const KernelStatistics& statistics,
                                          const KernelPrior& prior) noexcept;

// Expectation maximization over the residuals, starting from prior.shape.
[[nodiscard]] KernelShape fit_kernel(std::span<const WeighedResidual> residuals, const KernelPrior& prior,
                                     int iterations) noexcept;

using model::kSigmaOfMad;
using model::median;

}  // namespace groma::calibration
