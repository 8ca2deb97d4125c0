// How large an error has to be before it is named, and how well the recorded runs determine it at best.
#pragma once

#include <numbers>

namespace groma::diagnosis {

// Poses are interpolated over at most this: at 1 m/s^2 that is off by 0.011 m.
inline constexpr double kMaxPoseGap_s = 0.3;
// By hand: a parameter is named only if it is this many of its sigmas from neutral.
inline constexpr double kSignificance = 5.0;
// A fit whose residuals are larger than this many configured sigmas explains nothing: another mistake, or one
// that is no hypothesis, is left. By hand: sigmas may be wrong by a factor of three.
inline constexpr double kMostSigmas = 8.0;
// Where residuals are smaller than this many, motion and ranges agree: what differs is the map. By hand.
inline constexpr double kFitSigmas = 3.0;
// Slices of the drive whose scores give the covariance of an estimate: errors within a slice may be
// correlated in time.
inline constexpr int kSlices = 20;
// Of a short drive there are fewer. By hand: on recorded runs, errors of anchors and antennas last as long.
inline constexpr double kShortestSlice_s = 10.0;

// kSignificant...: the smallest error of which issue-size campaigns found that it worsens poses or anchors by
// half. An error below a third of it changes nothing. The limit is the geometric mean of both.
inline constexpr double kLimit = 1.0 / std::numbers::sqrt3;
inline constexpr double kLeastClock_s = kLimit * 0.1;
// Of the offset from the drive's begin to its end: 0.001 s/s for four minutes.
inline constexpr double kLeastDrift_s = kLimit * 0.24;
inline constexpr double kLeastHeading_rad = kLimit * 0.15;
inline constexpr double kLeastLeverArm_m = kLimit * 0.3;
inline constexpr double kLeastHeight_m = kLimit * 0.3;
inline constexpr double kLeastScale = kLimit * 0.05;

// Errors that a good run may have anyway, added to each reported sigma. Recorded runs: ranges are 15 to 21 ms
// late (mcd), heading and course differ by 1 degree (mcd, plaza1), odometry's scale by 1 % (all).
inline constexpr double kClockSystematic_s = 0.015;
inline constexpr double kDriftSystematic_s = 0.02;  // from begin to end
inline constexpr double kHeadingSystematic_rad = 0.02;
inline constexpr double kLeverArmSystematic_m = 0.03;
inline constexpr double kHeightSystematic_m = 0.03;
inline constexpr double kScaleSystematic = 0.01;

}  // namespace groma::diagnosis
