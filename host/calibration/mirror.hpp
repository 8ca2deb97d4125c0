// Tests the mirror sides of anchors: across the plane of the tags, and across the line of the drive.
#pragma once

#include <span>

#include <Eigen/Core>

#include "host/calibration/anchor_solver.hpp"
#include "host/calibration/association.hpp"
#include "host/model/calibration.hpp"

namespace groma::calibration {

struct Site;

// Axes of TagSpread to mirror along: across the line of the drive, across the plane of the tags.
inline constexpr int kAcrossLine = 1;
inline constexpr int kAcrossPlane = 2;

// Principal axes of the antennas' positions, map frame.
struct TagSpread {
  Eigen::Vector3d center_m = Eigen::Vector3d::Zero();
  Eigen::Matrix3d axes = Eigen::Matrix3d::Identity();  // columns: largest spread first

  // Mirror image of a point along one axis, 0..2.
  [[nodiscard]] Eigen::Vector3d mirror(const Eigen::Vector3d& point_m, int axis) const noexcept;
};
[[nodiscard]] TagSpread tag_spread(std::span<const Observation> rows);

// Mirror hypothesis: the best solution on the other side.
struct MirrorHypothesis {
  AnchorVector anchor;
  double cost_excess = 0.0;  // negative log likelihood above the solution's, for independent residuals; >= 0
  double cost_ratio = 1.0;   // the solution's cost over this one's, 0..1, above those of perfect ranges
};

// Tests the mirror hypothesis along one axis. If it explains the ranges better, the fit moves there and its
// former place becomes the mirror hypothesis. The fit must have ranges.
[[nodiscard]] MirrorHypothesis test_mirror(AnchorFit& fit, const TagSpread& spread, int axis);

// Tests across the line and across the plane of the tags, only for what they do to the fit.
void test_both_mirrors(AnchorFit& fit);

// An anchor's position in an earlier calibration.
struct EarlierPlace {
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Matrix3d covariance_m2 = Eigen::Matrix3d::Identity();  // includes the drives' frames
};
// Adds the cost of the earlier position to the hypothesis' excess; it is limited, because the anchor may have
// been moved, and multiplied by the fit's inflation, because the excess is for independent residuals. If the
// excess becomes negative, fit and hypothesis swap places; the fit's cost is that of its former place then.
void weigh_by_earlier(const EarlierPlace& earlier, AnchorFit& fit, MirrorHypothesis& mirror);

// Tests both mirror positions of each anchor and refines all anchors. A fit moves to the position that
// explains the ranges better, or that the earlier calibration (may be null) prefers. Fills in its part of the
// evidence.
void test_mirrors(Site& site, const model::Calibration* earlier);

// What the mirror hypothesis adds to the position's covariance, m^2: the second moment about the fit if the
// hypothesis is true with the probability that its excess divided by the fit's inflation gives.
[[nodiscard]] Eigen::Matrix3d mirror_covariance(const MirrorHypothesis& mirror, const AnchorFit& fit);

}  // namespace groma::calibration
