#include "host/filter/dead_reckoning.hpp"

#include <algorithm>
#include <cmath>

#include "host/filter/joint_covariance.hpp"
#include "host/filter/propagation.hpp"
#include "host/model/ablation.hpp"
#include "host/model/plausible.hpp"

namespace groma::filter {

namespace {

// "By hand" is explained in config.hpp.
//
// Bounds on one propagation: number of steps, and a time (more than a day) to which longer gaps are cut.
// Numerics: 400 steps of kMaxStep_s are 20 s; over a longer gap the velocity is unknown anyway.
constexpr double kMaxSteps = 400.0;
constexpr double kMaxJump_s = 1e5;
// A suspected divergence does not grow the pose's sigmas beyond these. That of the position is by hand. That
// of the heading is tuned on Implausible.OdometryOfAnySizeCostsNothing (simulated): from 1.5 rad a linearized
// update led to a position that was 0.19 m off at a sigma of 0.02 m (1 of 8 seeds).
constexpr double kMaxDivergence_m = 10.0;
constexpr double kMaxDivergence_rad = 0.5;
// Sigmas from which a pose is unknown: they grow no further, so that all numbers stay finite. Numerics:
// larger than any site or angle, and their products far from overflow.
constexpr double kUnknown_m = 1e6;
constexpr double kUnknown_rad = 1e3;
// Random walk of the pose while the gate suspects divergence: m and rad per sqrt(s). By hand (1.0 m with an
// earlier test of divergence); TrackerTest.RecoversFromAWrongStart.
constexpr double kDivergencePosition_m = 0.7;
constexpr double kDivergenceHeading_rad = 0.2;
// Two gyro samples may differ by this many sigmas of noise, plus this acceleration times their distance.
// Statistics: 4.2 sigmas of the difference (2e-5). The acceleration is by hand, twice that of OdometryWatch.
constexpr double kGyroNoiseSigmas = 6.0;
constexpr double kGyroAcceleration_radps2 = 20.0;
// After a longer gap of the gyro, odometry's yaw rate is used again. By hand; Gyro.*, Sensors.AGyro*.
constexpr double kGyroHold_s = 0.2;

using model::square;

// The yaw rate is wrong by the same share all along a curve: white noise that adds up to as much over this
// time. By hand: a quarter turn at 0.35 rad/s.
constexpr double kCurve_s = 4.5;
double curve_variance(const model::OdometryNoise& noise, double omega_radps, double interval_s) noexcept {
  if (noise.sigma_curve == 0.0 || !(interval_s > 0.0)) return 0.0;
  return square(noise.sigma_curve * omega_radps) * std::max(kCurve_s / interval_s, 1.0);
}

}  // namespace

bool Gyro::follows(const model::YawRateSample& sample, double odometry_radps,
                   double sigma_radps) const noexcept {
  if (!model::is_plausible(sample)) return false;
  const double gap_s = std::min(sample.t_s - used_s, kGyroHold_s);
  const double before_radps = gap_s < kGyroHold_s ? radps : odometry_radps;
  return std::abs(sample.omega_radps - before_radps) <=
         kGyroAcceleration_radps2 * gap_s + kGyroNoiseSigmas * sigma_radps;
}

bool Gyro::is_silent(double t_s) const noexcept {
  return t_s - used_s > kGyroHold_s;
}

PresentPose present_pose(const model::Surface& surface, const CoreVector& core,
                         const model::OdometrySample& sample, const LinkDelays& delays, int chart) noexcept {
  PresentPose out{.pose = core.segment<3>(kX),
                  .d_core = PoseRows::Identity(),
                  .noise = Eigen::Matrix3d::Zero(),
                  .chart = chart};
  const double share = delays.odometry_share();
  if (!(share > 0.0)) return out;
  const Motion motion = move(surface, core, sample, delays.odometry_s(core(kDelay)), chart);
  CoreVector now = core;
  now.segment<3>(kX) = motion.pose;
  const model::SurfacePose there =
      model::pose_on_surface(surface, {motion.pose.x(), motion.pose.y(), motion.pose.z(), chart});
  const Eigen::Vector3d rate = pose_rate(there.pose.rotation.topLeftCorner<2, 2>(), now, sample);
  out.pose = motion.pose;
  out.d_core = motion.d_core;
  out.d_core.col(kDelay) -= share * rate;
  out.noise = delays.odometry_variance_s2() * rate * rate.transpose();
  return out;
}

template <class Covariance>
void DeadReckoning<Covariance>::advance_to(double t_s) noexcept {
  const double dt_s = std::min(t_s - now.t_s, kMaxJump_s);
  const double steps = std::clamp(std::ceil(dt_s / kMaxStep_s), 1.0, kMaxSteps);
  for (int i = 0; i < static_cast<int>(steps); ++i) step(dt_s / steps);
  now.t_s = t_s;
}

template <class Covariance>
bool DeadReckoning<Covariance>::turn(const model::YawRateSample& sample) noexcept {
  if (!now.gyro.follows(sample, now.odometry.omega_radps, config.sensors.gyro_sigma_radps)) return false;
  if (!now.gyro.holds) renew(kYawBias, square(config.sensors.gyro_bias_radps));
  now.gyro = {.used_s = sample.t_s, .radps = sample.omega_radps, .holds = true};
  now.odometry.omega_radps = sample.omega_radps;
  renew(kOdometryOmega, square(config.sensors.gyro_sigma_radps));
  return true;
}

template <class Covariance>
void DeadReckoning<Covariance>::renew(CoreIndex index, double variance) noexcept {
  now.core(index) = 0.0;
  covariance.renew(index, variance);
}

template <class Covariance>
bool DeadReckoning<Covariance>::hold(const model::OdometrySample& sample) noexcept {
  if (!now.odometry_gate.accepts(sample)) {
    now.hold_s = std::min(now.hold_s, std::max(sample.t_s - now.odometry.t_s, 0.0));
    return false;
  }
  if (now.gyro.holds && now.gyro.is_silent(sample.t_s)) {
    now.gyro.holds = false;
    renew(kYawBias, square(config.yaw_rate_bias_radps));
  }
  model::OdometrySample held = sample;
  if (now.gyro.holds) held.omega_radps = now.gyro.radps;
  const model::OdometryNoise noise = now.odometry_tuning.noise();
  OdometryInflation inflation;
  if (now.has_sample && !model::is_ablated(model::Mechanism::kOdometryWatch))
    inflation = now.watch.judge(now.odometry, held, noise);
  inflation.turn_rad2ps2 += curve_variance(noise, held.omega_radps, sample.t_s - now.odometry.t_s);
  if (keeps_cross(config.model)) {
    if (config.tunes_noise) now.odometry_tuning.observe(sample);
    const OdometryInflation slip = now.slip.judge(std::max(sample.t_s - now.odometry.t_s, 0.0));
    inflation.velocity_m2ps2 += slip.velocity_m2ps2;
    inflation.turn_rad2ps2 += slip.turn_rad2ps2;
  }
  now.odometry = held;
  now.has_sample = true;
  now.hold_s = config.max_hold_s;
  // With a gyro, slipping wheels cause no heading error.
  if (now.gyro.holds) inflation.heading_rad2 = 0.0;
  const double variance_vx = square(noise.sigma_vx_mps) + inflation.velocity_m2ps2;
  const double variance_vy = square(noise.sigma_vy_mps) + inflation.velocity_m2ps2;
  if (now.gyro.holds) {
    renew(kOdometryVx, variance_vx);
    renew(kOdometryVy, variance_vy);
  } else {
    now.core.segment<3>(kOdometryVx).setZero();
    covariance.renew_odometry_errors(
        {variance_vx, variance_vy, square(noise.sigma_omega_radps) + inflation.turn_rad2ps2});
  }
  if (inflation.position_m2 > 0.0) grow_position(inflation.position_m2);
  // With a larger heading sigma, a linearized update would turn lever arms into position errors.
  const double most_rad2 = std::max(square(kMaxDivergence_rad) - covariance.core()(kTheta, kTheta), 0.0);
  if (inflation.heading_rad2 > 0.0) covariance.grow(kTheta, std::min(inflation.heading_rad2, most_rad2));
  return true;
}

template <class Covariance>
void DeadReckoning<Covariance>::grow_position(double variance_m2) noexcept {
  covariance.grow(kX, variance_m2);
  covariance.grow(kY, variance_m2);
}

template <class Covariance>
void DeadReckoning<Covariance>::step(double dt_s) noexcept {
  const Motion motion = move(surface, now.core, now.odometry, dt_s, now.chart);
  const model::SurfaceMismatch& mismatch = surface.mismatch(now.chart);
  const double way_m = (motion.pose.head<2>() - now.core.head<2>()).norm();
  now.core.segment<3>(kX) = motion.pose;
  now.core(kTheta) = model::wrap_angle(now.core(kTheta));
  covariance.propagate(motion.d_core);
  now.t_s += dt_s;
  now.way_m += way_m;
  if (way_m > 0.0 && bias_length_m > 0.0) covariance.fade_range_biases(std::exp(-way_m / bias_length_m));
  if (way_m > 0.0 && mismatch.is_any()) covariance.fade_ground(std::exp(-way_m / mismatch.length_m));
  follow_chart();

  // A sample held for longer than hold_s: its velocity error becomes a random walk.
  const double overdue_s = std::clamp(now.t_s - now.odometry.t_s - now.hold_s, 0.0, dt_s);
  if (overdue_s > 0.0) {
    covariance.grow(kOdometryVx, square(config.hold_walk_mps) * overdue_s);
    covariance.grow(kOdometryVy, square(config.hold_walk_mps) * overdue_s);
    if (!now.gyro.holds || now.gyro.is_silent(now.t_s)) {
      covariance.grow(kOdometryOmega, square(config.hold_walk_radps) * overdue_s);
    }
  }
  if (gate != nullptr && gate->suspects_divergence(now.t_s)) {
    const CoreMatrix& core = covariance.core();
    if (core(kX, kX) + core(kY, kY) < square(kMaxDivergence_m)) {
      grow_position(square(kDivergencePosition_m) * dt_s);
    }
    if (core(kTheta, kTheta) < square(kMaxDivergence_rad)) {
      covariance.grow(kTheta, square(kDivergenceHeading_rad) * dt_s);
    }
  }
  bound_pose();
}

template <class Covariance>
void DeadReckoning<Covariance>::bound_pose() noexcept {
  const CoreMatrix& core = covariance.core();
  const bool is_known = core(kX, kX) < square(kUnknown_m) && core(kY, kY) < square(kUnknown_m) &&
                        core(kTheta, kTheta) < square(kUnknown_rad);
  if (is_known) return;
  for (const CoreIndex index : {kX, kY}) {
    covariance.renew(index, square(kUnknown_m));
    if (!(std::abs(now.core(index)) <= model::kMaxCoordinate_m)) now.core(index) = 0.0;
  }
  covariance.renew(kTheta, square(kUnknown_rad));
  if (!std::isfinite(now.core(kTheta))) now.core(kTheta) = 0.0;
}

template <class Covariance>
void DeadReckoning<Covariance>::set_chart(int chart) noexcept {
  now.chart = chart;
  if (model::is_ablated(model::Mechanism::kGroundMismatch)) return;
  const model::SurfaceMismatch& mismatch = surface.mismatch(chart);
  covariance.renew_ground(
      {square(mismatch.sigma_m), square(mismatch.slope_sigma), square(mismatch.slope_sigma)});
}

template <class Covariance>
void DeadReckoning<Covariance>::follow_chart() noexcept {
  if (surface.chart_count() == 1) return;
  const int chart = surface.follow(now.chart, now.core(kX), now.core(kY));
  if (chart != now.chart) set_chart(chart);
}

template struct DeadReckoning<JointCovariance>;
template struct DeadReckoning<CoreCovariance>;

}  // namespace groma::filter
