// Switches that each disable one mechanism beyond the source paper's equations. They are compiled in only
// with the CMake option GROMA_ABLATION, for scripts/ablation; without it every mechanism is enabled.
#pragma once

#include <cstdint>

namespace groma::model {

enum class Mechanism : std::uint8_t {
  // filter: state
  kOdometryScale,   // constant scale error of odometry
  kYawRateBias,     // constant yaw-rate bias of odometry
  kRangeDelay,      // delay of ranges against odometry
  kOdometryDelay,   // delay of odometry, as its share of that delay
  kRangeBias,       // Gauss-Markov range bias of each anchor
  kOtherDrive,      // larger range noise and delay on drives other than the calibration's
  kLeverArm,        // uncertain lever arms
  kCommonFrame,     // error of the frame that all anchors share
  kGroundMismatch,  // height and slope errors of the surface model
  kAntennaPattern,  // of a tag, by direction
  // filter: weights of ranges
  kGate,             // soft gate as a whole
  kGateMemory,       // a pair that was NLOS is expected to stay NLOS
  kGateTags,         // NLOS of one tag of an anchor makes NLOS of the others likelier
  kGateReception,    // missed polls
  kGatePowers,       // received powers
  kDivergence,       // divergence flag: the covariance grows while ranges are rejected
  kDivergenceStart,  // also raised where most ranges since a start are rejected
  // filter: noise and faults of odometry
  kRangeNoise,     // white range noise, tuned by innovations
  kOdometryNoise,  // white odometry noise, tuned by the samples
  kOdometryGate,   // rejects samples that no robot can perform
  kOdometryWatch,  // detects samples that the wheels cannot follow
  kSlip,           // detects slip by the ranges of several anchors
  kHold,           // growth while odometry is late
  // tracker
  kCautiousCost,  // bound on the cost of one anchor in a start search
  // calibration
  kCalibrationKernels,      // kernel scales per anchor and pair, not only per site
  kCalibrationContradict,   // repeat a start search that later ranges contradict
  kCalibrationProbes,       // further starts beside the mirror point
  kCalibrationNlos,         // LOS of each range
  kCalibrationPowers,       // received powers in it
  kCalibrationEpisodes,     // excess of each NLOS episode as an unknown
  kCalibrationMoves,        // anchors that were moved
  kCalibrationDrift,        // pose drift
  kCalibrationSmoothDrift,  // of second order
  kCalibrationKnots,        // drift and noise of poses from the poses' covariance
  kCalibrationBody,         // lever arms and antenna patterns
  kCalibrationDelay,        // range delay
  kCalibrationAgain,        // LOS estimated again after the body terms
  kCalibrationJackknife,    // covariance: jackknife
  kCalibrationInflation,    // covariance: scatter of scores
  kCalibrationCurvature,    // covariance: mean curvature of the kernel
  kCalibrationOwnPattern,   // covariance: antenna pattern of the anchor
  kCalibrationBlocking,     // covariance: NLOS biases
  kCalibrationMirror,       // covariance: mirror hypothesis
  kCalibrationShift,        // covariance: different height from the drive's first part
  kCalibrationReach,        // covariance: an anchor lies within the length of its ranges
  kCalibrationFrame,        // covariance: frame of the drive
  kCalibrationHeights,      // heights of poses from the poses or from the surface, the better of both
  kCalibrationRangeNoise,   // white and Gauss-Markov range noise
  kCount,
};

#ifdef GROMA_ABLATION
// Whether the environment variable GROMA_ABLATE disables the mechanism. The variable holds numbers in the
// list above, from 0, separated by commas. An unknown number ends the program with exit code 2.
[[nodiscard]] bool is_ablated(Mechanism mechanism) noexcept;
#else
[[nodiscard]] constexpr bool is_ablated(Mechanism /*mechanism*/) noexcept {
  return false;
}
#endif

}  // namespace groma::model
