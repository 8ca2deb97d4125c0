// The bias-aware range model z = gamma ||p + R l - a|| + beta (eq. z_dist_new of the source paper), with
// its Jacobians. Calibration and filter both use this model; its terms are those of kPairTerms.
#pragma once

#include <Eigen/Core>

#include "host/model/anchor_parameters.hpp"
#include "host/model/pose.hpp"

namespace groma::model {

// A shorter distance has no usable direction: the Jacobians by position are zero. Numerics: a micrometre, far
// below any error and far above a double's rounding.
inline constexpr double kMinDistance_m = 1e-6;

// Predicted range of an antenna at a position in the map frame.
struct AntennaPrediction {
  double range_m = 0.0;
  double distance_m = 0.0;
  double scale = 1.0;                                   // derivative of the range by the distance
  Eigen::Vector3d direction = Eigen::Vector3d::Zero();  // unit vector from anchor to antenna, map frame
  TermVector d_terms;                                   // by the pair's terms
};
[[nodiscard]] inline AntennaPrediction predict_antenna_range(const Eigen::Vector3d& antenna_m,
                                                             const Eigen::Vector3d& anchor_m,
                                                             const TermVector& terms) noexcept {
  AntennaPrediction out;
  const Eigen::Vector3d separation = antenna_m - anchor_m;
  out.distance_m = separation.norm();
  out.scale = scale_of(terms);
  if (out.distance_m > kMinDistance_m) out.direction = separation / out.distance_m;
  out.d_terms = by_terms(out.distance_m, out.direction);
  out.range_m = terms.dot(out.d_terms);
  return out;
}

// Predicted range of a tag on a rigid body.
struct RangePrediction : AntennaPrediction {
  Eigen::RowVector3d d_position;   // by base_link's position p, map frame
  Eigen::RowVector3d d_anchor;     // by the anchor's position a, map frame
  Eigen::RowVector3d d_lever_arm;  // by the tag's lever arm l, base_link
};
[[nodiscard]] RangePrediction predict_range(const RigidPose& pose, const Eigen::Vector3d& lever_arm_m,
                                            const Eigen::Vector3d& anchor_m,
                                            const TermVector& terms) noexcept;

// Jacobian of the range by (x, y, theta) of a pose on a surface.
[[nodiscard]] Eigen::RowVector3d range_by_planar_pose(const RangePrediction& prediction,
                                                      const SurfacePose& pose,
                                                      const Eigen::Vector3d& lever_arm_m) noexcept;

// predict_range() and range_by_planar_pose() in one, for a pose on known ground, without intermediate
// matrices; with the further Jacobians that the filter uses.
struct SurfaceRange : RangePrediction {
  Eigen::RowVector3d d_pose;      // by x, y, theta
  Eigen::RowVector2d d_gradient;  // by the ground's gradient
  Eigen::Vector3d in_body;        // unit vector from anchor to tag, base_link
  Eigen::Matrix2d sideways;       // of R_WR: velocity in base_link to x', y'
};
[[nodiscard]] SurfaceRange predict_surface_range(const SurfacePoint& ground, const PlanarPose& planar,
                                                 const Eigen::Vector3d& lever_arm_m,
                                                 const Eigen::Vector3d& anchor_m,
                                                 const TermVector& terms) noexcept;

}  // namespace groma::model
