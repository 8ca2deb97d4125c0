#include "host/filter/gate.hpp"

#include <algorithm>
#include <cmath>

namespace groma::filter {

namespace {

// Fewer ranges than this within the window say nothing about the state.
constexpr double kFewRanges = 4.0;

}  // namespace

double Gate::weight(double innovation_m, double variance_m2) const noexcept {
  if (!std::isfinite(innovation_m) || !std::isfinite(variance_m2) || !(variance_m2 > 0.0)) return 0.0;
  const double e = innovation_m / std::sqrt(variance_m2);
  const double size = std::abs(e);
  if (!(size < config_.reject)) return 0.0;
  const double knee = e > 0.0 ? config_.knee_long : config_.knee_short;
  if (size <= knee) return 1.0;
  return knee * knee / (size * size);
}

bool Gate::observe(double t_s, bool rejected) noexcept {
  const double fade = std::exp(-std::max(t_s - t_s_, 0.0) / config_.window_s);
  t_s_ = t_s;
  seen_ = seen_ * fade + 1.0;
  rejected_ = rejected_ * fade + (rejected ? 1.0 : 0.0);
  const bool before = doubts_;
  doubts_ = seen_ >= kFewRanges && rejected_ > config_.doubt_share * seen_;
  return doubts_ && !before;
}

void Gate::reset(double t_s) noexcept {
  t_s_ = t_s;
  rejected_ = 0.0;
  seen_ = 0.0;
  doubts_ = false;
}

}  // namespace groma::filter
