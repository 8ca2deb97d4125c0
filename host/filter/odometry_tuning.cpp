#include "host/filter/odometry_tuning.hpp"

#include <algorithm>
#include <cmath>

#include "host/model/ablation.hpp"

namespace groma::filter {

namespace {

// "By hand" is explained in config.hpp.
//
// Statistics: the median of |x| of a standard Gaussian.
constexpr double kHalfWithin = 0.6744897501960817;
// Statistics: the third difference x0 - 3 x1 + 3 x2 - x3 of white noise has the variance
// (1 + 9 + 9 + 1) sigma^2.
constexpr double kThirdDifference = 4.47213595499958;
constexpr double kMaxGap_s = 0.3;  // samples further apart show motion, not noise. By hand; OdometryTuning.*
constexpr double kUneven = 0.3;    // relative difference allowed between gaps. By hand
// Bound of the factor on the nominal sigma, up and down. By hand; OdometryTuning.* find factors of 0.12 to 8.
constexpr double kMostFactor = 10.0;

// Median tracking: the factor 1 + step or 1 - step on a sigma. `half`: the median expected of |difference|;
// differences: number of differences so far, with which the step shrinks from 0.05 to 0.003 (by hand).
double adjustment(double differences, double difference, double half) noexcept {
  const double step = std::max(0.003, 0.05 / (1.0 + differences / 100.0));
  return 1.0 + (std::abs(difference) > half ? step : -step);
}

}  // namespace

void OdometryTuning::observe(const model::OdometrySample& sample) noexcept {
  const double gap_s = rows_ > 0 ? sample.t_s - last_[0].t_s : 0.0;
  bool even = rows_ == last_.size() && gap_s <= kMaxGap_s;
  for (std::size_t i = 0; even && i + 1 < last_.size(); ++i) {
    const double other_s = last_[i].t_s - last_[i + 1].t_s;
    even = std::abs(other_s - gap_s) <= kUneven * gap_s;
  }
  if (even) {
    const auto difference = [&](double model::OdometrySample::*axis) {
      return sample.*axis - 3.0 * last_[0].*axis + 3.0 * last_[1].*axis - last_[2].*axis;
    };
    adjust(velocity_, difference(&model::OdometrySample::vx_mps), nominal_.sigma_vx_mps);
    adjust(velocity_, difference(&model::OdometrySample::vy_mps), nominal_.sigma_vy_mps);
    adjust(turn_, difference(&model::OdometrySample::omega_radps), nominal_.sigma_omega_radps);
  }
  last_ = {sample, last_[0], last_[1]};
  rows_ = std::min(rows_ + 1, last_.size());
}

void OdometryTuning::adjust(Factor& factor, double difference, double nominal) noexcept {
  if (model::is_ablated(model::Mechanism::kOdometryNoise)) return;
  // Exactly zero: the axis is not measured.
  if (difference == 0.0 || !(nominal > 0.0)) return;
  factor.differences += 1.0;
  const double half = kHalfWithin * kThirdDifference * nominal * factor.value;
  factor.value = std::clamp(factor.value * adjustment(factor.differences, difference, half),
                            1.0 / kMostFactor, kMostFactor);
}

model::OdometryNoise OdometryTuning::noise() const noexcept {
  return {nominal_.sigma_vx_mps * velocity_.value, nominal_.sigma_vy_mps * velocity_.value,
          nominal_.sigma_omega_radps * turn_.value, nominal_.sigma_curve};
}

}  // namespace groma::filter
