#include "host/filter/filter.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <type_traits>
#include <utility>

#include <Eigen/Cholesky>

#include "host/filter/propagation.hpp"
#include "host/filter/range_measurement.hpp"
#include "host/model/ablation.hpp"
#include "host/model/plausible.hpp"

namespace groma::filter {

namespace {

constexpr double kNoAnswerYet_s = -std::numeric_limits<double>::infinity();
using model::Mechanism;
using model::square;

// Adapts the calibration to another drive than the one it was estimated from.
model::Calibration on_another_drive(model::Calibration calibration, const Config& config) {
  if (model::is_ablated(Mechanism::kRangeBias) && calibration.range_noise) {
    model::RangeNoise& noise = *calibration.range_noise;
    noise.white_sigma_m = std::hypot(noise.white_sigma_m, noise.bias_sigma_m);
    noise.bias_sigma_m = 0.0;
  }
  if (model::is_ablated(Mechanism::kRangeDelay)) calibration.range_delay_sigma_s = 0.0;
  if (model::is_ablated(Mechanism::kOtherDrive)) return calibration;
  if (calibration.range_noise) {
    calibration.range_noise->bias_sigma_m *= config.range_bias_growth;
  }
  if (calibration.range_delay_sigma_s > 0.0) {
    calibration.range_delay_sigma_s = std::hypot(calibration.range_delay_sigma_s, kRangeDelayChange_s);
  }
  return calibration;
}

// The original model uses nothing of the calibration but positions, so its noise is as configured.
double white_sigma_m(const model::Calibration& calibration, const Config& config) noexcept {
  if (!calibration.range_noise || config.model == Model::kOriginal) return config.range_sigma_m;
  return calibration.range_noise->white_sigma_m;
}

Filter::Snapshot begin(const Site& site, const Config& config, double white_sigma_m) {
  const Parameters parameters(site, config.active_anchors);
  return {MotionState(config),
          parameters,
          Gate(config.gate),
          SlipWatch(config.slip_odds),
          RangeTuning(white_sigma_m),
          SensorGate(),
          JointCovariance(site, parameters, config.model)};
}

}  // namespace

Filter::Filter(model::Surface surface, std::span<const model::Tag> tags,
               const model::Calibration& calibration, const Config& config)
    : Filter(std::move(surface), tags, ablated(config), on_another_drive(calibration, config)) {}

Filter::Filter(model::Surface surface, std::span<const model::Tag> tags, const Config& config,
               const model::Calibration& here)
    : surface_(std::move(surface)),
      site_(tags, here, model::is_ablated(Mechanism::kLeverArm) ? 0.0 : config.lever_arm_sigma_m),
      config_(config),
      delays_{config.range_delay_s, config.range_delay_sigma_s, config.odometry_delay_sigma_s},
      now_(begin(site_, config, white_sigma_m(here, config))) {
  if (here.range_noise && here.range_noise->bias_sigma_m > 0.0)
    range_bias_length_m_ = here.range_noise->bias_length_m;
  if (here.range_delay_sigma_s > 0.0) {
    delays_.range_s = here.range_delay_s;
    delays_.range_sigma_s = here.range_delay_sigma_s;
  }
  now_.last_answer_s.fill(kNoAnswerYet_s);
  if (site_.anchor_count() > now_.parameters.anchor_count()) {
    memories_.resize(anchors());
    exchanges_.resize(kMaxExchanges);
  }
}

void Filter::start(const Start& start) noexcept {
  now_.t_s = start.t_s;
  now_.core.setZero();
  now_.core.segment<3>(kX) << start.pose.x_m, start.pose.y_m, model::wrap_angle(start.pose.theta_rad);
  now_.core(kDelay) = delays_.range_s;

  // Without an odometry sample the velocity is zero, with the sigmas of an overdue sample after 1 s.
  if (!now_.has_sample) now_.odometry = {.t_s = start.t_s};
  const model::OdometryNoise noise =
      now_.has_sample
          ? now_.odometry_tuning.noise()
          : model::OdometryNoise{config_.hold_walk_mps, config_.hold_walk_mps, config_.hold_walk_radps};
  CoreVector variances;
  variances << square(start.position_sigma_m), square(start.position_sigma_m),
      square(start.heading_sigma_rad), square(config_.scale_sigma), square(config_.yaw_rate_bias_radps),
      delays_.difference_variance_s2(), square(noise.sigma_vx_mps), square(noise.sigma_vy_mps),
      square(noise.sigma_omega_radps);
  if (now_.gyro.holds) {
    variances(kYawBias) = square(config_.sensors.gyro_bias_radps);
    variances(kOdometryOmega) = square(config_.sensors.gyro_sigma_radps);
  }
  now_.covariance.reset_core(variances.asDiagonal());
  now_.odometry_tuning.reset();
  begin_on_chart(std::clamp(start.pose.chart, 0, surface_.chart_count() - 1));
}

void Filter::resume(const Filter& other) noexcept {
  static_cast<MotionState&>(now_) = other.now_;
  now_.covariance.reset_core(other.now_.covariance.core());
  begin_on_chart(now_.chart);
}

void Filter::begin_on_chart(int chart) noexcept {
  motion().set_chart(chart);
  now_.gate.reset(now_.t_s);
  now_.slip_watch = SlipWatch(config_.slip_odds);
  now_.slip = {};
  now_.tuning.reset();
  now_.sensors = {};
  now_.last_answer_s.fill(kNoAnswerYet_s);
  now_.started = true;
}

void Filter::stop() noexcept {
  now_.started = false;
  now_.has_sample = false;
  now_.odometry = {};
  now_.hold_s = config_.max_hold_s;
  now_.odometry_gate = {};
  now_.gyro = {};
}

OdometryOutcome Filter::process(const model::OdometrySample& sample) noexcept {
  const OdometryOutcome outcome = take(sample);
  ++now_.counters.odometry[outcome];
  return outcome;
}

OdometryOutcome Filter::take(const model::OdometrySample& sample) noexcept {
  if (!model::is_finite(sample)) return OdometryOutcome::kBadValue;
  if (now_.has_sample && !(sample.t_s > now_.odometry.t_s)) return OdometryOutcome::kOutOfOrder;
  if (!now_.started) {
    if (!now_.odometry_gate.accepts(sample)) return OdometryOutcome::kImplausible;
    now_.odometry = sample;
    now_.has_sample = true;
    now_.hold_s = config_.max_hold_s;
    return OdometryOutcome::kStored;
  }
  const bool late = sample.t_s < now_.t_s;
  advance_to(sample.t_s);
  if (!motion().hold(sample)) return OdometryOutcome::kImplausible;
  return late ? OdometryOutcome::kUsedLate : OdometryOutcome::kUsed;
}

RangeResult Filter::process(const model::RangeSample& range) noexcept {
  PairPlace pair;
  RangeResult result{.outcome = admit(range, pair)};
  if (result.outcome == RangeOutcome::kUsed) result = correct(range, pair);
  ++now_.counters.ranges[result.outcome];
  return result;
}

RangeOutcome Filter::admit(const model::RangeSample& range, PairPlace& pair) noexcept {
  if (!is_usable(range)) return RangeOutcome::kBadValue;
  if (config_.model == Model::kOdometry) return RangeOutcome::kNotModelled;
  pair.tag = site_.tag_slot(range.tag_id);
  if (pair.tag < 0) return RangeOutcome::kUnknownTag;
  const int anchor = site_.anchor_index(range.anchor_id);
  if (anchor < 0 || !site_.knows_pair(anchor, pair.tag)) return RangeOutcome::kUnknownAnchor;
  if (!now_.started) return RangeOutcome::kNotStarted;
  if (range.t_s < now_.t_s) return RangeOutcome::kOutOfOrder;
  pair.anchor = &site_.anchor(anchor);
  pair.slot = now_.parameters.slot_of(anchor);
  const bool is_active = pair.slot >= 0;
  if (!is_active) pair.slot = free_slot(range.t_s);
  if (pair.slot < 0) return RangeOutcome::kNotActive;
  advance_to(range.t_s);
  if (!is_active) exchange(pair.slot, anchor);
  now_.last_answer_s[static_cast<std::size_t>(pair.slot)] = now_.t_s;
  return RangeOutcome::kUsed;
}

// Update by one range, with the equation numbers of the source paper. Propagation, (1)-(3), is advance_to().
RangeResult Filter::correct(const model::RangeSample& range, const PairPlace& pair) noexcept {
  const RangeMeasurement predicted = predict(pair);  // z_n of (12), (17); Jacobians H, J of (16)
  Projected projected;
  project(predicted, pair, projected);  // P Hᵀ and H P Hᵀ; inflated model: H P_cc Hᵀ + J P_c Jᵀ, see (18)
  RangeResult result = innovation(range.range_m, predicted, projected.variance);  // residual of (17), and S
  weigh(range, pair, result);
  watch_slip(pair, predicted, result);
  if (result.weight > 0.0) update(predicted, projected, result);  // x += K (z - z_n), Schmidt update
  tune(pair, result);
  if (result.weight > 0.0) motion().follow_chart();
  return result;
}

RangeMeasurement Filter::predict(const PairPlace& pair) const noexcept {
  PairParameters parameters = now_.parameters.pair(site_, pair.slot, pair.tag);
  if (config_.model == Model::kOriginal) parameters = without_biases(parameters);
  return measure_range(surface_, now_.core, now_.odometry, parameters, now_.chart);
}

void Filter::project(const RangeMeasurement& predicted, const PairPlace& pair, Projected& out) noexcept {
  if (keeps_cross(config_.model)) return now_.covariance.project(predicted, pair, out);
  out.variance = now_.covariance.project_core(predicted.d_core, out.core);
  if (config_.model == Model::kInflated) out.variance += now_.covariance.parameter_variance(predicted, pair);
}

RangeResult Filter::innovation(double range_m, const RangeMeasurement& predicted,
                               double variance_m2) const noexcept {
  const double white_m2 = square(now_.tuning.white_sigma_m());
  RangeResult result{.innovation_m = range_m - predicted.range_m,
                     .innovation_variance_m2 = variance_m2 + white_m2};
  result.nis = square(result.innovation_m) / result.innovation_variance_m2;
  if (config_.model == Model::kOriginal) return result;
  const Eigen::RowVector3d by_pose = predicted.d_core.head<3>();
  const double pose_variance_m2 =
      by_pose.lazyProduct(now_.covariance.core().topLeftCorner<3, 3>()).dot(by_pose);
  result.map_variance_m2 = std::max(result.innovation_variance_m2 - pose_variance_m2, white_m2);
  return result;
}

void Filter::update(const RangeMeasurement& predicted, Projected& projected, RangeResult& result) noexcept {
  // K = P Hᵀ / S. A weight below one inflates the noise: S / weight in place of S.
  const double variance = result.innovation_variance_m2 / result.weight + result.regained_variance_m2;
  const CoreVector change = projected.core * (result.innovation_m / variance);
  result.correction = change.head<3>();
  add(change);
  if (!keeps_cross(config_.model)) return now_.covariance.correct_core(projected.core, variance);
  now_.covariance.correct(predicted.d_core, projected, variance, result.innovation_m,
                          now_.parameters.values());
}

void Filter::weigh(const model::RangeSample& range, const PairPlace& pair, RangeResult& result) noexcept {
  const model::PowerClass powers = model::power_class(range);
  result.hint_ratio = now_.gate.hint().likelihood_ratio(powers);  // before the gate counts this range
  result.weight = now_.gate.weigh(pair.slot, pair.tag, now_.t_s, result.innovation_m,
                                  result.innovation_variance_m2, powers);
  result.regained_variance_m2 = now_.gate.regained_variance_m2(pair.slot, pair.tag);
  if (model::is_ablated(Mechanism::kGate)) result.weight = std::isfinite(result.innovation_m) ? 1.0 : 0.0;
  result.outcome = result.weight > 0.0 ? RangeOutcome::kUsed : RangeOutcome::kGated;
  result.nlos = now_.gate.nlos(pair.slot, pair.tag);
  now_.counters.divergences = now_.gate.divergences();
}

void Filter::watch_slip(const PairPlace& pair, const RangeMeasurement& predicted,
                        const RangeResult& result) noexcept {
  if (!keeps_cross(config_.model) || model::is_ablated(Mechanism::kSlip)) return;
  const auto displacement_m =
      now_.slip_watch.observe(pair.slot, pair.tag, now_.t_s, result.innovation_m,
                              result.innovation_variance_m2, result.weight, predicted.d_core.head<2>());
  if (!displacement_m) return;
  ++now_.counters.slips;
  now_.slip.begin(displacement_m->norm(), now_.t_s);
  now_.covariance.grow(kX, displacement_m->squaredNorm());
  now_.covariance.grow(kY, displacement_m->squaredNorm());
}

void Filter::tune(const PairPlace& pair, const RangeResult& result) noexcept {
  if (!keeps_cross(config_.model) || !config_.tunes_noise) return;
  now_.tuning.observe(pair.slot, pair.tag, now_.t_s, result.innovation_m, result.innovation_variance_m2);
}

void Filter::add(const CoreVector& change) noexcept {
  now_.core += change;
  now_.core(kTheta) = model::wrap_angle(now_.core(kTheta));
}

SensorResult Filter::process(const model::SensorSample& sample) noexcept {
  const SensorResult result = model::visit(sample, [this](const auto& of) { return take(of); });
  ++now_.counters.sensors[sample.index()][result.outcome];
  return result;
}

template <class Sample>
SensorResult Filter::take(const Sample& sample) noexcept {
  if (!is_usable(sample)) return {.outcome = SensorOutcome::kBadValue};
  if (!now_.started) return {};
  if (sample.t_s < now_.t_s) return {.outcome = SensorOutcome::kOutOfOrder};
  advance_to(sample.t_s);
  if constexpr (std::is_same_v<Sample, model::YawRateSample>) {
    if (!motion().turn(sample)) return {.outcome = SensorOutcome::kJumped};
    return {.outcome = SensorOutcome::kUsed, .weight = 1.0};
  } else {
    const PresentPose present = present_pose(surface_, now_.core, now_.odometry, delays_, now_.chart);
    return correct(model::kSensorOf<Sample>,
                   measure({surface_, config_.sensors, now_.core, now_.odometry, present}, sample));
  }
}

template <int kSize>
SensorResult Filter::correct(std::size_t sensor, const CoreMeasurement<kSize>& measurement) noexcept {
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

  // A weight below one inflates the noise: S / weight in place of S. Whitening by the noise's Cholesky factor
  // makes the components independent, so that they are processed one by one.
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
  add(change);
  result.outcome = SensorOutcome::kUsed;
  return result;
}

bool Filter::advance_to(double t_s) noexcept {
  if (!now_.started || !std::isfinite(t_s) || !(t_s > now_.t_s)) return false;
  motion().advance_to(t_s);
  return true;
}

int Filter::free_slot(double t_s) const noexcept {
  const auto first = now_.last_answer_s.begin();
  const auto longest = std::min_element(first, first + now_.parameters.anchor_count());
  return t_s - *longest >= config_.silent_s ? static_cast<int>(longest - first) : -1;
}

void Filter::exchange(int slot, int anchor) noexcept {
  const int leaving = now_.parameters.anchor_in(slot);
  const std::size_t number = now_.counters.anchor_exchanges++;
  Exchange& record = at(number);
  record.left = leaving;
  AnchorMemory& left = memories_[static_cast<std::size_t>(leaving)];
  record.before = left;
  now_.covariance.marginalize(now_.parameters, slot, left);
  left.left = number;
  left.way_m = now_.way_m;
  record.absence = now_.covariance.take_absence();

  AnchorMemory back = memories_[static_cast<std::size_t>(anchor)];
  if (back.was_active && back.cross.size() > 0) {
    // The ring of exchanges does not reach back that far: assume no correlation.
    if (number - back.left >= kMaxExchanges) back.cross.setZero();
    for (std::size_t i = back.left + 1; i <= number && !back.cross.isZero(0.0); ++i) {
      back.cross = back.cross.lazyProduct(at(i).absence).eval();
    }
  }
  const double faded =
      range_bias_length_m_ > 0.0 ? std::exp(-(now_.way_m - back.way_m) / range_bias_length_m_) : 1.0;
  const AnchorVector& values =
      back.was_active && back.values.size() > 0 ? back.values : site_.anchor(anchor).values;
  now_.parameters.exchange(slot, anchor, values);
  now_.covariance.augment(site_.anchor(anchor), slot, back, faded, now_.parameters);
  now_.gate.renew(slot, now_.t_s);
  now_.slip_watch.renew(slot);
  now_.tuning.renew(slot);
}

void Filter::restore(const Snapshot& snapshot) noexcept {
  for (std::size_t i = now_.counters.anchor_exchanges; i > snapshot.counters.anchor_exchanges; --i) {
    const Exchange& last = at(i - 1);
    memories_[static_cast<std::size_t>(last.left)] = last.before;
  }
  now_ = snapshot;
}

Estimate Filter::estimate() const noexcept {
  return estimate(prediction());
}

Filter::Prediction Filter::prediction() const noexcept {
  return {now_, CoreCovariance(now_.covariance.core(), now_.covariance.ground_cross(),
                               now_.covariance.ground_variances())};
}

void Filter::carry(Prediction& prediction, const MotionInput& input) const noexcept {
  MotionState& then = prediction.motion;
  const Gate* const gate = prediction.by_odometry_alone ? nullptr : &now_.gate;
  DeadReckoning<CoreCovariance> motion{surface_, config_, range_bias_length_m_,
                                       gate,     then,    prediction.covariance};
  if (const auto* sample = std::get_if<model::OdometrySample>(&input)) {
    if (!model::is_finite(*sample) || (then.has_sample && !(sample->t_s > then.odometry.t_s))) return;
    if (sample->t_s > then.t_s) motion.advance_to(sample->t_s);
    motion.hold(*sample);
  } else if (const auto* rate = std::get_if<model::YawRateSample>(&input)) {
    if (!is_usable(*rate) || rate->t_s < then.t_s) return;
    if (rate->t_s > then.t_s) motion.advance_to(rate->t_s);
    motion.turn(*rate);
  }
}

Estimate Filter::estimate(const Prediction& prediction) const noexcept {
  const MotionState& now = prediction.motion;
  const CoreCovariance& covariance = prediction.covariance;
  Estimate out{.t_s = now.t_s,
               .pose = {now.core(kX), now.core(kY), now.core(kTheta), now.chart},
               .covariance = covariance.core().topLeftCorner<3, 3>(),
               .scale_error = now.core(kScale),
               .yaw_rate_bias_radps = now.core(kYawBias),
               .range_delay_s = now.core(kDelay),
               .ground_variances = covariance.ground_variances()};
  const GroundRows& ground_cross = covariance.ground_cross();
  out.ground_cross = ground_cross.leftCols<3>();
  if (now.has_sample) {
    const BodyVelocity velocity = body_velocity(now.core, now.odometry);
    out.velocity = velocity.value;
    constexpr int kErrors = kCoreSize - kScale;  // the velocity does not depend on the pose
    const auto d_errors = velocity.d_core.rightCols<kErrors>();
    const Eigen::Matrix3d spread =
        d_errors.lazyProduct(covariance.core().bottomRightCorner<kErrors, kErrors>())
            .eval()
            .lazyProduct(d_errors.transpose());
    out.velocity_covariance = 0.5 * (spread + spread.transpose());
  }
  if (!(delays_.odometry_share() > 0.0)) return out;

  // The core's pose is delayed by the odometry delay: propagate it to the present.
  out.odometry_delay_s = delays_.odometry_s(now.core(kDelay));
  out.range_delay_s += out.odometry_delay_s;
  const PresentPose present = present_pose(surface_, now.core, now.odometry, delays_, now.chart);
  out.pose = {present.pose.x(), present.pose.y(), model::wrap_angle(present.pose.z()), now.chart};
  out.ground_cross = ground_cross.lazyProduct(present.d_core.transpose());
  const Eigen::Matrix3d moved = present.d_core * covariance.core() * present.d_core.transpose();
  out.covariance = 0.5 * (moved + moved.transpose()) + present.noise;
  return out;
}

Eigen::Matrix<double, 6, 6> Estimate::covariance_with_ground() const noexcept {
  Eigen::Matrix<double, 6, 6> out;
  out << covariance, ground_cross.transpose(), ground_cross, Eigen::Matrix3d(ground_variances.asDiagonal());
  return out;
}

}  // namespace groma::filter
