#include "host/filter/self_tuning.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

namespace groma::filter {

namespace {

// Half of a Gaussian's draws lie within this many sigmas.
constexpr double kHalfWithin = 0.6744897501960817;
// Ranges that are too long by more sigmas are likely blocked. Those that are too short all count: where the
// sigma is much too small they still are wide enough to widen it.
constexpr double kTooLong = 2.0;
// Of a slow error the state takes up a part, which innovations do not show.
constexpr double kShown = 0.7;

}  // namespace

RangeTuning::RangeTuning(const SelfTuningConfig& config, double white_sigma_m)
    : config_(config),
      least_sigma_m_(white_sigma_m / config.most_factor),
      most_sigma_m_(white_sigma_m * config.most_factor),
      white_sigma_m_(white_sigma_m) {}

void RangeTuning::reset() noexcept {
  last_.fill({});
}

void RangeTuning::observe(int anchor, int tag, double t_s, double innovation_m, double variance_m2) noexcept {
  if (!std::isfinite(innovation_m) || !(variance_m2 > 0.0)) return;
  if (innovation_m > kTooLong * std::sqrt(variance_m2)) return;
  Last& last = last_[static_cast<std::size_t>(anchor) * kMaxTags + static_cast<std::size_t>(tag)];
  const double gap_s = t_s - last.t_s;
  // What lasts is in both, and their difference is white.
  if (last.heard && gap_s > 0.0 && gap_s < config_.difference_s) {
    differences_ += 1.0;
    const double step =
        std::max(config_.step, config_.first_step / (1.0 + differences_ / config_.first_draws));
    const double half_m = kHalfWithin * std::numbers::sqrt2 * white_sigma_m_;
    const double change = std::abs(innovation_m - last.innovation_m) > half_m ? step : -step;
    white_sigma_m_ = std::clamp(white_sigma_m_ * (1.0 + change), least_sigma_m_, most_sigma_m_);
  }
  last = {.t_s = t_s, .innovation_m = innovation_m, .heard = true};
  // All that lasts, from ranges that are too short: walls make none of these.
  if (innovation_m < 0.0) {
    const double change =
        innovation_m * innovation_m > kShown * kShown * kHalfWithin * kHalfWithin * variance_m2 ? 1.0 : -1.0;
    slow_scale_ = std::clamp(slow_scale_ * (1.0 + config_.slow_step * change), 1.0 / config_.slow_most_factor,
                             config_.slow_most_factor);
  }
}

}  // namespace groma::filter
