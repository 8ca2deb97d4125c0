#include "host/evaluation/evaluation.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <utility>

#include <Eigen/Cholesky>

#include "host/model/median.hpp"
#include "host/model/pose.hpp"

namespace groma::evaluation {

namespace {

constexpr double kDegreesOfFreedom = 3.0;

std::optional<double> nees(const Eigen::Vector3d& error, const Eigen::Matrix3d& covariance) {
  const Eigen::LLT<Eigen::Matrix3d> factor(covariance);
  if (factor.info() != Eigen::Success) return std::nullopt;
  const double value = error.dot(factor.solve(error)) / kDegreesOfFreedom;
  return std::isfinite(value) ? std::optional(value) : std::nullopt;
}

// The estimate at t_s, interpolated between the row at or before it and the next.
std::optional<model::PlanarEstimate> estimate_at(std::span<const model::PlanarEstimate> rows, double t_s) {
  const auto after = std::upper_bound(rows.begin(), rows.end(), t_s,
                                      [](double t, const model::PlanarEstimate& row) { return t < row.t_s; });
  if (after == rows.begin()) return std::nullopt;
  const model::PlanarEstimate& earlier = *std::prev(after);
  if (earlier.t_s == t_s) return earlier;
  if (after == rows.end() || after->t_s - earlier.t_s > kMaxGap_s) return std::nullopt;
  const double fraction = (t_s - earlier.t_s) / (after->t_s - earlier.t_s);
  model::PlanarEstimate between = earlier;
  between.t_s = t_s;
  between.x_m += fraction * (after->x_m - earlier.x_m);
  between.y_m += fraction * (after->y_m - earlier.y_m);
  between.yaw_rad += fraction * model::wrap_angle(after->yaw_rad - earlier.yaw_rad);
  return between;
}

// The samples of one kind of error.
class Samples {
 public:
  void add(double value) {
    max_ = std::max(max_, value);
    values_.push_back(value);
  }
  [[nodiscard]] Statistics statistics() const {
    const auto n = static_cast<double>(values_.size());
    double sum = 0.0;
    double squares = 0.0;
    for (const double value : values_) {
      sum += value;
      squares += value * value;
    }
    const double mean = sum / n;
    double deviations = 0.0;
    for (const double value : values_) deviations += (value - mean) * (value - mean);
    return {max_, mean, std::sqrt(deviations / n), std::sqrt(squares / n)};
  }
  [[nodiscard]] std::size_t count() const { return values_.size(); }

 private:
  double max_ = 0.0;
  std::vector<double> values_;
};

}  // namespace

std::vector<PoseError> pose_errors(std::span<const model::PlanarEstimate> estimate,
                                   std::span<const model::PoseSample> truth) {
  std::vector<PoseError> errors;
  errors.reserve(truth.size());
  for (const model::PoseSample& pose : truth) {
    const std::optional<model::PlanarEstimate> row = estimate_at(estimate, pose.t_s);
    if (!row) continue;
    const Eigen::Vector3d error(row->x_m - pose.x_m, row->y_m - pose.y_m,
                                model::wrap_angle(row->yaw_rad - pose.yaw_rad));
    errors.push_back({pose.t_s, error.x(), error.y(), error.z(), nees(error, row->covariance)});
  }
  return errors;
}

Coverage coverage(std::span<const model::PlanarEstimate> estimate, std::span<const model::PoseSample> truth,
                  std::span<const PoseError> errors) {
  if (errors.empty()) return {};
  std::vector<double> intervals_s{kMaxGap_s};
  for (std::size_t i = 1; i < truth.size(); ++i) intervals_s.push_back(truth[i].t_s - truth[i - 1].t_s);
  const double near_s = std::max(kMaxGap_s, model::median(std::move(intervals_s)));
  std::size_t near = 0;
  for (const model::PlanarEstimate& row : estimate) {
    // The first scored time that is not too early.
    const auto at = std::lower_bound(errors.begin(), errors.end(), row.t_s - near_s,
                                     [](const PoseError& error, double t_s) { return error.t_s < t_s; });
    if (at != errors.end() && at->t_s <= row.t_s + near_s) ++near;
  }
  return {.estimate = static_cast<double>(near) / static_cast<double>(estimate.size()),
          .truth = static_cast<double>(errors.size()) / static_cast<double>(truth.size())};
}

std::vector<FrozenSpan> frozen_spans(std::span<const model::PoseSample> truth) {
  const auto step_m = [&](std::size_t i) {
    return std::hypot(truth[i + 1].x_m - truth[i].x_m, truth[i + 1].y_m - truth[i].y_m);
  };
  const auto speed_mps = [&](std::size_t i) { return step_m(i) / (truth[i + 1].t_s - truth[i].t_s); };
  std::vector<FrozenSpan> out;
  std::size_t first = 0;
  for (std::size_t i = 1; i + 2 < truth.size(); ++i) {
    if (truth[i].x_m != truth[first].x_m || truth[i].y_m != truth[first].y_m ||
        truth[i].yaw_rad != truth[first].yaw_rad) {
      first = i;
    }
    // The span may end with row i and jump to row i + 1; rows first - 1 and i + 2 enclose it.
    if (first == 0 || i + 1 < first + kFewRepeats) continue;
    if (truth[i].t_s - truth[first].t_s > kMaxFrozen_s || step_m(i) < kLeastJump_m) continue;
    if (speed_mps(i) <= kJumpFactor * std::max(speed_mps(first - 1), speed_mps(i + 1))) continue;
    out.push_back({.from_s = truth[first].t_s, .to_s = truth[i].t_s, .jump_m = step_m(i)});
  }
  return out;
}

std::optional<Evaluation> evaluate(std::span<const PoseError> errors) {
  if (errors.empty()) return std::nullopt;
  Samples ate_m;
  Samples ate_rad;
  Samples nees;
  std::size_t inside = 0;
  for (const PoseError& error : errors) {
    ate_m.add(std::hypot(error.x_m, error.y_m));
    ate_rad.add(std::abs(error.yaw_rad));
    if (!error.nees) continue;
    nees.add(*error.nees);
    if (*error.nees * kDegreesOfFreedom <= kChiSquare95) ++inside;
  }
  Evaluation evaluation;
  evaluation.samples = errors.size();
  evaluation.ate_m = ate_m.statistics();
  evaluation.ate_rad = ate_rad.statistics();
  evaluation.samples_without_covariance = errors.size() - nees.count();
  if (nees.count() > 0) {
    const Statistics statistics = nees.statistics();
    evaluation.nees = Consistency{statistics.max, statistics.mean, statistics.std,
                                  static_cast<double>(inside) / static_cast<double>(nees.count())};
  }
  return evaluation;
}

}  // namespace groma::evaluation
