#include "host/filter/range_measurement.hpp"

#include "host/filter/propagation.hpp"
#include "host/model/antenna_pattern.hpp"
#include "host/model/pose.hpp"
#include "host/model/range_model.hpp"

namespace groma::filter {

RangeMeasurement measure_range(const model::Surface& surface, const CoreVector& core,
                               const model::OdometrySample& row, const PairParameters& pair,
                               int chart) noexcept {
  const Eigen::Vector3d& lever_arm = pair.lever_arm_m;
  const Eigen::Vector4d& frame = pair.frame;
  const Eigen::Vector3d turned(-pair.position_m.y(), pair.position_m.x(), 0.0);
  const Eigen::Vector3d position = pair.position_m + frame.head<3>() + frame(3) * turned;

  // The pose at the time of the measurement: kDelay ago, by the odometry sample held.
  Motion then;
  then.pose = core.segment<3>(kX);
  then.d_core.setIdentity();
  if (core(kDelay) != 0.0) then = move(surface, core, row, -core(kDelay), chart);
  CoreVector core_then = core;
  core_then.segment<3>(kX) = then.pose;

  model::SurfacePoint ground = surface.at(then.pose.x(), then.pose.y(), chart);
  ground.z_m += pair.ground(0);
  ground.gradient += pair.ground.tail<2>();
  const model::SurfaceRange prediction = model::predict_surface_range(
      ground, {then.pose.x(), then.pose.y(), then.pose.z()}, lever_arm, position, pair.terms);

  RangeMeasurement out;
  // The pattern's contribution to the Jacobians is a tenth of the lever arm's and is neglected.
  out.range_m =
      prediction.range_m + pair.range_bias_m + model::pattern_terms(prediction.in_body).dot(pair.pattern_m);
  out.d_core = prediction.d_pose.lazyProduct(then.d_core);
  out.d_core(kDelay) = -prediction.d_pose.dot(pose_rate(prediction.sideways, core_then, row));

  const Eigen::RowVector3d& d_anchor = prediction.d_anchor;
  out.d_parameters << d_anchor.x() + frame(3) * d_anchor.y(), d_anchor.y() - frame(3) * d_anchor.x(),
      d_anchor.z(), prediction.d_terms.transpose(), prediction.d_lever_arm, d_anchor, d_anchor.dot(turned),
      1.0, prediction.d_position.z(), prediction.d_gradient;
  return out;
}

}  // namespace groma::filter
