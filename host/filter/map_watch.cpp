#include "host/filter/map_watch.hpp"

#include <algorithm>
#include <cmath>

#include "host/filter/state.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

namespace {

// With right maps, recorded and simulated, the share stays below 0.2, the largest due to NLOS. With wrong
// maps it is 0.2 to 1; the smallest are maps whose anchors are 1 m off on each axis.
constexpr double kWindow_s = 20.0;
constexpr double kSigmas = 3.0;
constexpr double kPoseSigma_m = 0.2;
constexpr double kSuspectShare = 0.25;
constexpr double kClearShare = 0.2;
constexpr double kGoodShare = 0.12;
constexpr double kFitShare = 0.05;
// Added to the number of fitting ranges, so that the first few ranges decide nothing.
constexpr double kGranted = 5.0;
// Longer than the few seconds after which a robot that was carried away is relocalized.
constexpr double kWrongAfter_s = 15.0;
constexpr double kWrongAfterRanges = 50.0;
constexpr double kClearFor_s = 5.0;
constexpr double kFitsFor_s = 30.0;
constexpr double kFitsForRanges = 150.0;

}  // namespace

void MapWatch::observe(double t_s, double innovation_m, double variance_m2) noexcept {
  if (!std::isfinite(innovation_m) || !std::isfinite(variance_m2)) return;
  const double fade = fading(t_s_, t_s, kWindow_s);
  t_s_ = std::max(t_s, t_s_);
  const double bound_m2 = model::square(kSigmas) * (variance_m2 + model::square(kPoseSigma_m));
  judged_ = fade * judged_ + 1.0;
  contradicting_ = fade * contradicting_ + (model::square(innovation_m) > bound_m2 ? 1.0 : 0.0);

  if (share() > kSuspectShare) is_suspect_ = true;
  if (share() < kClearShare) is_suspect_ = false;
  clear_.update(!is_suspect_, t_s_);
  if (clear_.lasted_s(t_s_) > kClearFor_s) suspect_.reset();
  if (is_suspect_ && !suspect_.holds()) {
    suspect_.update(true, t_s_);
    suspect_ranges_ = 0.0;
  }
  suspect_ranges_ += 1.0;
  if (is_suspect_ && suspect_.lasted_s(t_s_) >= kWrongAfter_s && suspect_ranges_ >= kWrongAfterRanges)
    is_wrong_ = true;
  const bool fits = share() < kFitShare;
  fits_.update(fits, t_s_);
  fitting_ranges_ = fits ? fitting_ranges_ + 1.0 : 0.0;
  if (fits_.lasted_s(t_s_) >= kFitsFor_s && fitting_ranges_ >= kFitsForRanges) is_wrong_ = false;
}

void MapWatch::restart() noexcept {
  judged_ = contradicting_ = 0.0;
  is_suspect_ = false;
  fits_.reset();
}

double MapWatch::share() const noexcept {
  return contradicting_ / (judged_ + kGranted);
}

bool MapWatch::fits() const noexcept {
  return clear_.lasted_s(t_s_) > kClearFor_s && share() < kGoodShare && !is_wrong_;
}

}  // namespace groma::filter
