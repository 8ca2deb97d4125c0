#include "host/filter/map_watch.hpp"

#include <algorithm>
#include <cmath>

#include "host/filter/state.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

namespace {

// "By hand" is explained in config.hpp. The tests of all are MapWatch.* and TrackerTest.* (simulated).
constexpr double kWindow_s = 20.0;    // by hand
constexpr double kSigmas = 3.0;       // statistics: 0.3 % of the ranges of a right map
constexpr double kPoseSigma_m = 0.2;  // by hand
// Tuned on simulated and recorded runs. With right maps the share stays below 0.2: 0.19 among simulated
// racks, 0.17 with a moved anchor or slip. With wrong maps it is 0.2 to 1; the smallest are maps whose
// anchors are 1 m off on each axis. Half of the value would suspect right maps, twice as much would miss
// wrong ones.
constexpr double kSuspectShare = 0.25;
constexpr double kClearShare = 0.2;  // as above: the hysteresis begins above all right maps
constexpr double kGoodShare = 0.12;  // by hand
constexpr double kFitShare = 0.05;   // by hand: 95 % fit
// Added to the number of fitting ranges, so that the first few ranges decide nothing. By hand.
constexpr double kGranted = 5.0;
// By hand: longer than the few seconds after which a robot that was carried away is relocalized.
constexpr double kWrongAfter_s = 15.0;
constexpr double kWrongAfterRanges = 50.0;  // by hand, as are the next three
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
