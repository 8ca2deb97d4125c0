#include "host/filter/filter.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "host/filter/propagation.hpp"
#include "host/filter/range_measurement.hpp"

namespace groma::filter {

namespace {

// A jump in time is crossed in so many steps at most.
constexpr double kMaxSteps = 400.0;
// Doubt does not widen the pose beyond these.
constexpr double kMaxDoubt_m = 10.0;
constexpr double kMaxDoubt_rad = 1.0;

double square(double value) noexcept {
  return value * value;
}

Learning learning(Model model) noexcept {
  if (model == Model::kJoint) return Learning::kAll;
  if (model == Model::kAnchorStates) return Learning::kPositions;
  return Learning::kNothing;
}

bool finite(const model::OdometrySample& row) noexcept {
  return std::isfinite(row.t_s) && std::isfinite(row.vx_mps) && std::isfinite(row.vy_mps) &&
         std::isfinite(row.omega_radps);
}

}  // namespace

Filter::Filter(model::Surface surface, std::span<const model::Tag> tags,
               const model::Calibration& calibration, const Config& config)
    : surface_(std::move(surface)),
      config_(config),
      parameters_(tags, calibration),
      gate_(config.gate),
      covariance_(parameters_, calibration, config.lever_arm_sigma_m, learning(config.model)) {
  if (calibration.range_delay_sigma_s > 0.0) {
    config_.range_delay_s = calibration.range_delay_s;
    config_.range_delay_sigma_s = std::hypot(calibration.range_delay_sigma_s, config_.range_delay_change_s);
  }
}

std::size_t Filter::anchors() const noexcept {
  return static_cast<std::size_t>(parameters_.anchor_count());
}

std::size_t Filter::tags() const noexcept {
  return static_cast<std::size_t>(parameters_.tag_count());
}

void Filter::start(const Start& start) noexcept {
  t_s_ = start.t_s;
  core_.setZero();
  core_.segment<3>(kX) << start.pose.x_m, start.pose.y_m, model::wrap_angle(start.pose.theta_rad);
  core_(kDelay) = config_.range_delay_s;

  // Without a row, nothing is known of the velocity but what a robot may do.
  if (!has_row_) row_ = {.t_s = start.t_s};
  CoreVector variances;
  variances(kX) = square(start.position_sigma_m);
  variances(kY) = square(start.position_sigma_m);
  variances(kTheta) = square(start.heading_sigma_rad);
  variances(kScale) = square(config_.scale_sigma);
  variances(kYawBias) = square(config_.yaw_rate_bias_radps);
  variances(kDelay) = square(config_.range_delay_sigma_s);
  variances(kRowVx) = square(has_row_ ? config_.odometry.sigma_vx_mps : config_.hold_walk_mps);
  variances(kRowVy) = square(has_row_ ? config_.odometry.sigma_vy_mps : config_.hold_walk_mps);
  variances(kRowOmega) = square(has_row_ ? config_.odometry.sigma_omega_radps : config_.hold_walk_radps);
  covariance_.reset_core(variances);
  gate_.reset(t_s_);
  started_ = true;
}

OdometryOutcome Filter::process(const model::OdometrySample& row) noexcept {
  const OdometryOutcome outcome = take(row);
  switch (outcome) {
    case OdometryOutcome::kUsed:
      ++counters_.odometry_used;
      break;
    case OdometryOutcome::kUsedLate:
      ++counters_.odometry_used_late;
      break;
    case OdometryOutcome::kStored:
      ++counters_.odometry_stored;
      break;
    case OdometryOutcome::kOutOfOrder:
      ++counters_.odometry_out_of_order;
      break;
    case OdometryOutcome::kBadValue:
      ++counters_.odometry_bad_value;
      break;
  }
  return outcome;
}

RangeResult Filter::process(const model::RangeSample& range) noexcept {
  const RangeResult result = take(range);
  switch (result.outcome) {
    case RangeOutcome::kUsed:
      ++counters_.ranges_used;
      break;
    case RangeOutcome::kGated:
      ++counters_.ranges_gated;
      break;
    case RangeOutcome::kUnknownTag:
      ++counters_.ranges_unknown_tag;
      break;
    case RangeOutcome::kUnknownAnchor:
      ++counters_.ranges_unknown_anchor;
      break;
    case RangeOutcome::kBadValue:
      ++counters_.ranges_bad_value;
      break;
    case RangeOutcome::kOutOfOrder:
      ++counters_.ranges_out_of_order;
      break;
    case RangeOutcome::kNotStarted:
      ++counters_.ranges_not_started;
      break;
    case RangeOutcome::kNotModelled:
      ++counters_.ranges_not_modelled;
      break;
  }
  return result;
}

OdometryOutcome Filter::take(const model::OdometrySample& row) noexcept {
  if (!finite(row)) return OdometryOutcome::kBadValue;
  if (has_row_ && !(row.t_s > row_.t_s)) return OdometryOutcome::kOutOfOrder;
  if (!started_) {
    row_ = row;
    has_row_ = true;
    return OdometryOutcome::kStored;
  }
  const bool late = row.t_s < t_s_;
  advance_to(row.t_s);
  hold(row);
  return late ? OdometryOutcome::kUsedLate : OdometryOutcome::kUsed;
}

RangeResult Filter::take(const model::RangeSample& range) noexcept {
  if (!std::isfinite(range.t_s) || !(range.range_m > config_.min_range_m) ||
      !(range.range_m <= config_.max_range_m)) {
    return {.outcome = RangeOutcome::kBadValue};
  }
  if (config_.model == Model::kOdometry) return {.outcome = RangeOutcome::kNotModelled};
  const int tag = parameters_.tag_slot(range.tag_id);
  if (tag < 0) return {.outcome = RangeOutcome::kUnknownTag};
  const int anchor = parameters_.anchor_slot(range.anchor_id);
  if (anchor < 0 || !parameters_.knows_pair(anchor, tag)) return {.outcome = RangeOutcome::kUnknownAnchor};
  if (!started_) return {.outcome = RangeOutcome::kNotStarted};
  if (range.t_s < t_s_) return {.outcome = RangeOutcome::kOutOfOrder};
  advance_to(range.t_s);

  const bool whole = config_.model != Model::kOriginal && config_.model != Model::kInflated;
  const RangeMeasurement measurement = config_.model == Model::kOriginal
                                           ? measure_distance(surface_, core_, row_, parameters_, anchor, tag)
                                           : measure_range(surface_, core_, row_, parameters_, anchor, tag);
  Projected projected;
  if (whole) {
    covariance_.project(measurement, projected);
  } else {
    projected.variance = covariance_.project_core(measurement.d_core, projected.core);
    if (config_.model == Model::kInflated) projected.variance += covariance_.parameter_variance(measurement);
  }

  RangeResult result;
  result.innovation_m = range.range_m - measurement.range_m;
  result.innovation_variance_m2 = projected.variance + square(config_.range_sigma_m * gate_.noise_scale());
  result.nis = square(result.innovation_m) / result.innovation_variance_m2;
  result.weight = gate_.weigh(anchor, tag, t_s_, result.innovation_m, result.innovation_variance_m2);
  counters_.doubts = gate_.doubts_begun();
  if (!(result.weight > 0.0)) {
    result.outcome = RangeOutcome::kGated;
    return result;
  }

  // A weight below one stands for that much more noise: S / weight in place of S.
  const double variance = result.innovation_variance_m2 / result.weight;
  core_ += projected.core * (result.innovation_m / variance);
  core_(kTheta) = model::wrap_angle(core_(kTheta));
  if (!whole) {
    covariance_.correct_core(projected.core, variance);
  } else {
    covariance_.correct(projected, variance);
    covariance_.mask(projected.parameters);
    parameters_.values() += projected.parameters * (result.innovation_m / variance);
  }
  result.outcome = RangeOutcome::kUsed;
  return result;
}

bool Filter::advance_to(double t_s) noexcept {
  if (!started_ || !std::isfinite(t_s) || !(t_s > t_s_)) return false;
  const double dt_s = t_s - t_s_;
  const double steps = std::clamp(std::ceil(dt_s / kMaxStep_s), 1.0, kMaxSteps);
  for (int i = 0; i < static_cast<int>(steps); ++i) step(dt_s / steps);
  t_s_ = t_s;
  return true;
}

void Filter::hold(const model::OdometrySample& row) noexcept {
  row_ = row;
  has_row_ = true;
  core_.segment<3>(kRowVx).setZero();
  covariance_.renew(kRowVx, square(config_.odometry.sigma_vx_mps));
  covariance_.renew(kRowVy, square(config_.odometry.sigma_vy_mps));
  covariance_.renew(kRowOmega, square(config_.odometry.sigma_omega_radps));
}

void Filter::step(double dt_s) noexcept {
  const Motion motion = move(surface_, core_, row_, dt_s);
  core_.segment<3>(kX) = motion.pose;
  core_(kTheta) = model::wrap_angle(core_(kTheta));
  covariance_.propagate(motion.d_core);
  t_s_ += dt_s;

  covariance_.grow(kScale, square(config_.scale_walk) * dt_s);
  covariance_.grow(kYawBias, square(config_.yaw_rate_bias_walk) * dt_s);
  // A row older than it may be tells less and less of the velocity.
  const double overdue_s = std::clamp(t_s_ - row_.t_s - config_.max_hold_s, 0.0, dt_s);
  if (overdue_s > 0.0) {
    covariance_.grow(kRowVx, square(config_.hold_walk_mps) * overdue_s);
    covariance_.grow(kRowVy, square(config_.hold_walk_mps) * overdue_s);
    covariance_.grow(kRowOmega, square(config_.hold_walk_radps) * overdue_s);
  }
  if (gate_.doubts(t_s_)) {
    const CoreMatrix& core = covariance_.core();
    if (core(kX, kX) + core(kY, kY) < square(kMaxDoubt_m)) {
      covariance_.grow(kX, square(config_.gate.doubt_position_m) * dt_s);
      covariance_.grow(kY, square(config_.gate.doubt_position_m) * dt_s);
    }
    if (core(kTheta, kTheta) < square(kMaxDoubt_rad)) {
      covariance_.grow(kTheta, square(config_.gate.doubt_heading_rad) * dt_s);
    }
  }
}

Estimate Filter::estimate() const noexcept {
  return {.t_s = t_s_,
          .pose = {core_(kX), core_(kY), core_(kTheta)},
          .covariance = covariance_.core().topLeftCorner<3, 3>(),
          .scale_error = core_(kScale),
          .yaw_rate_bias_radps = core_(kYawBias),
          .range_delay_s = core_(kDelay)};
}

}  // namespace groma::filter
