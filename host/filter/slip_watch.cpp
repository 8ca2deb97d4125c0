#include "host/filter/slip_watch.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <span>

namespace groma::filter {

namespace {

using model::square;

// "By hand" is explained in config.hpp. The tests of all of them are the simulated SlipWatch.* and Slip.*;
// docs/measurements.md has the errors with and without slip detection.
constexpr double kUsual_s = 3.0;     // time constant of a pair's mean LOS innovation. By hand
constexpr double kMostSigmas = 3.0;  // bound of one range's excess. Statistics: 0.3 % of LOS ranges
// Shortfall of an anchor's mean from which a slip is searched for. Statistics: 0.6 % of LOS means.
constexpr double kNearSigmas = 2.5;
// ln of the odds against another cause, NLOS or a too short range. By hand: as much as 2 and 3.7 sigmas cost.
constexpr double kTooFarCost = 2.0;
constexpr double kTooNearCost = 7.0;
// Share of the cost that a slip has to explain. By hand, for SlipWatch.UnexplainedErrorsAreNoSlip.
constexpr double kExplainedShare = 0.65;
constexpr double kLeast_m = 0.04;   // smallest displacement detected. By hand
constexpr double kLeast_mps = 0.3;  // bounds of the assumed odometry error after a slip. By hand
constexpr double kMost_mps = 2.0;
constexpr double kAgain_s = 3.0;         // a slip that repeats within this lasts twice as long. By hand
constexpr double kMostLasts_s = 2.0;     // by hand
constexpr double kMostTurn_radps = 0.5;  // by hand
// The inflation ends below this share of kLeast_mps. By hand: 1 % of its variance is left.
constexpr double kOver = 0.1;
// sin^2 of the angle between two anchors' directions below which they do not fix a position. Geometry: 10
// degrees, where the error along them is 6 times that of a range.
constexpr double kAlongside = 0.03;
// Residual in standard deviations up to which an anchor agrees with a displacement. Statistics: 95 %.
constexpr double kAgrees = 2.0;
constexpr int kFewestAgreeing = 3;  // geometry: two anchors fix a displacement, a third checks it
// An anchor with a smaller count of ranges (with forgetting) is ignored. By hand: a single range counts for
// 1.2 kWindow_s, 0.5 s. SlipWatch.SilentAnchorsDoNotCount.
constexpr double kMinFadedRanges = 0.3;

// An anchor's recent excess as an equation in the displacement d: (x, y) d = off, whitened.
struct View {
  double x = 0.0;
  double y = 0.0;
  double off = 0.0;

  [[nodiscard]] double unexplained(const Eigen::Vector2d& displacement_m) const noexcept {
    return off - x * displacement_m.x() - y * displacement_m.y();
  }
};

double cost(std::span<const View> views, const Eigen::Vector2d& displacement_m) noexcept {
  double sum = 0.0;
  for (const View& view : views) {
    const double off = view.unexplained(displacement_m);
    sum += std::min(0.5 * square(off), off > 0.0 ? kTooFarCost : kTooNearCost);
  }
  return sum;
}

}  // namespace

void SlipWatch::fade(Sums& sums, double until_s) noexcept {
  const double left = fading(sums.t_s, until_s, kWindow_s);
  sums.t_s = until_s;
  for (double* sum : {&sums.n, &sums.w, &sums.off, &sums.x, &sums.y}) *sum *= left;
}

std::optional<Eigen::Vector2d> SlipWatch::observe(int anchor, int tag, double t_s, double innovation_m,
                                                  double variance_m2, double weight,
                                                  const Eigen::RowVector2d& by_position) noexcept {
  if (!std::isfinite(innovation_m) || !(variance_m2 > 0.0)) return std::nullopt;
  Usual& usual = usual_[pair_at(anchor, tag)];
  const double gap_s = t_s - usual.t_s;
  usual.t_s = t_s;
  const double most_m = kMostSigmas * std::sqrt(variance_m2);
  if (gap_s > kUsual_s) {
    usual.innovation_m = 0.0;
    return std::nullopt;
  }
  const double off_m = std::clamp(innovation_m - usual.innovation_m, -most_m, most_m);
  usual.innovation_m += weight * off_m * (gap_s / (gap_s + kUsual_s));

  Sums& own = anchors_[static_cast<std::size_t>(anchor)];
  fade(own, t_s);
  const double w = 1.0 / variance_m2;
  own.n += 1.0;
  own.w += w;
  own.off += w * off_m;
  own.x += w * by_position.x();
  own.y += w * by_position.y();
  // Only a displacement makes ranges too short: search only if this anchor's mean is.
  if (!(own.off < 0.0) || square(own.off) < square(kNearSigmas) * own.w) return std::nullopt;
  std::optional<Eigen::Vector2d> displacement_m = find_displacement(t_s);
  if (displacement_m) anchors_.fill({.t_s = t_s});
  return displacement_m;
}

std::optional<Eigen::Vector2d> SlipWatch::find_displacement(double t_s) noexcept {
  std::array<View, kMaxAnchors> all;
  std::size_t count = 0;
  for (Sums& anchor : anchors_) {
    if (!(anchor.n > 0.0)) continue;
    fade(anchor, t_s);
    if (anchor.n < kMinFadedRanges) continue;
    const double root = std::sqrt(anchor.w);
    all[count++] = {anchor.x / root, anchor.y / root, anchor.off / root};
  }
  const std::span<const View> views(all.data(), count);
  const double without = cost(views, Eigen::Vector2d::Zero());
  if (without < odds_) return std::nullopt;
  std::optional<Eigen::Vector2d> best_m;
  // A displacement that leaves much unexplained has another cause: a wrong surface or calibration.
  double least = std::min(without - odds_, (1.0 - kExplainedShare) * without);
  for (std::size_t i = 0; i < count; ++i) {
    const View& a = views[i];
    for (const View& b : views.first(i)) {
      const double determinant = a.x * b.y - a.y * b.x;
      if (square(determinant) < kAlongside * (square(a.x) + square(a.y)) * (square(b.x) + square(b.y)))
        continue;
      const Eigen::Vector2d place_m((b.y * a.off - a.y * b.off) / determinant,
                                    (a.x * b.off - b.x * a.off) / determinant);
      const double now = cost(views, place_m);
      if (!(now < least)) continue;
      least = now;
      best_m = place_m;
    }
  }
  if (!best_m || best_m->norm() < kLeast_m) return std::nullopt;
  const auto agreeing = std::count_if(views.begin(), views.end(), [&](const View& view) {
    return std::abs(view.unexplained(*best_m)) < kAgrees;
  });
  if (agreeing < kFewestAgreeing || 2 * agreeing <= std::ssize(views)) return std::nullopt;
  return best_m;
}

void SlipWatch::renew(int anchor) noexcept {
  anchors_[static_cast<std::size_t>(anchor)] = {};
  for (int tag = 0; tag < kMaxTags; ++tag) usual_[pair_at(anchor, tag)] = {};
}

void SlipInflation::begin(double displacement_m, double t_s) noexcept {
  const double excess_mps = 2.0 * displacement_m / SlipWatch::kWindow_s;
  excess_mps_ = std::max(excess_mps_, std::clamp(excess_mps, kLeast_mps, kMost_mps));
  const bool goes_on = t_s - last_s_ < kAgain_s;
  lasts_s_ = goes_on ? std::min(2.0 * lasts_s_, kMostLasts_s) : kLasts_s;
  last_s_ = t_s;
}

OdometryInflation SlipInflation::judge(double gap_s) noexcept {
  if (!is_open()) return {};
  excess_mps_ *= std::exp(-gap_s / lasts_s_);
  if (excess_mps_ < kOver * kLeast_mps) {
    excess_mps_ = 0.0;
    return {};
  }
  const double rows = white_factor(lasts_s_, gap_s);
  const double turn_radps = std::min(excess_mps_ * kTurnPer_m, kMostTurn_radps);
  return {.velocity_m2ps2 = rows * square(excess_mps_), .turn_rad2ps2 = rows * square(turn_radps)};
}

}  // namespace groma::filter
