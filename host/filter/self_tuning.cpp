#include "host/filter/self_tuning.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "host/model/ablation.hpp"

namespace groma::filter {

namespace {

// "By hand" is explained in config.hpp.
//
// Statistics: the median of |x| of a standard Gaussian.
constexpr double kHalfWithin = 0.6744897501960817;
// Ranges that are too long by more than this many sigmas are likely NLOS and are ignored. All ranges that are
// too short count: if the sigma is far too small, they are the only ones that can increase it. Statistics:
// 2.3 % of LOS ranges are longer.
constexpr double kTooLong = 2.0;
// Statistics: the third difference x0 - 3 x1 + 3 x2 - x3 of white noise has the variance
// (1 + 9 + 9 + 1) sigma^2.
constexpr double kThirdDifference = 4.47213595499958;
// Differences of a pair's ranges that are closer in time show white noise. By hand;
// RangeTuning.FindsTheWhiteSigmaDespiteSlowBiasAndNlos (a bias with a period of 21 s).
constexpr double kDifference_s = 3.0;
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

void RangeTuning::observe(int anchor, int tag, double t_s, double innovation_m, double variance_m2) noexcept {
  if (!std::isfinite(innovation_m) || !(variance_m2 > 0.0)) return;
  if (innovation_m > kTooLong * std::sqrt(variance_m2)) return;
  Last& last = last_[pair_at(anchor, tag)];
  const double gap_s = t_s - last.t_s;
  // The slow range bias cancels in the difference of two successive innovations.
  if (gap_s > 0.0 && gap_s < kDifference_s && !model::is_ablated(model::Mechanism::kRangeNoise)) {
    differences_ += 1.0;
    const double half_m = kHalfWithin * std::numbers::sqrt2 * white_sigma_m_;
    white_sigma_m_ =
        std::clamp(white_sigma_m_ * adjustment(differences_, innovation_m - last.innovation_m, half_m),
                   nominal_sigma_m_ / kMostFactor, nominal_sigma_m_ * kMostFactor);
  }
  last = {.t_s = t_s, .innovation_m = innovation_m};
}

void RangeTuning::renew(int slot) noexcept {
  for (int tag = 0; tag < kMaxTags; ++tag) last_[pair_at(slot, tag)] = {};
}

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
