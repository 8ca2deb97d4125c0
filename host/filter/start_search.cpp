#include "host/filter/start_search.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <utility>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "host/model/ablation.hpp"

namespace groma::filter {

namespace {

constexpr int kRings = 3;
constexpr int kRingPoints = 16;
constexpr int kHeadings = 12;
// Of them, so many of each chart are refined: roughly, and in so many steps more where they end apart.
constexpr std::size_t kRefined = 24;
constexpr int kRoughSteps = 10;
constexpr int kSteps = 25;
// A step smaller than this is the last one: far below what a start is asked to be sure of.
constexpr double kLastStep_m = 1e-3;
constexpr double kLastStep_rad = 1e-4;
// Nor is one that makes the ranges likelier by less (ln), or that has to be as small as this damping makes
// it.
constexpr double kLeastGain = 1e-3;
constexpr double kMostDamping = 1e3;
// A part of the ranges gives no hypothesis up that all of them might keep.
constexpr double kRoughOdds = 3.0;
// The coarse judgement looks at so many ranges, and the rough refinement at these.
constexpr std::size_t kCoarseRanges = 48;
// A start that is worse than kRefined others is given up on the way.
constexpr int kLooksPerCheck = 8;
constexpr double kAnyCost = std::numeric_limits<double>::infinity();
constexpr std::size_t kRoughRanges = 64;
// Weak priors about where a hypothesis starts keep the steps finite in a direction that nothing tells of.
constexpr double kFarStart_m = 1000.0;
constexpr double kAnyHeading_rad = 10.0;
// Ends of refinement nearer than this are one hypothesis.
constexpr double kSameStart_m = 0.3;
constexpr double kSameHeading_rad = 0.1;

using model::square;

// Sum of robust costs of residuals e in sigmas, each -ln of a Cauchy density with that knee: redescending,
// zero and with unit curvature at e = 0. Logarithms cost most of a search, so factors are collected first.
class RobustCost {
 public:
  explicit RobustCost(const StartSearchConfig& search) : knees_{search.excess_knee, search.shortfall_knee} {}
  void add(double e) noexcept {
    const std::size_t side = e > 0.0 ? 0 : 1;
    factors_[side] *= 1.0 + square(e / knees_[side]);
    if (factors_[side] < kMost) return;
    logarithms_[side] += std::log(factors_[side]);
    factors_[side] = 1.0;
  }
  [[nodiscard]] double sum() const noexcept {
    double out = 0.0;
    for (std::size_t side = 0; side < 2; ++side)
      out += 0.5 * square(knees_[side]) * (logarithms_[side] + std::log(factors_[side]));
    return out;
  }

 private:
  static constexpr double kMost = 1e150;  // the next factor does not overflow
  std::array<double, 2> knees_;
  std::array<double, 2> factors_{1.0, 1.0};
  std::array<double, 2> logarithms_{};
};

double robust_cost(double e, const StartSearchConfig& search) noexcept {
  RobustCost cost(search);
  cost.add(e);
  return cost.sum();
}

double robust_weight(double e, const StartSearchConfig& search) noexcept {
  const double knee = e > 0.0 ? search.excess_knee : search.shortfall_knee;
  return 1.0 / (1.0 + square(e / knee));
}

// A pose as a frame, to look at many steps from it.
class Frame {
 public:
  explicit Frame(const Eigen::Vector3d& pose) noexcept
      : pose_(pose), cos_(std::cos(pose.z())), sin_(std::sin(pose.z())) {}

  // The pose `step` (x, y, theta in this frame) away.
  [[nodiscard]] Eigen::Vector3d compose(const Eigen::Vector3d& step) const noexcept {
    return {pose_.x() + cos_ * step.x() - sin_ * step.y(), pose_.y() + sin_ * step.x() + cos_ * step.y(),
            pose_.z() + step.z()};
  }
  [[nodiscard]] double cos() const noexcept { return cos_; }
  [[nodiscard]] double sin() const noexcept { return sin_; }

 private:
  Eigen::Vector3d pose_;
  double cos_;
  double sin_;
};

Eigen::Vector3d vector_of(const model::PlanarPose& pose) noexcept {
  return {pose.x_m, pose.y_m, pose.theta_rad};
}

Eigen::Vector3d between(const Eigen::Vector3d& from, const Eigen::Vector3d& to) noexcept {
  const double c = std::cos(from.z());
  const double s = std::sin(from.z());
  const Eigen::Vector2d d = to.head<2>() - from.head<2>();
  return {c * d.x() + s * d.y(), -s * d.x() + c * d.y(), to.z() - from.z()};
}

// The derivatives by a pair's parameters, where they stand in the site.
struct PairOf {
  PairOf(const Site& site, int tag, const RangeMeasurement& measurement)
      : by_anchor(AnchorVector::Zero(site.anchor_size())) {
    const auto& d = measurement.d_parameters;
    by_anchor.head<3>() = d.head<3>();
    by_anchor(3 + tag) = d(3);
    by_anchor(3 + site.tag_count() + tag) = d(4);
    by_lever_arm = d.segment<3>(5);
    by_frame = d.segment<kFrameSize>(8);
    by_anchor(site.anchor_size() - 1) = d(8 + kFrameSize);
    by_ground = d.tail<kGroundSize>();
  }

  AnchorVector by_anchor;
  Eigen::Vector3d by_lever_arm;
  Eigen::Vector4d by_frame;
  Eigen::Vector3d by_ground;
};

}  // namespace

StartSearch::StartSearch(model::Surface surface, std::span<const model::Tag> tags,
                         const model::Calibration& calibration, const Config& config,
                         const StartSearchConfig& search)
    : surface_(std::move(surface)),
      config_(config),
      search_(search),
      site_(tags, calibration, config.lever_arm_sigma_m),
      last_taken_s_(static_cast<std::size_t>(site_.anchor_count()) * kMaxTags),
      shortest_(static_cast<std::size_t>(site_.anchor_count())),
      anchor_costs_(static_cast<std::size_t>(site_.anchor_count())),
      by_anchor_(static_cast<std::size_t>(site_.anchor_count()), ByAnchor::Zero(3, site_.anchor_size())) {
  if (calibration.range_delay_sigma_s > 0.0) config_.range_delay_s = calibration.range_delay_s;
  clear();
}

void StartSearch::clear() noexcept {
  first_ = 0;
  count_ = 0;
  std::fill(last_taken_s_.begin(), last_taken_s_.end(), -std::numeric_limits<double>::infinity());
  now_ = {};
  hypothesis_count_ = 0;
  settled_ = false;
}

void StartSearch::stop() noexcept {
  clear();
  has_row_ = false;
  t_s_ = -std::numeric_limits<double>::infinity();
}

void StartSearch::advance(double t_s) noexcept {
  if (has_row_ && t_s > t_s_) {
    // A row holds for so long at most; then the robot is taken to stand, and to be anywhere it may have gone.
    const double dt_s = t_s - t_s_;
    const double held_s = std::clamp(row_.t_s + config_.max_hold_s - t_s_, 0.0, dt_s);
    const double middle = now_.pose.z() + 0.5 * row_.omega_radps * held_s;
    const Eigen::Vector3d step(row_.vx_mps * held_s, row_.vy_mps * held_s, row_.omega_radps * held_s);
    now_.pose.x() += std::cos(middle) * step.x() - std::sin(middle) * step.y();
    now_.pose.y() += std::sin(middle) * step.x() + std::cos(middle) * step.y();
    now_.pose.z() += step.z();
    now_.path_m += step.head<2>().norm();
    const double row_s = std::max(t_s - row_.t_s, dt_s);
    now_.position_variance_m2 +=
        (square(config_.odometry.sigma_vx_mps) + square(config_.odometry.sigma_vy_mps)) * held_s * row_s;
    now_.heading_variance_rad2 += square(config_.odometry.sigma_omega_radps) * held_s * row_s;
    const double overdue_s = dt_s - held_s;
    now_.position_variance_m2 += square(config_.hold_walk_mps) * overdue_s * row_s * row_s;
    now_.heading_variance_rad2 += square(config_.hold_walk_radps) * overdue_s * row_s * row_s;
  }
  t_s_ = t_s;
}

void StartSearch::process(const model::OdometrySample& row) noexcept {
  if (!model::is_finite(row) || (has_row_ && row.t_s < t_s_)) return;
  advance(row.t_s);
  row_ = row;
  has_row_ = true;
}

void StartSearch::process(const model::RangeSample& range) noexcept {
  if (!std::isfinite(range.t_s) || range.t_s < t_s_ - search_.latest_s ||
      !(range.range_m > config_.min_range_m) || !(range.range_m <= config_.max_range_m)) {
    return;
  }
  const int tag = site_.tag_slot(range.tag_id);
  const int anchor = site_.anchor_index(range.anchor_id);
  if (tag < 0 || anchor < 0 || !site_.knows_pair(anchor, tag)) return;
  advance(std::max(range.t_s, t_s_));
  double& last_s = last_taken_s_[static_cast<std::size_t>(anchor) * kMaxTags + static_cast<std::size_t>(tag)];
  if (range.t_s - last_s < search_.spacing_s) return;
  last_s = range.t_s;
  forget_old();
  if (count_ == kMaxRanges) {
    first_ = (first_ + 1) % kMaxRanges;
    --count_;
  }
  const model::OdometrySample row = has_row_ ? row_ : model::OdometrySample{.t_s = range.t_s};
  Odometer at = now_;
  const double back_s = t_s_ - range.t_s + config_.range_delay_s;
  if (back_s != 0.0) {
    const Eigen::Vector3d step(-row.vx_mps * back_s, -row.vy_mps * back_s, -row.omega_radps * back_s);
    at.pose = Frame(at.pose).compose(step);
    at.path_m -= step.head<2>().norm();
  }
  seen(count_++) = {
      .t_s = range.t_s, .anchor = anchor, .tag = tag, .range_m = range.range_m, .row = row, .at = at};
}

StartSearch::Term StartSearch::term_of(const Seen& seen) const noexcept {
  const double path_m = now_.path_m - seen.at.path_m;
  const double age_s = t_s_ - seen.t_s;
  const double heading_variance = now_.heading_variance_rad2 - seen.at.heading_variance_rad2 +
                                  square(config_.yaw_rate_bias_radps * age_s);
  const Eigen::Vector3d back = between(now_.pose, seen.at.pose);
  return {.seen = &seen,
          .back = back,
          .cos_back = std::cos(back.z()),
          .sin_back = std::sin(back.z()),
          .drift_variance_m2 = now_.position_variance_m2 - seen.at.position_variance_m2 +
                               square(config_.scale_sigma * path_m) +
                               heading_variance * square(path_m) / 3.0};
}

void StartSearch::forget_old() noexcept {
  while (count_ > 0 && t_s_ - seen(0).t_s > search_.window_s) {
    first_ = (first_ + 1) % kMaxRanges;
    --count_;
  }
}

double StartSearch::share() const noexcept {
  return std::min(search_.spacing_s / search_.correlation_s, 1.0);
}

template <class Each>
void StartSearch::walk_back(const Eigen::Vector3d& pose, int chart, std::size_t every,
                            const Each& each) const noexcept {
  const std::size_t first = count_ % every;
  if (surface_.chart_count() == 1) {
    for (std::size_t i = first; i < count_; i += every) each(i, chart);
    return;
  }
  chart = surface_.follow(chart, pose.x(), pose.y());
  const Frame now(pose);
  for (std::size_t i = count_; i-- > 0;) {
    const Eigen::Vector3d then = now.compose(terms_[i].back);
    chart = surface_.follow(chart, then.x(), then.y());
    if (i % every == first) each(i, chart);
  }
}

StartSearch::Residual StartSearch::residual(const Term& term, const Eigen::Vector3d& pose,
                                            const Eigen::Vector3d& then, int chart) const noexcept {
  const Seen& seen = *term.seen;
  CoreVector core = CoreVector::Zero();
  core.segment<3>(kX) = then;
  Residual out;
  out.predicted = measure_range(surface_, core, seen.row, site_.pair(seen.anchor, seen.tag), chart);
  out.e_m = seen.range_m - out.predicted.range_m;
  const Eigen::Vector2d lever = core.segment<2>(kX) - pose.head<2>();
  out.d_pose = out.predicted.d_core.segment<3>(kX);
  out.d_pose(2) += -out.d_pose(0) * lever.y() + out.d_pose(1) * lever.x();
  return out;
}

double StartSearch::variance_m2(const Term& term, const RangeMeasurement& predicted,
                                int chart) const noexcept {
  const PairOf pair(site_, term.seen->tag, predicted);
  const model::SurfaceMismatch& mismatch = surface_.mismatch(chart);
  return square(config_.range_sigma_m) + term.drift_variance_m2 +
         pair.by_anchor.dot(site_.anchor(term.seen->anchor).covariance * pair.by_anchor) +
         site_.lever_arm_variance_m2() * pair.by_lever_arm.squaredNorm() +
         pair.by_frame.dot(site_.frame_covariance() * pair.by_frame) +
         square(mismatch.sigma_m * pair.by_ground(0)) +
         square(mismatch.slope_sigma) * pair.by_ground.tail<2>().squaredNorm();
}

double StartSearch::coarse_cost(const Eigen::Vector3d& pose, int chart, double width_m,
                                double most) const noexcept {
  const std::size_t every = std::max<std::size_t>(1, count_ / kCoarseRanges);
  RobustCost sum(search_);
  const Frame now(pose);
  int looked_at = 0;
  bool is_given_up = false;
  walk_back(pose, chart, every, [&](std::size_t i, int on) {
    if (is_given_up) return;
    if (++looked_at % kLooksPerCheck == 0 && sum.sum() > most) is_given_up = true;
    const Term& term = terms_[i];
    const Eigen::Vector3d then = now.compose(term.back);
    const PairParameters pair = site_.pair(term.seen->anchor, term.seen->tag);
    const Eigen::Vector3d& lever = pair.lever_arm_m;
    const double c = now.cos() * term.cos_back - now.sin() * term.sin_back;
    const double s = now.sin() * term.cos_back + now.cos() * term.sin_back;
    const Eigen::Vector3d antenna(then.x() + c * lever.x() - s * lever.y(),
                                  then.y() + s * lever.x() + c * lever.y(),
                                  surface_.height_m(then.x(), then.y(), on) + lever.z());
    const double predicted_m = pair.gamma * (antenna - pair.position_m).norm() + pair.beta_m;
    sum.add((term.seen->range_m - predicted_m) / width_m);
  });
  return sum.sum();
}

StartSearch::Sums StartSearch::look(const Eigen::Vector3d& pose, int chart, std::size_t every,
                                    bool anew) noexcept {
  Sums out;
  out.information.diagonal() << 1.0 / square(kFarStart_m), 1.0 / square(kFarStart_m),
      1.0 / square(kAnyHeading_rad);
  RobustCost cost(search_);
  const Frame now(pose);
  walk_back(pose, chart, every, [&](std::size_t i, int on) {
    const Residual r = residual(terms_[i], pose, now.compose(terms_[i].back), on);
    if (anew) variances_m2_[i] = variance_m2(terms_[i], r.predicted, on);
    const double e = r.e_m / std::sqrt(variances_m2_[i]);
    const double weight = robust_weight(e, search_);
    cost.add(e);
    out.weights += weight;
    const double w = share() * weight / variances_m2_[i];
    out.information.noalias() += w * r.d_pose.transpose() * r.d_pose;
    out.gradient.noalias() += w * r.e_m * r.d_pose.transpose();
  });
  out.cost = share() * cost.sum();
  return out;
}

StartSearch::Hypothesis StartSearch::refine(const model::PlanarPose& start, std::size_t every,
                                            int steps) noexcept {
  Eigen::Vector3d pose = vector_of(start);
  double damping = 1e-3;
  // The variances hardly change on the way, and cost more than all else.
  Sums sums = look(pose, start.chart, every, true);
  for (int step = 0; step < steps; ++step) {
    Eigen::Matrix3d damped = sums.information;
    damped.diagonal() *= 1.0 + damping;
    const Eigen::Vector3d change = damped.ldlt().solve(sums.gradient);
    if (!change.allFinite()) break;
    const Sums next = look(pose + change, start.chart, every, false);
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
  sums = look(pose, start.chart, every, true);
  return {.pose = {pose.x(), pose.y(), model::wrap_angle(pose.z()),
                   surface_.follow(start.chart, pose.x(), pose.y())},
          .covariance = sums.information.inverse(),
          .cost = sums.cost,
          .mean_weight = sums.weights * static_cast<double>(every) / static_cast<double>(count_)};
}

void StartSearch::refine_all(std::span<const model::PlanarPose> starts) noexcept {
  const std::size_t every = std::max<std::size_t>(1, count_ / kRoughRanges);
  std::array<Hypothesis, kRefined> rough;
  const std::size_t rough_count = std::min(starts.size(), rough.size());
  for (std::size_t i = 0; i < rough_count; ++i) rough[i] = refine(starts[i], every, kRoughSteps);
  const auto end = rough.begin() + static_cast<std::ptrdiff_t>(rough_count);
  std::sort(rough.begin(), end, [](const Hypothesis& a, const Hypothesis& b) { return a.cost < b.cost; });
  const auto scaled = [&](const Hypothesis& h) { return static_cast<double>(every) * h.cost; };
  double least = rough_count > 0 ? scaled(rough[0]) : 0.0;
  for (std::size_t i = 0; i < hypothesis_count_; ++i) least = std::min(least, hypotheses_[i].cost);
  std::size_t refined = 0;
  for (auto start = rough.begin(); start != end && refined < kMaxHypotheses; ++start) {
    if (!(scaled(*start) < least + kRoughOdds * search_.odds)) break;
    const auto is_near = [&](const Hypothesis& other) { return is_same(start->pose, other.pose); };
    const auto known = hypotheses_.begin() + static_cast<std::ptrdiff_t>(hypothesis_count_);
    if (std::any_of(rough.begin(), start, is_near) || std::any_of(hypotheses_.begin(), known, is_near)) {
      continue;
    }
    keep(refine(start->pose, 1, kSteps));
    ++refined;
  }
}

void StartSearch::add_calibration(Hypothesis& hypothesis) noexcept {
  // The solution is linear in the residuals near by: what the parameters' errors, common to many ranges, do
  // to it is not averaged away.
  std::array<Eigen::Matrix3d, kMaxTags> by_lever_arm;
  by_lever_arm.fill(Eigen::Matrix3d::Zero());
  Eigen::Matrix<double, 3, kFrameSize> by_frame = Eigen::Matrix<double, 3, kFrameSize>::Zero();
  const Eigen::Vector3d pose = vector_of(hypothesis.pose);
  const Frame now(pose);
  walk_back(pose, hypothesis.pose.chart, 1, [&](std::size_t i, int chart) {
    const Term& term = terms_[i];
    const Seen& seen = *term.seen;
    const Residual r = residual(term, pose, now.compose(term.back), chart);
    const double variance = variance_m2(term, r.predicted, chart);
    const double weight = share() * robust_weight(r.e_m / std::sqrt(variance), search_) / variance;
    const PairOf pair(site_, seen.tag, r.predicted);
    const Eigen::Vector3d pull = weight * r.d_pose.transpose();
    by_anchor_[static_cast<std::size_t>(seen.anchor)].noalias() += pull * pair.by_anchor.transpose();
    by_lever_arm[static_cast<std::size_t>(seen.tag)].noalias() += pull * pair.by_lever_arm.transpose();
    by_frame.noalias() += pull * pair.by_frame.transpose();
  });
  Eigen::Matrix3d spread = by_frame * site_.frame_covariance() * by_frame.transpose();
  for (const Eigen::Matrix3d& by : by_lever_arm) {
    spread.noalias() += site_.lever_arm_variance_m2() * by * by.transpose();
  }
  for (std::size_t i = 0; i < count_; ++i) {
    const int anchor = terms_[i].seen->anchor;
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
  for (std::size_t i = 0; i < hypothesis_count_; ++i) {
    Hypothesis& other = hypotheses_[i];
    if (!is_same(hypothesis.pose, other.pose)) continue;
    if (hypothesis.cost < other.cost) other = hypothesis;
    return;
  }
  if (hypothesis_count_ < kMaxHypotheses) {
    hypotheses_[hypothesis_count_++] = hypothesis;
    return;
  }
  const auto worst =
      std::max_element(hypotheses_.begin(), hypotheses_.end(),
                       [](const Hypothesis& a, const Hypothesis& b) { return a.cost < b.cost; });
  if (hypothesis.cost < worst->cost) *worst = hypothesis;
}

void StartSearch::try_chart(int chart, std::ptrdiff_t rings) noexcept {
  std::array<std::pair<double, Eigen::Vector3d>, kRefined> starts;
  std::size_t start_count = 0;
  const auto is_less = [](const auto& a, const auto& b) { return a.first < b.first; };
  for (std::ptrdiff_t ring = 0; ring < rings; ++ring) {
    const Term& term = *shortest_[static_cast<std::size_t>(ring)];
    const Eigen::Vector3d anchor = site_.anchor(term.seen->anchor).values.head<3>();
    const double height_m = anchor.z() - surface_.at(anchor.x(), anchor.y(), chart).z_m;
    const double radius_m =
        std::sqrt(std::max(square(term.seen->range_m) - square(height_m), square(0.2 * term.seen->range_m)));
    const double width_m = std::hypot(0.2 * radius_m, 0.5);
    for (int i = 0; i < kRingPoints; ++i) {
      const double angle = 2.0 * std::numbers::pi * i / kRingPoints;
      for (int j = 0; j < kHeadings; ++j) {
        // The range was measured then; the hypothesis is about now.
        const double heading = 2.0 * std::numbers::pi * (j + 0.5 * (i % 2)) / kHeadings;
        const Eigen::Vector3d then(anchor.x() + radius_m * std::cos(angle),
                                   anchor.y() + radius_m * std::sin(angle), heading);
        const Eigen::Vector3d pose = Frame(then).compose(between(term.back, Eigen::Vector3d::Zero()));
        // The best so far are a heap, the worst of them on top.
        const double most = start_count < kRefined ? kAnyCost : starts[0].first;
        const double cost = coarse_cost(pose, chart, width_m, most);
        if (!(cost < most)) continue;
        if (start_count == kRefined) std::pop_heap(starts.begin(), starts.end(), is_less);
        start_count = std::min(start_count + 1, kRefined);
        starts[start_count - 1] = {cost, pose};
        std::push_heap(starts.begin(), starts.begin() + static_cast<std::ptrdiff_t>(start_count), is_less);
      }
    }
  }
  const auto chosen = starts.begin() + static_cast<std::ptrdiff_t>(start_count);
  std::sort_heap(starts.begin(), chosen, is_less);
  std::array<model::PlanarPose, kRefined> likely;
  std::transform(starts.begin(), chosen, likely.begin(), [chart](const auto& start) {
    return model::PlanarPose{start.second.x(), start.second.y(), start.second.z(), chart};
  });
  refine_all({likely.data(), static_cast<std::size_t>(chosen - starts.begin())});
}

bool StartSearch::begin_search() noexcept {
  hypothesis_count_ = 0;
  settled_ = false;
  forget_old();
  if (count_ < 3) return false;
  for (std::size_t i = 0; i < count_; ++i) terms_[i] = term_of(seen(i));
  return true;
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
  // The anchors that were nearest, each with its shortest range.
  std::fill(shortest_.begin(), shortest_.end(), nullptr);
  for (std::size_t i = 0; i < count_; ++i) {
    const Term*& least = shortest_[static_cast<std::size_t>(terms_[i].seen->anchor)];
    if (least == nullptr || terms_[i].seen->range_m < least->seen->range_m) least = &terms_[i];
  }
  const auto heard = std::remove(shortest_.begin(), shortest_.end(), nullptr);
  std::sort(shortest_.begin(), heard, [](const Term* a, const Term* b) {
    return std::pair(a->seen->range_m, a->seen->anchor) < std::pair(b->seen->range_m, b->seen->anchor);
  });
  const auto rings = std::min<std::ptrdiff_t>(kRings, heard - shortest_.begin());

  for (int chart = 0; chart < surface_.chart_count(); ++chart) try_chart(chart, rings);
  // What a line of anchors, or one tag's straight path, cannot tell apart.
  std::array<model::PlanarPose, 2 * kMaxHypotheses> twins;
  std::size_t twin_count = 0;
  for (std::size_t i = 0; i < hypothesis_count_; ++i) {
    const model::PlanarPose pose = hypotheses_[i].pose;
    twins[twin_count++] = {pose.x_m, pose.y_m, pose.theta_rad + std::numbers::pi, pose.chart};
    if (rings < 2) continue;
    const Eigen::Vector2d a = site_.anchor(shortest_[0]->seen->anchor).values.head<2>();
    const Eigen::Vector2d b = site_.anchor(shortest_[1]->seen->anchor).values.head<2>();
    const double along = std::atan2(b.y() - a.y(), b.x() - a.x());
    const Eigen::Vector2d from(pose.x_m - a.x(), pose.y_m - a.y());
    const Eigen::Vector2d axis(std::cos(along), std::sin(along));
    const Eigen::Vector2d mirrored = a + 2.0 * axis.dot(from) * axis - from;
    twins[twin_count++] = {mirrored.x(), mirrored.y(), 2.0 * along - pose.theta_rad, pose.chart};
  }
  refine_all({twins.data(), twin_count});
  return end_search();
}

std::span<const StartSearch::Hypothesis> StartSearch::end_search() noexcept {
  if (hypothesis_count_ == 0) return {};
  const auto end = hypotheses_.begin() + static_cast<std::ptrdiff_t>(hypothesis_count_);
  std::sort(hypotheses_.begin(), end,
            [](const Hypothesis& a, const Hypothesis& b) { return a.cost < b.cost; });
  const double given_up = hypotheses_[0].cost + search_.odds;
  hypothesis_count_ = static_cast<std::size_t>(
      std::find_if(hypotheses_.begin(), end, [&](const Hypothesis& h) { return !(h.cost < given_up); }) -
      hypotheses_.begin());
  for (std::size_t i = 0; i < hypothesis_count_; ++i) add_calibration(hypotheses_[i]);

  if (hypothesis_count_ == 1) {
    const Hypothesis& only = hypotheses_[0];
    const Eigen::Matrix2d position = only.covariance.topLeftCorner<2, 2>();
    Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> axes;
    axes.computeDirect(position, Eigen::EigenvaluesOnly);
    settled_ = axes.eigenvalues()(1) < square(search_.position_sigma_m) &&
               only.covariance(2, 2) < square(search_.heading_sigma_rad) &&
               only.mean_weight > search_.weight_share;
  }
  return {hypotheses_.data(), hypothesis_count_};
}

double StartSearch::cautious_cost(const model::PlanarPose& pose) noexcept {
  std::fill(anchor_costs_.begin(), anchor_costs_.end(), 0.0);
  for (std::size_t i = 0; i < count_; ++i) terms_[i] = term_of(seen(i));
  const Eigen::Vector3d at = vector_of(pose);
  const Frame now(at);
  walk_back(at, pose.chart, 1, [&](std::size_t i, int chart) {
    const Term& term = terms_[i];
    const Residual r = residual(term, at, now.compose(term.back), chart);
    anchor_costs_[static_cast<std::size_t>(term.seen->anchor)] +=
        share() * robust_cost(r.e_m / std::sqrt(variance_m2(term, r.predicted, chart)), search_);
  });
  double sum = 0.0;
  if (model::is_ablated(model::Mechanism::kCautiousCost)) {
    for (const double cost : anchor_costs_) sum += cost;
    return sum;
  }
  for (const double cost : anchor_costs_) sum += search_.anchor_say * std::log1p(cost / search_.anchor_say);
  return sum;
}

}  // namespace groma::filter
