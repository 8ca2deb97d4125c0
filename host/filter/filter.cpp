#include "host/filter/filter.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include <Eigen/Cholesky>

#include "host/filter/link_delay.hpp"
#include "host/filter/pose_measurement.hpp"
#include "host/filter/position_measurement.hpp"
#include "host/filter/present_pose.hpp"
#include "host/filter/propagation.hpp"
#include "host/filter/range_measurement.hpp"
#include "host/filter/zero_velocity_measurement.hpp"

namespace groma::filter {

namespace {

// A jump in time is crossed in so many steps at most.
constexpr double kMaxSteps = 400.0;
constexpr double kNever = -std::numeric_limits<double>::infinity();
// Doubt does not widen the pose beyond these.
constexpr double kMaxDoubt_m = 10.0;
constexpr double kMaxDoubt_rad = 1.0;

using model::square;

Learning learning(Model model) noexcept {
  if (model == Model::kJoint) return Learning::kAll;
  if (model == Model::kAnchorStates) return Learning::kPositions;
  return Learning::kNothing;
}

// The calibration as it holds on another drive than its own.
model::Calibration on_another_drive(model::Calibration calibration, const Config& config) {
  if (calibration.range_noise) {
    calibration.range_noise->slow_sigma_m *= config.slow_error_growth;
    calibration.range_noise->slow_time_s *= config.slow_time_growth;
  }
  if (calibration.range_delay_sigma_s > 0.0) {
    calibration.range_delay_sigma_s =
        std::hypot(calibration.range_delay_sigma_s, config.range_delay_change_s);
  }
  return calibration;
}

Filter::Snapshot begin(const Site& site, const Config& config, double white_sigma_m) {
  const Parameters parameters(site, config.active_anchors);
  JointCovariance covariance(site, parameters, learning(config.model));
  return {.parameters = parameters,
          .gate = Gate(config.gate),
          .watch = OdometryWatch(config.watch),
          .tuning = RangeTuning(config.tuning, white_sigma_m),
          .sensors = SensorGate(config.sensors),
          .gyro = Gyro(config.sensors),
          .odometry_tuning = OdometryTuning(config.odometry_tuning, config.odometry),
          .standstill = Standstill(config.standstill),
          .covariance = std::move(covariance)};
}

// The comparisons keep the noise that they were told: what their innovations show is their own error.
bool is_tuned(Model model) noexcept {
  return model == Model::kSchmidt || model == Model::kAnchorStates || model == Model::kJoint;
}

// The original model knows of no calibration but positions: its noise is the one that it is told.
double white_sigma_m(const model::Calibration& calibration, const Config& config) noexcept {
  if (!calibration.range_noise || config.model == Model::kOriginal) return config.range_sigma_m;
  return calibration.range_noise->white_sigma_m;
}

LinkDelays delays(const Config& config) noexcept {
  return {.range_s = config.range_delay_s,
          .range_sigma_s = config.range_delay_sigma_s,
          .odometry_sigma_s = config.odometry_delay_sigma_s};
}

}  // namespace

Filter::Filter(model::Surface surface, std::span<const model::Tag> tags,
               const model::Calibration& calibration, const Config& config)
    : surface_(std::move(surface)),
      site_(tags, on_another_drive(calibration, config), config.lever_arm_sigma_m),
      config_(config),
      now_(begin(site_, config, white_sigma_m(calibration, config))) {
  const model::Calibration here = on_another_drive(calibration, config);
  if (here.range_noise && here.range_noise->slow_sigma_m > 0.0) slow_time_s_ = here.range_noise->slow_time_s;
  if (here.range_delay_sigma_s > 0.0) {
    config_.range_delay_s = here.range_delay_s;
    config_.range_delay_sigma_s = here.range_delay_sigma_s;
  }
  now_.last_answer_s.fill(kNever);
  slots_.assign(static_cast<std::size_t>(site_.anchor_count()), -1);
  find_slots();
  if (site_.anchor_count() > now_.parameters.anchor_count()) {
    memories_.resize(static_cast<std::size_t>(site_.anchor_count()));
    exchanges_.resize(kMaxExchanges);
  }
}

std::size_t Filter::anchors() const noexcept {
  return static_cast<std::size_t>(site_.anchor_count());
}

std::size_t Filter::tags() const noexcept {
  return static_cast<std::size_t>(site_.tag_count());
}

void Filter::start(const Start& start) noexcept {
  now_.t_s = start.t_s;
  now_.core.setZero();
  now_.core.segment<3>(kX) << start.pose.x_m, start.pose.y_m, model::wrap_angle(start.pose.theta_rad);
  now_.core(kDelay) = config_.range_delay_s;

  // Without a row, nothing is known of the velocity but what a robot may do.
  if (!now_.has_row) now_.row = {.t_s = start.t_s};
  CoreVector variances;
  variances(kX) = square(start.position_sigma_m);
  variances(kY) = square(start.position_sigma_m);
  variances(kTheta) = square(start.heading_sigma_rad);
  variances(kScale) = square(config_.scale_sigma);
  variances(kYawBias) = square(config_.yaw_rate_bias_radps);
  variances(kDelay) = delays(config_).difference_variance_s2();
  const model::OdometryNoise noise = now_.odometry_tuning.noise();
  variances(kRowVx) = square(now_.has_row ? noise.sigma_vx_mps : config_.hold_walk_mps);
  variances(kRowVy) = square(now_.has_row ? noise.sigma_vy_mps : config_.hold_walk_mps);
  variances(kRowOmega) = square(now_.has_row ? noise.sigma_omega_radps : config_.hold_walk_radps);
  if (now_.gyro.holds()) {
    variances(kYawBias) = square(config_.sensors.gyro_bias_radps);
    variances(kRowOmega) = square(config_.sensors.gyro_sigma_radps);
  }
  now_.covariance.reset_core(variances);
  stand_on(std::clamp(start.pose.chart, 0, surface_.chart_count() - 1));
  now_.gate.reset(now_.t_s);
  now_.tuning.reset();
  now_.sensors.reset();
  now_.odometry_tuning.reset();
  now_.standstill.reset();
  now_.stands = false;
  now_.last_answer_s.fill(kNever);
  now_.started = true;
}

void Filter::stop() noexcept {
  now_.started = false;
  now_.has_row = false;
  now_.row = {};
  now_.gyro = Gyro(config_.sensors);
}

OdometryOutcome Filter::process(const model::OdometrySample& row) noexcept {
  const OdometryOutcome outcome = take(row);
  switch (outcome) {
    case OdometryOutcome::kUsed:
      ++now_.counters.odometry_used;
      break;
    case OdometryOutcome::kUsedLate:
      ++now_.counters.odometry_used_late;
      break;
    case OdometryOutcome::kStored:
      ++now_.counters.odometry_stored;
      break;
    case OdometryOutcome::kOutOfOrder:
      ++now_.counters.odometry_out_of_order;
      break;
    case OdometryOutcome::kBadValue:
      ++now_.counters.odometry_bad_value;
      break;
  }
  return outcome;
}

RangeResult Filter::process(const model::RangeSample& range) noexcept {
  RangeResult result = take(range);
  switch (result.outcome) {
    case RangeOutcome::kUsed:
      ++now_.counters.ranges_used;
      break;
    case RangeOutcome::kGated:
      ++now_.counters.ranges_gated;
      break;
    case RangeOutcome::kUnknownTag:
      ++now_.counters.ranges_unknown_tag;
      break;
    case RangeOutcome::kUnknownAnchor:
      ++now_.counters.ranges_unknown_anchor;
      break;
    case RangeOutcome::kBadValue:
      ++now_.counters.ranges_bad_value;
      break;
    case RangeOutcome::kOutOfOrder:
      ++now_.counters.ranges_out_of_order;
      break;
    case RangeOutcome::kNotStarted:
      ++now_.counters.ranges_not_started;
      break;
    case RangeOutcome::kNotActive:
      ++now_.counters.ranges_not_active;
      break;
    case RangeOutcome::kNotModelled:
      ++now_.counters.ranges_not_modelled;
      break;
  }
  return result;
}

OdometryOutcome Filter::take(const model::OdometrySample& row) noexcept {
  if (!model::is_finite(row)) return OdometryOutcome::kBadValue;
  if (now_.has_row && !(row.t_s > now_.row.t_s)) return OdometryOutcome::kOutOfOrder;
  if (!now_.started) {
    now_.row = row;
    now_.has_row = true;
    return OdometryOutcome::kStored;
  }
  const bool late = row.t_s < now_.t_s;
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
  const int tag = site_.tag_slot(range.tag_id);
  if (tag < 0) return {.outcome = RangeOutcome::kUnknownTag};
  const int anchor = site_.anchor_index(range.anchor_id);
  if (anchor < 0 || !site_.knows_pair(anchor, tag)) return {.outcome = RangeOutcome::kUnknownAnchor};
  if (!now_.started) return {.outcome = RangeOutcome::kNotStarted};
  if (range.t_s < now_.t_s) return {.outcome = RangeOutcome::kOutOfOrder};
  int slot = slot_of(anchor);
  const bool is_active = slot >= 0;
  if (!is_active) slot = free_slot(range.t_s);
  if (slot < 0) return {.outcome = RangeOutcome::kNotActive};
  advance_to(range.t_s);
  if (!is_active) exchange(slot, anchor);
  now_.last_answer_s[static_cast<std::size_t>(slot)] = now_.t_s;

  const bool whole = is_tuned(config_.model);
  const PairParameters parameters = now_.parameters.pair(site_, slot, tag);
  const PairPlace pair{.slot = slot, .tag = tag, .anchor = &site_.anchor(anchor)};
  const RangeMeasurement measurement =
      config_.model == Model::kOriginal
          ? measure_distance(surface_, now_.core, now_.row, parameters, now_.chart)
          : measure_range(surface_, now_.core, now_.row, parameters, now_.chart);
  Projected projected;
  if (whole) {
    now_.covariance.project(measurement, pair, projected);
  } else {
    projected.variance = now_.covariance.project_core(measurement.d_core, projected.core);
    if (config_.model == Model::kInflated)
      projected.variance += now_.covariance.parameter_variance(measurement, pair);
  }

  RangeResult result;
  result.innovation_m = range.range_m - measurement.range_m;
  result.innovation_variance_m2 = projected.variance + square(now_.tuning.white_sigma_m());
  result.nis = square(result.innovation_m) / result.innovation_variance_m2;
  result.weight = now_.gate.weigh(slot, tag, now_.t_s, result.innovation_m, result.innovation_variance_m2);
  result.blocked = now_.gate.blocked(slot, tag);
  now_.counters.doubts = now_.gate.doubts_begun();
  const double slow_before = now_.tuning.slow_scale();
  if (whole) now_.tuning.observe(slot, tag, now_.t_s, result.innovation_m, result.innovation_variance_m2);
  const double slow_change = now_.tuning.slow_scale() / slow_before;
  if (!(result.weight > 0.0)) {
    if (slow_time_s_ > 0.0 && slow_change != 1.0) now_.covariance.scale_slow_errors(slow_change);
    result.outcome = RangeOutcome::kGated;
    return result;
  }

  // A weight below one stands for that much more noise: S / weight in place of S.
  const double variance =
      result.innovation_variance_m2 / result.weight + now_.gate.regained_variance_m2(slot, tag);
  result.pull = projected.core.head<3>() * (result.innovation_m / variance);
  now_.core += projected.core * (result.innovation_m / variance);
  now_.core(kTheta) = model::wrap_angle(now_.core(kTheta));
  if (!whole) {
    now_.covariance.correct_core(projected.core, variance);
  } else {
    now_.covariance.correct(measurement.d_core, projected, variance, result.innovation_m,
                            now_.parameters.values());
  }
  if (slow_time_s_ > 0.0 && slow_change != 1.0) now_.covariance.scale_slow_errors(slow_change);
  follow_chart();
  result.outcome = RangeOutcome::kUsed;
  return result;
}

SensorResult Filter::process(const model::YawRateSample& sample) noexcept {
  if (!std::isfinite(sample.t_s + sample.omega_radps))
    return count(Sensor::kYawRate, {.outcome = SensorOutcome::kBadValue});
  SensorResult result{.outcome = await(sample.t_s)};
  if (result.outcome != SensorOutcome::kUsed) return count(Sensor::kYawRate, result);
  if (!now_.gyro.follows(sample, now_.row.omega_radps))
    return count(Sensor::kYawRate, {.outcome = SensorOutcome::kJumped});
  if (!now_.gyro.holds()) renew(kYawBias, square(config_.sensors.gyro_bias_radps));
  now_.gyro.use(sample);
  now_.row.omega_radps = sample.omega_radps;
  renew(kRowOmega, square(config_.sensors.gyro_sigma_radps));
  result.weight = 1.0;
  return count(Sensor::kYawRate, result);
}

void Filter::renew(CoreIndex index, double variance) noexcept {
  now_.core(index) = 0.0;
  now_.covariance.renew(index, variance);
}

SensorResult Filter::process(const model::PositionSample& sample) noexcept {
  if (!std::isfinite(sample.t_s + sample.x_m + sample.y_m) || !model::is_covariance(sample.covariance_m2)) {
    return count(Sensor::kPosition, {.outcome = SensorOutcome::kBadValue});
  }
  const SensorOutcome outcome = await(sample.t_s);
  if (outcome != SensorOutcome::kUsed) return count(Sensor::kPosition, {.outcome = outcome});
  const PresentPose now = present_pose(surface_, now_.core, now_.row, delays(config_), now_.chart);
  return count(Sensor::kPosition,
               correct(Sensor::kPosition, measure_position(surface_, now, config_.sensors, sample)));
}

SensorResult Filter::process(const model::PoseSample& sample) noexcept {
  if (!tells_pose(sample)) return count(Sensor::kPose, {.outcome = SensorOutcome::kBadValue});
  const SensorOutcome outcome = await(sample.t_s);
  if (outcome != SensorOutcome::kUsed) return count(Sensor::kPose, {.outcome = outcome});
  const PresentPose now = present_pose(surface_, now_.core, now_.row, delays(config_), now_.chart);
  return count(Sensor::kPose, correct(Sensor::kPose, measure_pose(surface_, now, sample)));
}

SensorResult Filter::process(const model::ZeroVelocitySample& sample) noexcept {
  if (!std::isfinite(sample.t_s)) return count(Sensor::kZeroVelocity, {.outcome = SensorOutcome::kBadValue});
  const SensorOutcome outcome = await(sample.t_s);
  if (outcome != SensorOutcome::kUsed) return count(Sensor::kZeroVelocity, {.outcome = outcome});
  // The row as it came shows the yaw rate's bias, now that it is told that the robot stands.
  if (now_.stands) {
    now_.stands = false;
    if (now_.gyro.holds()) now_.told_row.omega_radps = now_.row.omega_radps;
    now_.row = now_.told_row;
    renew_row(now_.odometry_tuning.noise(), {});
  }
  return count(Sensor::kZeroVelocity,
               correct(Sensor::kZeroVelocity, measure_zero_velocity(now_.core, now_.row, config_.sensors)));
}

SensorOutcome Filter::await(double t_s) noexcept {
  if (!now_.started) return SensorOutcome::kNotStarted;
  if (t_s < now_.t_s) return SensorOutcome::kOutOfOrder;
  advance_to(t_s);
  return SensorOutcome::kUsed;
}

template <int kSize>
SensorResult Filter::correct(Sensor sensor, const CoreMeasurement<kSize>& measurement) noexcept {
  using Square = Eigen::Matrix<double, kSize, kSize>;
  const auto& d_core = measurement.d_core;
  const Square by_core = d_core.lazyProduct(now_.covariance.core().lazyProduct(d_core.transpose()).eval());
  const Square variance = by_core + measurement.noise;
  const Eigen::LLT<Square> root(variance);
  if (root.info() != Eigen::Success) return {.outcome = SensorOutcome::kBadValue};
  SensorResult result;
  result.nis = root.matrixL().solve(measurement.innovation).squaredNorm();
  result.weight = now_.sensors.weigh(sensor, now_.t_s, result.nis / kSize);
  if (!(result.weight > 0.0)) {
    result.outcome = SensorOutcome::kGated;
    return result;
  }

  // A weight below one stands for that much more noise: S / weight in place of S. In units of its root the
  // components are independent, and taken one after the other.
  const Eigen::LLT<Square> noise(variance / result.weight - by_core);
  if (noise.info() != Eigen::Success) return {.outcome = SensorOutcome::kBadValue};
  Eigen::Matrix<double, kSize, kCoreSize> rows = d_core;
  noise.matrixL().solveInPlace(rows);
  Eigen::Matrix<double, kSize, 1> innovation = measurement.innovation;
  noise.matrixL().solveInPlace(innovation);
  CoreVector change = CoreVector::Zero();
  for (int i = 0; i < kSize; ++i) {
    const CoreRow row = rows.row(i);
    Projected projected;
    now_.covariance.project(row, projected);
    const double left = innovation(i) - row.dot(change);
    change += projected.core * (left / (projected.variance + 1.0));
    now_.covariance.correct(row, projected, projected.variance + 1.0, left, now_.parameters.values());
  }
  now_.core += change;
  now_.core(kTheta) = model::wrap_angle(now_.core(kTheta));
  result.outcome = SensorOutcome::kUsed;
  return result;
}

SensorResult Filter::count(Sensor sensor, SensorResult result) noexcept {
  SensorCounters& counters = now_.counters.sensors[static_cast<std::size_t>(sensor)];
  switch (result.outcome) {
    case SensorOutcome::kUsed:
      ++counters.used;
      break;
    case SensorOutcome::kGated:
      ++counters.gated;
      break;
    case SensorOutcome::kJumped:
      ++counters.jumped;
      break;
    case SensorOutcome::kBadValue:
      ++counters.bad_value;
      break;
    case SensorOutcome::kOutOfOrder:
      ++counters.out_of_order;
      break;
    case SensorOutcome::kNotStarted:
      ++counters.not_started;
      break;
  }
  return result;
}

bool Filter::advance_to(double t_s) noexcept {
  if (!now_.started || !std::isfinite(t_s) || !(t_s > now_.t_s)) return false;
  const double dt_s = t_s - now_.t_s;
  const double steps = std::clamp(std::ceil(dt_s / kMaxStep_s), 1.0, kMaxSteps);
  for (int i = 0; i < static_cast<int>(steps); ++i) step(dt_s / steps);
  now_.t_s = t_s;
  return true;
}

void Filter::hold(const model::OdometrySample& row) noexcept {
  if (now_.gyro.holds() && now_.gyro.is_silent(row.t_s)) {
    now_.gyro.give_up();
    renew(kYawBias, square(config_.yaw_rate_bias_radps));
  }
  model::OdometrySample held = row;
  if (now_.gyro.holds()) held.omega_radps = now_.gyro.radps();
  model::OdometryNoise noise = now_.odometry_tuning.noise();
  OdometryDoubt doubt;
  if (now_.has_row) doubt = now_.watch.judge(now_.row, held, noise);
  now_.stands = false;
  if (is_tuned(config_.model)) {
    const bool wheels_stand = now_.standstill.observe(row, noise);
    // Wheels that stand tell nothing of their noise in motion.
    if (wheels_stand) {
      now_.odometry_tuning.reset();
    } else {
      now_.odometry_tuning.observe(row);
    }
    now_.stands = wheels_stand && !now_.gate.doubts(now_.t_s);
  }
  now_.told_row = held;
  if (now_.stands) {
    noise = now_.standstill.noise();
    held.vx_mps = 0.0;
    held.vy_mps = 0.0;
    if (!now_.gyro.holds()) held.omega_radps = now_.core(kYawBias);
  }
  now_.row = held;
  now_.has_row = true;
  // Wheels that slip turn the robot no more.
  if (now_.gyro.holds()) doubt.heading_rad2 = 0.0;
  renew_row(noise, doubt);
  if (doubt.position_m2 > 0.0) {
    now_.covariance.grow(kX, doubt.position_m2);
    now_.covariance.grow(kY, doubt.position_m2);
  }
  if (doubt.heading_rad2 > 0.0) now_.covariance.grow(kTheta, doubt.heading_rad2);
}

void Filter::renew_row(const model::OdometryNoise& noise, const OdometryDoubt& doubt) noexcept {
  const double variance_vx = square(noise.sigma_vx_mps) + doubt.velocity_m2ps2;
  const double variance_vy = square(noise.sigma_vy_mps) + doubt.velocity_m2ps2;
  if (now_.gyro.holds()) {
    renew(kRowVx, variance_vx);
    renew(kRowVy, variance_vy);
  } else {
    now_.core.segment<3>(kRowVx).setZero();
    now_.covariance.renew_row(
        {variance_vx, variance_vy, square(noise.sigma_omega_radps) + doubt.turn_rad2ps2});
  }
}

void Filter::step(double dt_s) noexcept {
  Motion motion = move(surface_, now_.core, now_.row, dt_s, now_.chart);
  // Of one that stands, the heading does not depend on what a gyro is off by.
  if (now_.stands && !now_.gyro.holds()) motion.d_core.col(kYawBias).setZero();
  const model::SurfaceMismatch& mismatch = surface_.mismatch(now_.chart);
  const double way_m = mismatch.is_any() ? (motion.pose.head<2>() - now_.core.head<2>()).norm() : 0.0;
  now_.core.segment<3>(kX) = motion.pose;
  now_.core(kTheta) = model::wrap_angle(now_.core(kTheta));
  now_.covariance.propagate(motion.d_core);
  now_.t_s += dt_s;
  if (slow_time_s_ > 0.0) now_.covariance.fade_slow_errors(std::exp(-dt_s / slow_time_s_));
  if (way_m > 0.0) now_.covariance.fade_ground(std::exp(-way_m / mismatch.length_m));
  follow_chart();

  now_.covariance.grow(kScale, square(config_.scale_walk) * dt_s);
  now_.covariance.grow(kYawBias, square(config_.yaw_rate_bias_walk) * dt_s);
  // A row older than it may be tells less and less of the velocity.
  const double overdue_s = std::clamp(now_.t_s - now_.row.t_s - config_.max_hold_s, 0.0, dt_s);
  if (overdue_s > 0.0) {
    now_.covariance.grow(kRowVx, square(config_.hold_walk_mps) * overdue_s);
    now_.covariance.grow(kRowVy, square(config_.hold_walk_mps) * overdue_s);
    if (!now_.gyro.holds() || now_.gyro.is_silent(now_.t_s)) {
      now_.covariance.grow(kRowOmega, square(config_.hold_walk_radps) * overdue_s);
    }
  }
  if (now_.gate.doubts(now_.t_s)) {
    const CoreMatrix& core = now_.covariance.core();
    if (core(kX, kX) + core(kY, kY) < square(kMaxDoubt_m)) {
      now_.covariance.grow(kX, square(config_.gate.doubt_position_m) * dt_s);
      now_.covariance.grow(kY, square(config_.gate.doubt_position_m) * dt_s);
    }
    if (core(kTheta, kTheta) < square(kMaxDoubt_rad)) {
      now_.covariance.grow(kTheta, square(config_.gate.doubt_heading_rad) * dt_s);
    }
  }
}

void Filter::stand_on(int chart) noexcept {
  now_.chart = chart;
  const model::SurfaceMismatch& mismatch = surface_.mismatch(chart);
  now_.covariance.renew_ground(
      {square(mismatch.sigma_m), square(mismatch.slope_sigma), square(mismatch.slope_sigma)});
}

void Filter::follow_chart() noexcept {
  if (surface_.chart_count() == 1) return;
  const int chart = surface_.follow(now_.chart, now_.core(kX), now_.core(kY));
  if (chart != now_.chart) stand_on(chart);
}

int Filter::free_slot(double t_s) const noexcept {
  int longest = 0;
  for (int slot = 1; slot < now_.parameters.anchor_count(); ++slot) {
    if (now_.last_answer_s[static_cast<std::size_t>(slot)] <
        now_.last_answer_s[static_cast<std::size_t>(longest)]) {
      longest = slot;
    }
  }
  return t_s - now_.last_answer_s[static_cast<std::size_t>(longest)] >= config_.silent_s ? longest : -1;
}

void Filter::exchange(int slot, int anchor) noexcept {
  const int leaving = now_.parameters.anchor_in(slot);
  const std::uint64_t number = now_.exchanges++;
  Exchange& record = at(number);
  record.left = leaving;
  AnchorMemory& left = memories_[static_cast<std::size_t>(leaving)];
  record.before = left;
  now_.covariance.leave(now_.parameters, slot, left);
  left.left = number;
  left.t_s = now_.t_s;
  record.absence = now_.covariance.absence();
  now_.covariance.begin_absence();

  AnchorMemory back = memories_[static_cast<std::size_t>(anchor)];
  if (back.was_active && back.cross.size() > 0) {
    // Longer ago than is known of, it is related to nothing.
    if (number - back.left >= kMaxExchanges) back.cross.setZero();
    for (std::uint64_t i = back.left + 1; i <= number && !back.cross.isZero(0.0); ++i) {
      back.cross = back.cross.lazyProduct(at(i).absence).eval();
    }
  }
  const double faded = slow_time_s_ > 0.0 ? std::exp(-(now_.t_s - back.t_s) / slow_time_s_) : 1.0;
  const AnchorVector& values =
      back.was_active && back.values.size() > 0 ? back.values : site_.anchor(anchor).values;
  now_.parameters.exchange(slot, anchor, values);
  now_.covariance.enter(site_.anchor(anchor), slot, back, faded, now_.parameters);
  now_.gate.renew(slot, now_.t_s);
  slots_[static_cast<std::size_t>(leaving)] = -1;
  slots_[static_cast<std::size_t>(anchor)] = slot;
  ++now_.counters.anchor_exchanges;
}

void Filter::restore(const Snapshot& snapshot) noexcept {
  while (now_.exchanges > snapshot.exchanges) {
    const Exchange& last = at(--now_.exchanges);
    memories_[static_cast<std::size_t>(last.left)] = last.before;
  }
  for (int slot = 0; slot < now_.parameters.anchor_count(); ++slot) {
    slots_[static_cast<std::size_t>(now_.parameters.anchor_in(slot))] = -1;
  }
  now_ = snapshot;
  find_slots();
}

void Filter::find_slots() noexcept {
  for (int slot = 0; slot < now_.parameters.anchor_count(); ++slot) {
    slots_[static_cast<std::size_t>(now_.parameters.anchor_in(slot))] = slot;
  }
}

Estimate Filter::estimate() const noexcept {
  Estimate out{.t_s = now_.t_s,
               .pose = {now_.core(kX), now_.core(kY), now_.core(kTheta), now_.chart},
               .covariance = now_.covariance.core().topLeftCorner<3, 3>(),
               .scale_error = now_.core(kScale),
               .yaw_rate_bias_radps = now_.core(kYawBias),
               .range_delay_s = now_.core(kDelay),
               .ground_variances = now_.covariance.ground_variances()};
  const Eigen::Matrix<double, kGroundSize, kCoreSize> ground_cross = now_.covariance.ground_cross();
  out.ground_cross = ground_cross.leftCols<3>();
  const LinkDelays prior = delays(config_);
  if (!(prior.odometry_share() > 0.0)) return out;

  // The core tells of where the robot was when its odometry was true.
  out.odometry_delay_s = prior.odometry_s(now_.core(kDelay));
  out.range_delay_s += out.odometry_delay_s;
  const PresentPose now = present_pose(surface_, now_.core, now_.row, prior, now_.chart);
  out.pose = {now.pose.x(), now.pose.y(), model::wrap_angle(now.pose.z()), now_.chart};
  out.ground_cross = ground_cross.lazyProduct(now.d_core.transpose());
  const Eigen::Matrix3d moved = now.d_core * now_.covariance.core() * now.d_core.transpose();
  out.covariance = 0.5 * (moved + moved.transpose()) + now.noise;
  return out;
}

Eigen::Matrix<double, 6, 6> Estimate::covariance_with_ground() const noexcept {
  Eigen::Matrix<double, 6, 6> out;
  out << covariance, ground_cross.transpose(), ground_cross, Eigen::Matrix3d(ground_variances.asDiagonal());
  return out;
}

}  // namespace groma::filter
