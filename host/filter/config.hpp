// What the filter is told before it starts: the measurement model, noises and bounds.
#pragma once

#include <array>
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

// Whether the covariance of core and parameters is kept. The other models are comparisons, whose noise stays
// as configured: what their innovations show is their own error.
[[nodiscard]] constexpr bool keeps_cross(Model model) noexcept {
  return model == Model::kSchmidt || model == Model::kAnchorStates || model == Model::kJoint;
}

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
  // Where all polls of a pair are missed: the share of its ranges that is off, and garbage of all; half-way
  // there the excess is all of a larger mean.
  double regained_share = 0.7;
  double regained_garbage = 0.14;
  double garbage_share = 0.01;  // of ranges
  double garbage_width_m = 50.0;

  // What the powers of ranges tell beside their innovations, as it is learnt: see SightHint.
  double hint_most = 10.0;       // the likelihood ratio of one range at most; 1: they are not used
  double hint_s = 0.2;           // ranges of a pair that are closer come by the same walls: one to learn from
  double hint_memory_s = 600.0;  // what was learnt fades over this time
  double hint_prior_count = 30.0;  // of ranges, that what is believed beforehand is worth

  double window_s = 1.0;  // over which divergence is suspected: see gate.cpp
};

// Of sensors beside odometry and ranges.
struct SensorConfig {
  SensorConfig() = default;
  // As told; what is not, as here.
  explicit SensorConfig(const model::SensorDescription& told);

  double gyro_sigma_radps = 0.005;                                 // white, a sample, constant until the next
  double gyro_bias_radps = 0.01;                                   // sigma of its constant bias
  Eigen::Vector3d position_lever_arm_m = Eigen::Vector3d::Zero();  // of the antenna, in base_link
  double standing_sigma_mps = 0.005;
  double standing_sigma_radps = 0.002;
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
  // Anchors that are active at a time, kMaxAnchors at most.
  int active_anchors = kMaxAnchors;
  double silent_s = 1.0;     // one that was silent so long makes place for one that is not
  double min_range_m = 0.0;  // exclusive
  double max_range_m = 1000.0;

  bool tunes_noise = true;             // ranges' and odometry's: see self_tuning.hpp
  double max_acceleration_mps2 = 8.0;  // that wheels can push: see OdometryWatch
  double slip_odds = 12.0;             // ln of how unlikely a slip is: see SlipWatch
  GateConfig gate;
  SensorConfig sensors;
};

// As given, but for what scripts/ablation leaves out.
[[nodiscard]] Config ablated(Config config) noexcept;

// Sigma of what changes in an observed delay of ranges from drive to drive.
inline constexpr double kRangeDelayChange_s = 0.005;
// What is not known of the clocks of a robot's links where nobody told.
inline constexpr double kRangeDelaySigma_s = 0.01;
inline constexpr double kOdometryDelaySigma_s = 0.015;

}  // namespace groma::filter
