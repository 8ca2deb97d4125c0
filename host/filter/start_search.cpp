#include "host/filter/start_search.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "host/model/ablation.hpp"
#include "host/model/log_product.hpp"
#include "host/model/range_model.hpp"

namespace groma::filter {

namespace {

// "By hand" is explained in config.hpp. The tests of all of them are the simulated StartSearch.* and
// TrackerTest.*.
constexpr double kSearchWindow_s = 6.0;  // older ranges are dropped. By hand
constexpr double kSpacing_s = 0.25;      // minimum interval between the ranges of a pair. By hand
constexpr double kLatest_s = 0.5;  // maximum age of a range, relative to the newest input; OrderedFilter's
// The errors of one pair are correlated over a second, so a range counts as this share of an independent one.
// By hand; StartSearch.FindsThePoseFromAnyPlaceAndHeading bounds NEES. On a recorded campus it is 0.6.
constexpr double kShare = kSpacing_s / 1.0;
// Scales of the Cauchy cost in sigmas, for ranges that are too long and too short. By hand: NLOS makes ranges
// too long only.
constexpr double kExcessScale = 1.5;
constexpr double kShortfallScale = 3.0;
// ln of the odds at which a hypothesis is dropped. Statistics: 4 sigmas of a Gaussian cost as much (3e-4).
constexpr double kGivenUpOdds = 8.0;
// Scale from which one anchor's cautious cost grows logarithmically. By hand, with kOtherOdds of the tracker;
// StartSearch.NlosOfOneAnchorCountsAsOneEvent.
constexpr double kAnchorCost = 4.0;
// Sigmas below which a hypothesis is settled. By hand: below kUncertain_m and kUncertain_rad of the tracker.
constexpr double kSettled_m = 0.5;
constexpr double kSettled_rad = 0.2;
// Geometry: the coarse rating is 0.2 radii wide, half the distance of points on a ring (pi/16); headings are
// 30 degrees apart, and shifted by 15 at every other point. The number of rings is by hand.
constexpr std::ptrdiff_t kRings = 3;
constexpr int kRingPoints = 16;
constexpr int kHeadings = 12;
// Candidates refined on each chart, steps of the rough refinement, and of the final one of distinct results.
// By hand, for the time of a search.
constexpr std::size_t kRefined = 24;
constexpr int kRoughSteps = 10;
constexpr int kSteps = 25;
// The refinement ends with a step smaller than this. Numerics: far below any sigma.
constexpr double kLastStep_m = 1e-3;
constexpr double kLastStep_rad = 1e-4;
// It also ends with a step that lowers the cost by less than this, or that needs more damping. Numerics: far
// below kGivenUpOdds; seven failed steps in a row, each with 8 times the damping, from 1e-3.
constexpr double kLeastGain = 1e-3;
constexpr double kMostDamping = 1e3;
// Wider than kGivenUpOdds: a subset of the ranges must not drop what all of them would keep. By hand.
constexpr double kRoughOdds = 3.0 * kGivenUpOdds;
// Number of ranges for the coarse rating and for the rough refinement. By hand, for the time of a search.
// kRoughRanges was 96; scripts/golden gave the same results.
constexpr std::size_t kCoarseRanges = 48;
constexpr std::size_t kRoughRanges = 64;
// The coarse rating stops early for a candidate worse than kRefined others; checked every so many ranges. By
// hand: a logarithm for each check.
constexpr int kRangesPerCheck = 8;
// Weak priors around a candidate keep the steps finite in an unobservable direction. Numerics: wider than a
// site, and than a whole turn.
constexpr double kFarStart_m = 1000.0;
constexpr double kAnyHeading_rad = 10.0;
// Results nearer than this are one hypothesis. By hand.
constexpr double kSameStart_m = 0.3;
constexpr double kSameHeading_rad = 0.1;

using model::square;

// Sum of robust costs of residuals e in sigmas, each -ln of a Cauchy density: redescending, zero and with
// unit curvature at e = 0.
class RobustCost {
 public:
  void add(double e) noexcept {
    Side& side = e > 0.0 ? excess_ : shortfall_;
    side.factors.multiply(1.0 + square(e / side.scale));
  }
  [[nodiscard]] double sum() const noexcept { return excess_.sum() + shortfall_.sum(); }

 private:
  struct Side {
    double scale;
    model::LogProduct factors{};
    [[nodiscard]] double sum() const noexcept { return 0.5 * square(scale) * factors.logarithm(); }
  };
  Side excess_{kExcessScale};
  Side shortfall_{kShortfallScale};
};

double robust_weight(double e) noexcept {
  return 1.0 / (1.0 + square(e / (e > 0.0 ? kExcessScale : kShortfallScale)));
}

Eigen::Vector3d vector_of(const model::PlanarPose& pose) noexcept {
  return {pose.x_m, pose.y_m, pose.theta_rad};
}

Eigen::Vector3d step_of(const model::OdometrySample& sample, double dt_s) noexcept {
  return {sample.vx_mps * dt_s, sample.vy_mps * dt_s, sample.omega_radps * dt_s};
}

constexpr auto kIsLikelier = [](const auto& a, const auto& b) { return a.cost < b.cost; };

// Derivatives w.r.t. a pair's parameters; by_anchor in the order of SiteAnchor::values.
struct PairOf {
  PairOf(const Site& site, int anchor, int tag, const model::SurfaceRange& prediction)
      : by_anchor(AnchorVector::Zero(site.anchor_size())) {
    const ParameterRow d = by_parameters(site.pair(anchor, tag), prediction);
    by_anchor(model::pair_indices(tag, site.tag_count)) = d.head<model::kPairSize>().transpose();
    by_lever_arm = d.segment<3>(kOfLeverArm);
    by_frame = d.segment<kFrameSize>(kOfFrame);
    by_anchor(site.anchor_size() - 1) = d(kOfRangeBias);
    by_ground = d.tail<kGroundSize>();
  }

  AnchorVector by_anchor;
  Eigen::Vector3d by_lever_arm;
  Eigen::Vector4d by_frame;
  Eigen::Vector3d by_ground;
};

}  // namespace

// A planar pose as a coordinate frame.
struct StartSearch::Frame {
  explicit Frame(const Eigen::Vector3d& at) noexcept : pose(at), c(std::cos(at.z())), s(std::sin(at.z())) {}

  // This pose composed with a step (x, y, theta in this frame).
  [[nodiscard]] Eigen::Vector3d compose(const Eigen::Vector3d& step) const noexcept {
    return pose + Eigen::Vector3d(c * step.x() - s * step.y(), s * step.x() + c * step.y(), step.z());
  }
  // The step from this pose to another one.
  [[nodiscard]] Eigen::Vector3d to(const Eigen::Vector3d& other) const noexcept {
    const Eigen::Vector3d d = other - pose;
    return {c * d.x() + s * d.y(), -s * d.x() + c * d.y(), d.z()};
  }

  Eigen::Vector3d pose;
  double c;
  double s;
};

StartSearch::StartSearch(model::Surface surface, std::span<const model::Tag> tags,
                         const model::Calibration& calibration, const Config& config)
    : surface_(std::move(surface)),
      config_(config),
      site_(tags, calibration, config.lever_arm_sigma_m),
      last_taken_s_(static_cast<std::size_t>(site_.anchor_count()) * kMaxTags),
      anchor_costs_(static_cast<std::size_t>(site_.anchor_count())),
      by_anchor_(static_cast<std::size_t>(site_.anchor_count()), ByAnchor::Zero(3, site_.anchor_size())) {
  if (calibration.range_delay_sigma_s > 0.0) config_.range_delay_s = calibration.range_delay_s;
  shortest_.reserve(anchor_costs_.size());
  starts_.reserve(kRefined + 1);
  hypotheses_.reserve(kMaxHypotheses);
  clear();
}

void StartSearch::clear() noexcept {
  first_ = count_ = 0;
  std::fill(last_taken_s_.begin(), last_taken_s_.end(), -std::numeric_limits<double>::infinity());
  now_ = {};
  hypotheses_.clear();
  settled_ = false;
}

void StartSearch::stop() noexcept {
  clear();
  sample_.reset();
  t_s_ = -std::numeric_limits<double>::infinity();
}

void StartSearch::advance(double t_s) noexcept {
  if (sample_ && t_s > t_s_) {
    // After max_hold_s the robot is assumed stationary, with the variance of the hold walk.
    const double dt_s = t_s - t_s_;
    const double held_s = std::clamp(sample_->t_s + config_.max_hold_s - t_s_, 0.0, dt_s);
    const Eigen::Vector3d step = step_of(*sample_, held_s);
    const Eigen::Vector3d half_turn(0.0, 0.0, 0.5 * step.z());
    now_.pose = Frame(now_.pose + half_turn).compose(step) - half_turn;
    now_.path_m += step.head<2>().norm();
    const double row_s = std::max(t_s - sample_->t_s, dt_s);
    now_.position_variance_m2 +=
        (square(config_.odometry.sigma_vx_mps) + square(config_.odometry.sigma_vy_mps)) * held_s * row_s;
    now_.heading_variance_rad2 += square(config_.odometry.sigma_omega_radps) * held_s * row_s;
    const double overdue_s = dt_s - held_s;
    now_.position_variance_m2 += square(config_.hold_walk_mps) * overdue_s * row_s * row_s;
    now_.heading_variance_rad2 += square(config_.hold_walk_radps) * overdue_s * row_s * row_s;
  }
  t_s_ = t_s;
}

void StartSearch::process(const model::OdometrySample& sample) noexcept {
  if (!model::is_finite(sample) || (sample_ && sample.t_s < t_s_)) return;
  advance(sample.t_s);
  sample_ = sample;
}

void StartSearch::process(const model::RangeSample& range) noexcept {
  if (!is_usable(range) || range.t_s < t_s_ - kLatest_s) return;
  const int tag = site_.tag_slot(range.tag_id);
  const int anchor = site_.anchor_index(range.anchor_id);
  if (tag < 0 || anchor < 0 || !site_.knows_pair(anchor, tag)) return;
  advance(std::max(range.t_s, t_s_));
  double& last_s = last_taken_s_[pair_at(anchor, tag)];
  if (range.t_s - last_s < kSpacing_s) return;
  last_s = range.t_s;
  while (count_ == kMaxRanges || (count_ > 0 && t_s_ - seen(0).t_s > kSearchWindow_s)) drop_oldest();
  const model::OdometrySample sample = sample_.value_or(model::OdometrySample{.t_s = range.t_s});
  Odometer at = now_;
  const Eigen::Vector3d back = step_of(sample, -(t_s_ - range.t_s + config_.range_delay_s));
  at.pose = Frame(at.pose).compose(back);
  at.path_m -= back.head<2>().norm();
  seen(count_++) = {.t_s = range.t_s, .anchor = anchor, .tag = tag, .range_m = range.range_m, .at = at};
}

void StartSearch::drop_oldest() noexcept {
  first_ = (first_ + 1) % kMaxRanges;
  --count_;
}

void StartSearch::relate() noexcept {
  while (count_ > 0 && t_s_ - seen(0).t_s > kSearchWindow_s) drop_oldest();
  const Frame now(now_.pose);
  for (std::size_t i = 0; i < count_; ++i) {
    Seen& then = seen(i);
    const double path_m = now_.path_m - then.at.path_m;
    const double heading_variance = now_.heading_variance_rad2 - then.at.heading_variance_rad2 +
                                    square(config_.yaw_rate_bias_radps * (t_s_ - then.t_s));
    then.back = now.to(then.at.pose);
    then.cos_back = std::cos(then.back.z());
    then.sin_back = std::sin(then.back.z());
    then.drift_variance_m2 = now_.position_variance_m2 - then.at.position_variance_m2 +
                             square(config_.scale_sigma * path_m) + heading_variance * square(path_m) / 3.0;
  }
}

template <class Each>
void StartSearch::walk_back(const Eigen::Vector3d& pose, int chart, std::size_t every,
                            const Each& each) noexcept {
  const std::size_t first = count_ % every;
  if (surface_.chart_count() == 1) {
    for (std::size_t i = first; i < count_; i += every) each(seen(i), chart);
    return;
  }
  chart = surface_.follow(chart, pose.x(), pose.y());
  const Frame now(pose);
  for (std::size_t i = count_; i-- > 0;) {
    const Eigen::Vector3d then = now.compose(seen(i).back);
    chart = surface_.follow(chart, then.x(), then.y());
    if (i % every == first) each(seen(i), chart);
  }
}

StartSearch::Residual StartSearch::residual(const Seen& seen, const Frame& now, int chart) const noexcept {
  const Eigen::Vector3d then = now.compose(seen.back);
  Residual out;
  out.predicted = range_from(surface_, then, site_.pair(seen.anchor, seen.tag), chart);
  out.e_m = seen.range_m - out.predicted.range_m;
  const Eigen::Vector2d lever = then.head<2>() - now.pose.head<2>();
  out.d_pose = out.predicted.d_pose;
  out.d_pose(2) += -out.d_pose(0) * lever.y() + out.d_pose(1) * lever.x();
  return out;
}

double StartSearch::variance_m2(const Seen& seen, const model::SurfaceRange& predicted,
                                int chart) const noexcept {
  const PairOf pair(site_, seen.anchor, seen.tag, predicted);
  const model::SurfaceMismatch& mismatch = surface_.mismatch(chart);
  return square(config_.range_sigma_m) + seen.drift_variance_m2 +
         pair.by_anchor.dot(site_.anchor(seen.anchor).covariance * pair.by_anchor) +
         site_.lever_arm_variance_m2 * pair.by_lever_arm.squaredNorm() +
         pair.by_frame.dot(site_.frame_covariance * pair.by_frame) +
         square(mismatch.sigma_m * pair.by_ground(0)) +
         square(mismatch.slope_sigma) * pair.by_ground.tail<2>().squaredNorm();
}

double StartSearch::coarse_cost(const Eigen::Vector3d& pose, int chart, double width_m,
                                double most) noexcept {
  RobustCost sum;
  const Frame now(pose);
  int count = 0;
  bool is_stopped = false;
  walk_back(pose, chart, std::max<std::size_t>(1, count_ / kCoarseRanges), [&](const Seen& seen, int on) {
    if (is_stopped) return;
    if (++count % kRangesPerCheck == 0 && sum.sum() > most) is_stopped = true;
    const Eigen::Vector3d then = now.compose(seen.back);
    const PairParameters pair = site_.pair(seen.anchor, seen.tag);
    const Eigen::Vector3d& lever = pair.lever_arm_m;
    const double c = now.c * seen.cos_back - now.s * seen.sin_back;
    const double s = now.s * seen.cos_back + now.c * seen.sin_back;
    const Eigen::Vector3d antenna(then.x() + c * lever.x() - s * lever.y(),
                                  then.y() + s * lever.x() + c * lever.y(),
                                  surface_.height_m(then.x(), then.y(), on) + lever.z());
    const double predicted_m = model::predict_antenna_range(antenna, pair.position_m, pair.terms).range_m;
    sum.add((seen.range_m - predicted_m) / width_m);
  });
  return sum.sum();
}

StartSearch::Sums StartSearch::linearize(const Eigen::Vector3d& pose, int chart, std::size_t every,
                                         bool new_variances) noexcept {
  Sums out;
  out.information =
      Eigen::Vector3d(1.0 / square(kFarStart_m), 1.0 / square(kFarStart_m), 1.0 / square(kAnyHeading_rad))
          .asDiagonal();
  RobustCost cost;
  const Frame now(pose);
  walk_back(pose, chart, every, [&](Seen& seen, int on) {
    const Residual r = residual(seen, now, on);
    if (new_variances) seen.variance_m2 = variance_m2(seen, r.predicted, on);
    const double e = r.e_m / std::sqrt(seen.variance_m2);
    const double weight = robust_weight(e);
    cost.add(e);
    out.weights += weight;
    const double w = kShare * weight / seen.variance_m2;
    out.information.noalias() += w * r.d_pose.transpose() * r.d_pose;
    out.gradient.noalias() += w * r.e_m * r.d_pose.transpose();
  });
  out.cost = kShare * cost.sum();
  return out;
}

StartSearch::Hypothesis StartSearch::refine(const model::PlanarPose& start, std::size_t every,
                                            int steps) noexcept {
  Eigen::Vector3d pose = vector_of(start);
  double damping = 1e-3;
  // The variances hardly change during the refinement and are the most expensive part: keep them.
  Sums sums = linearize(pose, start.chart, every, true);
  for (int step = 0; step < steps; ++step) {
    Eigen::Matrix3d damped = sums.information;
    damped.diagonal() *= 1.0 + damping;
    const Eigen::Vector3d change = damped.ldlt().solve(sums.gradient);
    if (!change.allFinite()) break;
    const Sums next = linearize(pose + change, start.chart, every, false);
    if (!(next.cost < sums.cost)) {
      damping = std::max(damping * 8.0, 1e-3);
      if (damping > kMostDamping) break;
      continue;
    }
    const double gain = sums.cost - next.cost;
    pose += change;
    sums = next;
    damping *= 0.1;
    if (gain < kLeastGain) break;
    if (change.head<2>().norm() < kLastStep_m && std::abs(change.z()) < kLastStep_rad) break;
  }
  sums = linearize(pose, start.chart, every, true);
  return {.pose = {pose.x(), pose.y(), model::wrap_angle(pose.z()),
                   surface_.follow(start.chart, pose.x(), pose.y())},
          .covariance = sums.information.inverse(),
          .cost = sums.cost,
          .mean_weight = sums.weights * static_cast<double>(every) / static_cast<double>(count_)};
}

void StartSearch::refine_starts() noexcept {
  const std::size_t every = std::max<std::size_t>(1, count_ / kRoughRanges);
  for (Hypothesis& start : starts_) start = refine(start.pose, every, kRoughSteps);
  std::sort(starts_.begin(), starts_.end(), kIsLikelier);
  double least = std::numeric_limits<double>::infinity();
  for (Hypothesis& start : starts_) {
    start.cost *= static_cast<double>(every);
    least = std::min(least, start.cost);
  }
  for (const Hypothesis& known : hypotheses_) least = std::min(least, known.cost);
  std::size_t refined = 0;
  for (auto end = starts_.begin(); end != starts_.end() && refined < kMaxHypotheses; ++end) {
    if (!(end->cost < least + kRoughOdds)) break;
    const auto is_near = [&](const Hypothesis& other) { return is_same(end->pose, other.pose); };
    if (std::any_of(starts_.begin(), end, is_near) ||
        std::any_of(hypotheses_.begin(), hypotheses_.end(), is_near)) {
      continue;
    }
    keep(refine(end->pose, 1, kSteps));
    ++refined;
  }
}

void StartSearch::add_calibration(Hypothesis& hypothesis) noexcept {
  // To first order the solution is linear in the residuals. The errors of the parameters are common to many
  // ranges and do not average out, so they are propagated to the solution's covariance.
  std::array<Eigen::Matrix3d, kMaxTags> by_lever_arm;
  by_lever_arm.fill(Eigen::Matrix3d::Zero());
  Eigen::Matrix<double, 3, kFrameSize> by_frame = Eigen::Matrix<double, 3, kFrameSize>::Zero();
  const Eigen::Vector3d pose = vector_of(hypothesis.pose);
  walk_back(pose, hypothesis.pose.chart, 1, [&, now = Frame(pose)](const Seen& seen, int chart) {
    const Residual r = residual(seen, now, chart);
    const double variance = variance_m2(seen, r.predicted, chart);
    const double weight = kShare * robust_weight(r.e_m / std::sqrt(variance)) / variance;
    const PairOf pair(site_, seen.anchor, seen.tag, r.predicted);
    const Eigen::Vector3d correction = weight * r.d_pose.transpose();
    by_anchor_[static_cast<std::size_t>(seen.anchor)].noalias() += correction * pair.by_anchor.transpose();
    by_lever_arm[static_cast<std::size_t>(seen.tag)].noalias() += correction * pair.by_lever_arm.transpose();
    by_frame.noalias() += correction * pair.by_frame.transpose();
  });
  Eigen::Matrix3d spread = by_frame * site_.frame_covariance * by_frame.transpose();
  for (const Eigen::Matrix3d& by : by_lever_arm) {
    spread.noalias() += site_.lever_arm_variance_m2 * by * by.transpose();
  }
  for (std::size_t i = 0; i < count_; ++i) {
    const int anchor = seen(i).anchor;
    ByAnchor& by = by_anchor_[static_cast<std::size_t>(anchor)];
    spread += by.lazyProduct(site_.anchor(anchor).covariance).eval().lazyProduct(by.transpose());
    by.setZero();
  }
  const Eigen::Matrix3d& gain = hypothesis.covariance;
  hypothesis.covariance += gain * spread * gain.transpose();
}

bool StartSearch::is_same(const model::PlanarPose& a, const model::PlanarPose& b) const noexcept {
  if (std::hypot(a.x_m - b.x_m, a.y_m - b.y_m) > kSameStart_m) return false;
  if (std::abs(model::wrap_angle(a.theta_rad - b.theta_rad)) > kSameHeading_rad) return false;
  const double above_m = surface_.at(a.x_m, a.y_m, a.chart).z_m - surface_.at(a.x_m, a.y_m, b.chart).z_m;
  return std::abs(above_m) <= model::Surface::kStep_m;
}

void StartSearch::keep(const Hypothesis& hypothesis) noexcept {
  auto other = std::find_if(hypotheses_.begin(), hypotheses_.end(),
                            [&](const Hypothesis& kept) { return is_same(hypothesis.pose, kept.pose); });
  if (other == hypotheses_.end()) {
    if (hypotheses_.size() < kMaxHypotheses) return hypotheses_.push_back(hypothesis);
    other = std::max_element(hypotheses_.begin(), hypotheses_.end(), kIsLikelier);
  }
  if (hypothesis.cost < other->cost) *other = hypothesis;
}

void StartSearch::try_chart(int chart) noexcept {
  starts_.clear();
  for (const Seen* seen : std::span(shortest_).first(std::min<std::size_t>(kRings, shortest_.size()))) {
    const Eigen::Vector3d anchor = site_.anchor(seen->anchor).values.head<3>();
    const double height_m = anchor.z() - surface_.at(anchor.x(), anchor.y(), chart).z_m;
    const double radius_m =
        std::sqrt(std::max(square(seen->range_m) - square(height_m), square(0.2 * seen->range_m)));
    const double width_m = std::hypot(0.2 * radius_m, 0.5);
    const Eigen::Vector3d to_now = Frame(seen->back).to(Eigen::Vector3d::Zero());
    for (int i = 0; i < kRingPoints * kHeadings; ++i) {
      // The candidate is a pose at the time of the range; the hypothesis is the pose now.
      const int point = i / kHeadings;
      const double angle = 2.0 * std::numbers::pi * point / kRingPoints;
      const double heading = 2.0 * std::numbers::pi * (i % kHeadings + 0.5 * (point % 2)) / kHeadings;
      const Eigen::Vector3d then(anchor.x() + radius_m * std::cos(angle),
                                 anchor.y() + radius_m * std::sin(angle), heading);
      const Eigen::Vector3d pose = Frame(then).compose(to_now);
      // starts_ is a heap of the best so far, with the worst of them on top.
      const double most =
          starts_.size() < kRefined ? std::numeric_limits<double>::infinity() : starts_.front().cost;
      const double cost = coarse_cost(pose, chart, width_m, most);
      if (!(cost < most)) continue;
      starts_.push_back({.pose = {pose.x(), pose.y(), pose.z(), chart}, .cost = cost});
      std::push_heap(starts_.begin(), starts_.end(), kIsLikelier);
      if (starts_.size() <= kRefined) continue;
      std::pop_heap(starts_.begin(), starts_.end(), kIsLikelier);
      starts_.pop_back();
    }
  }
  std::sort_heap(starts_.begin(), starts_.end(), kIsLikelier);
  refine_starts();
}

void StartSearch::try_mirrored() noexcept {
  starts_.clear();
  for (const Hypothesis& hypothesis : hypotheses_) {
    const model::PlanarPose& pose = hypothesis.pose;
    starts_.push_back({.pose = {pose.x_m, pose.y_m, pose.theta_rad + std::numbers::pi, pose.chart}});
    if (shortest_.size() < 2) continue;
    const Eigen::Vector2d a = site_.anchor(shortest_[0]->anchor).values.head<2>();
    const Eigen::Vector2d b = site_.anchor(shortest_[1]->anchor).values.head<2>();
    const double along = std::atan2(b.y() - a.y(), b.x() - a.x());
    const Eigen::Vector2d from(pose.x_m - a.x(), pose.y_m - a.y());
    const Eigen::Vector2d axis(std::cos(along), std::sin(along));
    const Eigen::Vector2d mirrored = a + 2.0 * axis.dot(from) * axis - from;
    starts_.push_back({.pose = {mirrored.x(), mirrored.y(), 2.0 * along - pose.theta_rad, pose.chart}});
  }
  refine_starts();
}

bool StartSearch::begin_search() noexcept {
  hypotheses_.clear();
  settled_ = false;
  relate();
  return count_ >= 3;
}

std::span<const StartSearch::Hypothesis> StartSearch::search_floors(const model::PlanarPose& about) noexcept {
  if (!begin_search()) return {};
  for (int chart = 0; chart < surface_.chart_count(); ++chart) {
    if (!surface_.covers(about.x_m, about.y_m, chart)) continue;
    keep(refine({about.x_m, about.y_m, about.theta_rad, chart}, 1, kSteps));
  }
  return end_search();
}

std::span<const StartSearch::Hypothesis> StartSearch::search() noexcept {
  if (!begin_search()) return {};
  // The shortest range of each anchor, nearest anchors first.
  shortest_.assign(anchor_costs_.size(), nullptr);
  for (std::size_t i = 0; i < count_; ++i) {
    const Seen*& least = shortest_[static_cast<std::size_t>(seen(i).anchor)];
    if (least == nullptr || seen(i).range_m < least->range_m) least = &seen(i);
  }
  shortest_.erase(std::remove(shortest_.begin(), shortest_.end(), nullptr), shortest_.end());
  std::sort(shortest_.begin(), shortest_.end(), [](const Seen* a, const Seen* b) {
    return std::pair(a->range_m, a->anchor) < std::pair(b->range_m, b->anchor);
  });
  for (int chart = 0; chart < surface_.chart_count(); ++chart) try_chart(chart);
  try_mirrored();
  return end_search();
}

std::span<const StartSearch::Hypothesis> StartSearch::end_search() noexcept {
  if (hypotheses_.empty()) return {};
  std::sort(hypotheses_.begin(), hypotheses_.end(), kIsLikelier);
  const double most = hypotheses_.front().cost + kGivenUpOdds;
  std::erase_if(hypotheses_, [most](const Hypothesis& hypothesis) { return !(hypothesis.cost < most); });
  if (hypotheses_.empty()) return {};
  for (Hypothesis& hypothesis : hypotheses_) add_calibration(hypothesis);
  const Hypothesis& best = hypotheses_.front();
  Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> axes;
  axes.computeDirect(best.covariance.topLeftCorner<2, 2>(), Eigen::EigenvaluesOnly);
  settled_ = hypotheses_.size() == 1 && axes.eigenvalues()(1) < square(kSettled_m) &&
             best.covariance(2, 2) < square(kSettled_rad) && best.mean_weight > kExplainedShare;
  return hypotheses_;
}

double StartSearch::cautious_cost(const model::PlanarPose& pose) noexcept {
  std::fill(anchor_costs_.begin(), anchor_costs_.end(), 0.0);
  relate();
  const Eigen::Vector3d at = vector_of(pose);
  walk_back(at, pose.chart, 1, [&, now = Frame(at)](const Seen& seen, int chart) {
    const Residual r = residual(seen, now, chart);
    RobustCost cost;
    cost.add(r.e_m / std::sqrt(variance_m2(seen, r.predicted, chart)));
    anchor_costs_[static_cast<std::size_t>(seen.anchor)] += kShare * cost.sum();
  });
  const bool is_bounded = !model::is_ablated(model::Mechanism::kCautiousCost);
  double sum = 0.0;
  for (const double cost : anchor_costs_)
    sum += is_bounded ? kAnchorCost * std::log1p(cost / kAnchorCost) : cost;
  return sum;
}

}  // namespace groma::filter
