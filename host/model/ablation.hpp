// Switches that leave out one mechanism each which goes beyond the source paper's equations. They are
// compiled in with the CMake option GROMA_ABLATION alone, for scripts/ablation; without it nothing is left
// out.
#pragma once

#include <cstdint>

namespace groma::model {

enum class Mechanism : std::uint8_t {
  // filter: state
  kOdometryScale,   // constant scale error of odometry
  kYawRateBias,     // constant yaw-rate bias of odometry
  kRangeDelay,      // delay of ranges against odometry
  kOdometryDelay,   // the odometry's share in that delay
  kRangeBias,       // Gauss-Markov range bias of each anchor
  kOtherDrive,      // that the calibration's drive shows it too small
  kLeverArm,        // uncertain lever arms
  kCommonFrame,     // error of the frame that all anchors share
  kGroundMismatch,  // height and slope that the surface lacks
  kAntennaPattern,  // of a tag, by direction
  // filter: weights of ranges
  kGate,               // weights at all
  kGateMemory,         // a pair that was blocked is expected to be
  kGateTags,           // what blocks one tag of an anchor blocks the others
  kGateReception,      // missed polls
  kGatePowers,         // received powers
  kGateShort,          // ranges that are too short
  kDivergence,         // divergence flag: the covariance grows while ranges are refused
  kDivergenceLasting,  // by most ranges for 5 s
  // filter: noise and faults of odometry
  kRangeNoise,      // white range noise by innovations
  kRangeBiasNoise,  // sigma of the Gauss-Markov range bias by innovations
  kOdometryNoise,   // white odometry noise by its samples
  kOdometryGate,    // samples that no robot can do
  kOdometryWatch,   // samples that wheels cannot follow
  kSlip,            // slip by the ranges of several anchors
  kHold,            // growth while odometry is late
  // tracker
  kCautiousCost,  // an anchor's say in a search is bounded
  // calibration
  kCalibrationKernels,      // kernels of anchors and pairs, not of the site alone
  kCalibrationContradict,   // a start that later ranges contradict is searched again
  kCalibrationProbes,       // further starts beside the mirror point
  kCalibrationNlos,         // LOS of each range
  kCalibrationPowers,       // received powers in it
  kCalibrationEpisodes,     // excess of each NLOS episode as an unknown
  kCalibrationMoves,        // anchors that were moved
  kCalibrationDrift,        // pose drift
  kCalibrationSmoothDrift,  // of second order
  kCalibrationKnots,        // drift and noise of poses by their covariance
  kCalibrationBody,         // lever arms and antenna patterns
  kCalibrationDelay,        // range delay
  kCalibrationAgain,        // LOS once more after the body terms
  kCalibrationJackknife,    // covariance: jackknife
  kCalibrationInflation,    // covariance: scatter of scores
  kCalibrationCurvature,    // covariance: mean curvature of the kernel
  kCalibrationOwnPattern,   // covariance: antenna pattern of the anchor
  kCalibrationBlocking,     // covariance: what walls may add
  kCalibrationMirror,       // covariance: mirror side
  kCalibrationShift,        // covariance: height by the drive's beginning
  kCalibrationReach,        // covariance: no further than ranges are long
  kCalibrationFrame,        // covariance: frame of the drive
  kCalibrationHeights,      // both heights of poses
  kCalibrationRangeNoise,   // white and Gauss-Markov range noise
  // smoother
  kSmootherNlos,       // LOS of each range by all of its pair
  kSmootherRangeBias,  // Gauss-Markov range bias
  kCount,
};

#ifdef GROMA_ABLATION
// Whether the environment variable GROMA_ABLATE has its number in the list above: numbers from 0, separated
// by commas. Ends the program where there is no such number.
[[nodiscard]] bool is_ablated(Mechanism mechanism) noexcept;
#else
[[nodiscard]] constexpr bool is_ablated(Mechanism /*mechanism*/) noexcept {
  return false;
}
#endif

}  // namespace groma::model
