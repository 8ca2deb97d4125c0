// The filter's configuration: measurement model, noises and bounds.
#pragma once

#include <array>
#include <optional>
#include <string_view>

#include <Eigen/Core>

#include "host/filter/state.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// The measurement models: those that the source paper compares, and this project's.
enum class Model {
  kOdometry,      // no ranges: dead reckoning
  kOriginal,      // z = d, equation (4), R = sigma^2
  kInflated,      // bias-aware (12) with R + J Pc J^T (18), no cross-covariances (the source paper's)
  kSchmidt,       // bias-aware, parameters are consider states, cross-covariances with the core kept
  kAnchorStates,  // anchor positions estimated too, the other parameters considered
  kJoint,         // every parameter estimated in one covariance
};

inline constexpr std::array kModels{Model::kOdometry, Model::kOriginal,     Model::kInflated,
                                    Model::kSchmidt,  Model::kAnchorStates, Model::kJoint};

// Whether the model keeps the cross-covariance of core and parameters. The other models serve as comparisons.
// Their noise stays as configured, because their innovations mostly show their own modelling error.
[[nodiscard]] constexpr bool keeps_cross(Model model) noexcept {
  return model == Model::kSchmidt || model == Model::kAnchorStates || model == Model::kJoint;
}

// "odometry", "original", "inflated", "schmidt", "anchor-states", "joint".
[[nodiscard]] std::string_view model_name(Model model) noexcept;
[[nodiscard]] std::optional<Model> model_from_name(std::string_view name) noexcept;

// How ranges are weighted: see gate.hpp. "By hand": the value was chosen by hand, without a record of runs
// with other values; the tests that are named hold with it.
struct GateConfig {
  // By hand. Of simulated ranges 17 % are NLOS (scripts/demo), of well-received recorded ones 2 to 5 %.
  double nlos_prior = 0.1;  // prior probability that a pair is NLOS
  // By hand: as likely LOS as NLOS. Upper bound of a pair's NLOS probability: no pair is given up for good.
  double nlos_max = 0.5;
  // By hand: time constant over which a pair's history is forgotten. Gate.RemembersAnNlosPairForAWhile.
  double sticky_s = 2.0;
  double excess_m = 0.5;  // mean excess of NLOS ranges. By hand; a row of simulated racks adds 0.35 m
  // For a pair that misses all polls: the share of its ranges that is NLOS, and the additional share that is
  // garbage. From half of the polls missed on, all of the NLOS excess has the larger mean kRegained_m. Both
  // by hand, in one step of six recorded campus runs (docs/explanation/filter.md: 71 % off at a reception of
  // 0.05) and of Reception.AnchorsThatComeBackAfterNlosAreConsistent in simulation: less than 0.3 of the NEES
  // with zeros.
  double regained_share = 0.7;
  double regained_garbage = 0.14;
  double garbage_share = 0.01;    // of all ranges. By hand
  double garbage_width_m = 50.0;  // their errors are uniform over this width. By hand

  // LOS/NLOS hint by the received powers, estimated on site: see PowerHint. All by hand. Simulated Powers.*
  // (docs/measurements.md): 0.63 times the error without powers; 0.90 times if powers carry no information.
  double hint_most = 10.0;         // bound of one range's likelihood ratio; 1: powers are not used
  double hint_s = 0.2;             // ranges of a pair that are closer are correlated and count as one
  double hint_memory_s = 600.0;    // time constant of the counts
  double hint_prior_count = 30.0;  // weight of the prior, in ranges

  double window_s = 1.0;  // window of the divergence test: see gate.cpp. By hand
};

// Sensors other than odometry and ranges.
struct SensorConfig {
  SensorConfig() = default;
  // Takes the given values; the others keep the defaults below.
  explicit SensorConfig(const model::SensorDescription& description);

  // Sigmas by hand; those of the gyro are used if the description of the robot has none.
  double gyro_sigma_radps = 0.005;                                 // white, constant until the next sample
  double gyro_bias_radps = 0.01;                                   // sigma of its constant bias
  Eigen::Vector3d position_lever_arm_m = Eigen::Vector3d::Zero();  // of the GNSS antenna, in base_link
  double standing_sigma_mps = 0.005;                               // of the zero-velocity update
  double standing_sigma_radps = 0.002;
};

struct Config {
  Model model = Model::kSchmidt;

  // White, constant until the next sample. By hand (its defaults are model::OdometryNoise's). Three times or
  // a third costs little: OdometryTuning.ASigmaThatIsWrongByThreeCostsLittleOverManyDrives (simulated).
  model::OdometryNoise odometry;
  // By hand. Simulated drives draw the scale with 0.01, the bias with 0.002 or, in filter_campaign, 0.001.
  double scale_sigma = 0.01;           // of the constant odometry scale error
  double yaw_rate_bias_radps = 0.002;  // sigma of the constant yaw-rate bias
  // By hand; Implausible.MotionMissedMeanwhileIsInTheCovariance (braking by 0.5 m/s in 0.4 s is in 4 sigmas).
  double max_hold_s = 0.5;       // hold time of a sample; then its velocity is a random walk:
  double hold_walk_mps = 1.0;    // m/s per sqrt(s)
  double hold_walk_radps = 0.5;  // rad/s per sqrt(s)

  // White; used if the calibration has no range noise. By hand, as in model::RangePriors. Three times or a
  // third of it costs little: RangeTuning.ASigmaThatIsWrongByThreeCostsLittleOverManyDrives (simulated).
  double range_sigma_m = 0.1;
  // Factor on the sigma of the calibration's slow range bias, for other drives. On its own drive the
  // calibration's beta, gamma and poses absorbed part of that bias. By hand: no derivation of the value is on
  // record; with 1.7 the NEES of recorded runs that chose nothing grows by 6 % (schmidt) and 20 % (joint).
  double range_bias_growth = 2.5;
  double lever_arm_sigma_m = 0.01;  // by hand; filter_campaign draws lever arms with it
  // Delay of range timestamps, used if the calibration observed none; sigma 0: the delay is known exactly.
  double range_delay_s = 0.0;
  double range_delay_sigma_s = 0.0;
  double odometry_delay_sigma_s = 0.0;  // of the odometry's delay, whose mean is 0; 0: no delay
  // Number of active anchors, at most kMaxAnchors.
  int active_anchors = kMaxAnchors;
  double silent_s = 1.0;  // an anchor silent for this long may be replaced. By hand; ActiveSet.*

  bool tunes_noise = true;  // of ranges and odometry: see self_tuning.hpp
  // What wheels can push: see OdometryWatch. Physics: 0.8 g, a friction coefficient of 0.8.
  double max_acceleration_mps2 = 8.0;
  // ln of the prior odds against a slip: see SlipWatch. By hand: 6 in a million. SlipWatch.NoiseIsNoSlip
  // (none in an hour); Slip.IsFoundAndCostsLittle (without detection 1.7 to 41 times the mean error).
  double slip_odds = 12.0;
  GateConfig gate;
  SensorConfig sensors;
};

// The configuration without the mechanisms that scripts/ablation switches off.
[[nodiscard]] Config ablated(Config config) noexcept;

// Sigma of the change of the range delay from drive to drive. By hand (0.003 before; no reason on record).
inline constexpr double kRangeDelayChange_s = 0.005;
// Default sigmas of the delays of a robot's links. By hand; six recorded runs have odometry delays of 20 to
// 50 ms. In simulation LateLinks.DelaysOfOdometryAndRangesAreEstimatedSeparately sets its own.
inline constexpr double kRangeDelaySigma_s = 0.01;
inline constexpr double kOdometryDelaySigma_s = 0.015;
// Nobody has measured the delays of ranges and odometry.
inline void set_unknown_delays(Config& config) noexcept {
  config.range_delay_sigma_s = kRangeDelaySigma_s;
  config.odometry_delay_sigma_s = kOdometryDelaySigma_s;
}

}  // namespace groma::filter
