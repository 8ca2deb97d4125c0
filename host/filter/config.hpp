// What the filter is told before it starts: the measurement model, noises and bounds.
#pragma once

#include <array>
#include <cstddef>
#include <optional>
#include <string_view>

#include <Eigen/Core>

#include "host/filter/state.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// How a range is turned into a correction; the comparisons of the source paper and ours.
enum class Model {
  kOdometry,      // no ranges: dead reckoning
  kOriginal,      // z = d, R = sigma^2
  kInflated,      // bias-aware, R + J Pc J^T, cross-covariances dropped (the source paper's)
  kSchmidt,       // bias-aware, parameters considered, cross-covariances with the core kept
  kAnchorStates,  // anchor positions estimated too, the other parameters considered
  kJoint,         // every parameter estimated in one covariance
};

inline constexpr std::array kModels{Model::kOdometry, Model::kOriginal,     Model::kInflated,
                                    Model::kSchmidt,  Model::kAnchorStates, Model::kJoint};

// "odometry", "original", "inflated", "schmidt", "anchor-states", "joint".
[[nodiscard]] std::string_view model_name(Model model) noexcept;
[[nodiscard]] std::optional<Model> model_from_name(std::string_view name) noexcept;

// How ranges are weighed: see gate.hpp.
struct GateConfig {
  double blocked_share = 0.1;  // of pairs, on the whole
  double blocked_most = 0.5;   // no pair is given up for good
  double sticky_s = 2.0;       // a pair's past is forgotten over this time
  double excess_m = 0.5;       // mean excess of blocked ranges
  double short_share = 0.2;    // of pairs that go wrong, those whose ranges are too short
  // A pair that misses more than the slack of its polls, over reception_s, is likely blocked. Where all are
  // missed: the share that is off, and garbage of all; half-way there the excess is all of a larger mean.
  double reception_s = 2.0;
  double reception_slack = 0.2;
  double regained_share = 0.7;
  double regained_m = 3.0;
  double regained_garbage = 0.14;
  double garbage_share = 0.01;  // of ranges
  double garbage_width_m = 50.0;

  // What the powers of ranges tell beside their innovations, as it is learnt: see sight_hint.hpp.
  double hint_most = 10.0;       // the likelihood ratio of one range at most; 1: they are not used
  double hint_s = 0.2;           // ranges of a pair that are closer come by the same walls: one to learn from
  double hint_memory_s = 600.0;  // what was learnt fades over this time
  double hint_prior_count = 30.0;  // of ranges, that what is believed beforehand is worth

  // The state is suspected to be wrong, not the ranges, where within window_s at least two anchors and as
  // many as agree refuse more than doubt_share of their ranges, by more than a way around an obstacle adds
  // (twice excess_m); and those that agree are fewer than a position and a check of it take.
  // Or where over patience_s all anchors together refuse as many.
  double doubt_share = 0.7;
  double window_s = 1.0;
  double patience_s = 5.0;
  double far_m = 1.0;
  int fixing_anchors = 3;
  // The covariance then grows by these rates (per sqrt(s)) until ranges are accepted again.
  double doubt_position_m = 0.7;
  double doubt_heading_rad = 0.2;
};

// Which odometry samples no robot can do, from one to the next: see odometry_gate.hpp. The bounds are twice
// the largest change from sample to sample of a robot in the recorded drives, 3.5 m/s (plaza1, 5 Hz) and 3.9
// rad/s (labyrinth, 8 Hz); simulated ones have 0.15 m/s and 0.07 rad/s. A rig that was held in a hand has 4.9
// m/s and 7.4 rad/s (inrol_env1, 50 Hz).
struct OdometryGateConfig {
  double jump_mps = 7.0;
  double jump_radps = 8.0;
  // Dropped samples that follow each other for so long, and are more than so many, are believed.
  double agreeing_s = 0.5;
  std::size_t agreeing_samples = 20;
};

// When a row of odometry is not believed: see odometry_watch.hpp.
struct OdometryWatchConfig {
  double max_acceleration_mps2 = 8.0;  // what wheels can push
  double max_turn_acceleration_radps2 = 10.0;
  double noise_sigmas = 6.0;  // by which two rows may differ for their noise
  double lasts_s = 0.5;       // an error that showed by a jump
  double least_speed_mps = 1.0;
};

// When ranges tell that the robot went another way than its odometry: see slip_watch.hpp.
struct SlipWatchConfig {
  double window_s = 0.4;
  double usual_s = 3.0;       // over which a pair's innovations are usual
  double most_sigmas = 3.0;   // by which one range counts at most
  double near_sigmas = 2.5;   // by which an anchor's mean is too near to be looked into
  double too_far_cost = 2.0;  // ln of how unlikely another reason is: blocked sight
  double too_near_cost = 7.0;
  double explained_share = 0.65;  // of all cost
  double odds = 12.0;             // ln of how unlikely a slip is
  double least_m = 0.04;          // a smaller displacement is none
  double least_mps = 0.3;         // by which odometry is then off
  double most_mps = 2.0;
  double lasts_s = 0.5;  // at first; twice as long each time that it shows again ...
  double again_s = 3.0;  // ... within this
  double most_lasts_s = 2.0;
  double turn_per_m = 0.5;  // rad/s of the yaw rate's doubt for each m/s
  double most_turn_radps = 0.5;
};

// How the noise of ranges follows their innovations: see self_tuning.hpp.
struct SelfTuningConfig {
  double most_factor = 10.0;  // upon the white sigma that was told, and below it
  double difference_s = 3.0;  // ranges of a pair that are closer tell of white noise
  double step = 0.003;        // of the white sigma with a range
  double first_step = 0.05;
  double first_draws = 100.0;
  double slow_step = 0.002;
  double slow_most_factor = 3.0;
};

// Of sensors beside odometry and ranges.
struct SensorConfig {
  SensorConfig() = default;
  // As told; what is not, as here.
  explicit SensorConfig(const model::SensorDescription& told);

  double gyro_sigma_radps = 0.005;         // white, a sample, constant until the next
  double gyro_bias_radps = 0.01;           // sigma of its constant bias
  double gyro_noise_sigmas = 6.0;          // by which two samples may differ for their noise,
  double gyro_acceleration_radps2 = 20.0;  // and with time for turning
  double gyro_hold_s = 0.2;                // silent for longer, odometry's yaw rate holds again
  Eigen::Vector3d position_lever_arm_m = Eigen::Vector3d::Zero();  // of the antenna, in base_link
  double standing_sigma_mps = 0.005;
  double standing_sigma_radps = 0.002;

  // Beyond so many sigmas a sample's weight falls with the square; beyond these it is refused, unless none of
  // its sensor was used for so long.
  double knee = 3.0;
  double wild = 10.0;
  double patience_s = 2.0;
};

// How the noise of odometry follows its rows: see self_tuning.hpp.
struct OdometryTuningConfig {
  double most_factor = 10.0;  // upon the sigmas that were told, and below them
  double max_gap_s = 0.3;     // rows that are further apart tell of motion, not of noise
  double uneven = 0.3;        // by which gaps may differ
  double step = 0.003;        // of a sigma with a row
  double first_step = 0.05;
  double first_draws = 100.0;
};

struct Config {
  Model model = Model::kSchmidt;

  model::OdometryNoise odometry;       // white, a row, constant over it
  double scale_sigma = 0.01;           // of the constant odometry scale error
  double yaw_rate_bias_radps = 0.002;  // sigma of the constant yaw-rate bias
  double max_hold_s = 0.5;             // an odometry row holds so long at most; then its velocity walks:
  double hold_walk_mps = 1.0;          // m/s per sqrt(s)
  double hold_walk_radps = 0.5;        // rad/s per sqrt(s)

  double range_sigma_m = 0.1;  // where the calibration observed none
  // The slow error on other drives than the calibration's, by what it left there: beta, gamma and poses were
  // fitted to that very error, which took much of it away, of what is slowest most.
  double slow_error_growth = 2.5;
  double slow_time_growth = 3.0;
  double lever_arm_sigma_m = 0.01;
  // Expected age of a range at its stamp, where the calibration observed none; sigma 0: the delay is known.
  double range_delay_s = 0.0;
  double range_delay_sigma_s = 0.0;
  double odometry_delay_sigma_s = 0.0;  // of the odometry's age beside its stamp; 0: it is exact
  double range_delay_change_s = 0.005;  // sigma of what changes in an observed delay from drive to drive
  // Anchors that are active at a time, kMaxAnchors at most.
  int active_anchors = kMaxAnchors;
  double silent_s = 1.0;     // one that was silent so long makes place for one that is not
  double min_range_m = 0.0;  // exclusive
  double max_range_m = 1000.0;

  GateConfig gate;
  OdometryGateConfig odometry_gate;
  OdometryWatchConfig watch;
  SlipWatchConfig slip;
  SelfTuningConfig tuning;
  SensorConfig sensors;
  OdometryTuningConfig odometry_tuning;
};

// As given, but for what scripts/ablation leaves out.
[[nodiscard]] Config ablated(Config config) noexcept;

// What is not known of the clocks of a robot's links where nobody told.
inline constexpr double kRangeDelaySigma_s = 0.01;
inline constexpr double kOdometryDelaySigma_s = 0.015;

}  // namespace groma::filter
