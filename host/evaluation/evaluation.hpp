// Accuracy and consistency of an estimate against the ground truth, as the source paper defines them: at
// sample k ATE^t_k = ||e_t,k||, ATE^theta_k = |e_theta,k|, NEES_k = e_k' P_k^-1 e_k / 3, without any
// alignment.
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include "host/model/types.hpp"

namespace groma::evaluation {

// The longest gap over which an estimate is interpolated.
inline constexpr double kMaxGap_s = 0.3;
// 95 % quantile of the chi-square distribution with 3 degrees of freedom.
inline constexpr double kChiSquare95 = 7.815;

// Estimate minus truth at one of the truth's times; the heading's difference is in (-pi, pi].
struct PoseError {
  double t_s = 0.0;
  double x_m = 0.0;
  double y_m = 0.0;
  double yaw_rad = 0.0;
  std::optional<double> nees;  // e' P^-1 e / 3; none where P is not positive definite
};

// One error for each of the truth's times at which there is an estimate: the row at that time, or two rows at
// most kMaxGap_s apart, with interpolated position and heading and the earlier row's covariance. The times of
// both inputs are strictly ascending.
[[nodiscard]] std::vector<PoseError> pose_errors(std::span<const model::PlanarEstimate> estimate,
                                                 std::span<const model::PoseSample> truth);

// How much of either input the errors of pose_errors() score.
struct Coverage {
  double estimate = 0.0;  // share of its rows that are near a scored time
  double truth = 0.0;     // share of its rows that are scored
};
// Near is: within kMaxGap_s, or the truth's usual interval if that is longer.
[[nodiscard]] Coverage coverage(std::span<const model::PlanarEstimate> estimate,
                                std::span<const model::PoseSample> truth, std::span<const PoseError> errors);

// Spans where the truth repeats one pose and then jumps, as the output of a tracking system that lost
// the robot: at least kFewRepeats equal rows within kMaxFrozen_s, followed by a step of kLeastJump_m or more
// at over kJumpFactor times the speed of the step before the span and of the step after the jump. A
// stationary robot that moves off does not match.
inline constexpr std::size_t kFewRepeats = 5;
inline constexpr double kMaxFrozen_s = 1.0;
inline constexpr double kLeastJump_m = 0.05;
inline constexpr double kJumpFactor = 5.0;
struct FrozenSpan {
  double from_s = 0.0;
  double to_s = 0.0;  // of the last row that repeats the first
  double jump_m = 0.0;
};
[[nodiscard]] std::vector<FrozenSpan> frozen_spans(std::span<const model::PoseSample> truth);

struct Statistics {
  double max = 0.0;
  double mean = 0.0;
  double std = 0.0;  // of the samples: rmse^2 = mean^2 + std^2
  double rmse = 0.0;
};

struct Consistency {
  double max = 0.0;
  double mean = 0.0;
  double std = 0.0;
  double inside_95 = 0.0;  // share of samples with e' P^-1 e at most kChiSquare95
};

struct Evaluation {
  std::size_t samples = 0;
  std::size_t samples_without_covariance = 0;  // P not positive definite: left out of `nees`
  Statistics ate_m;
  Statistics ate_rad;
  std::optional<Consistency> nees;  // none if no sample has a valid covariance
};

// None if there are no errors.
[[nodiscard]] std::optional<Evaluation> evaluate(std::span<const PoseError> errors);

}  // namespace groma::evaluation
