#include "host/filter/range_measurement.hpp"

#include "host/filter/propagation.hpp"
#include "host/model/antenna_pattern.hpp"

namespace groma::filter {

namespace {

// z axis x a.
Eigen::Vector3d turned(const PairParameters& pair) noexcept {
  return {-pair.position_m.y(), pair.position_m.x(), 0.0};
}

}  // namespace

model::SurfaceRange range_from(const model::Surface& surface, const Eigen::Vector3d& pose,
                               const PairParameters& pair, int chart) noexcept {
  const Eigen::Vector4d& frame = pair.frame;
  const Eigen::Vector3d position = pair.position_m + frame.head<3>() + frame(3) * turned(pair);
  model::SurfacePoint ground = surface.at(pose.x(), pose.y(), chart);
  ground.z_m += pair.ground(0);
  ground.gradient += pair.ground.tail<2>();
  model::SurfaceRange out = model::predict_surface_range(ground, {pose.x(), pose.y(), pose.z()},
                                                         pair.lever_arm_m, position, pair.terms);
  // The pattern's contribution to the Jacobians is a tenth of the lever arm's and is neglected.
  out.range_m = out.range_m + pair.range_bias_m + model::pattern_terms(out.in_body).dot(pair.pattern_m);
  return out;
}

ParameterRow by_parameters(const PairParameters& pair, const model::SurfaceRange& prediction) noexcept {
  const Eigen::RowVector3d& d_anchor = prediction.d_anchor;
  const double yaw = pair.frame(3);
  ParameterRow out;
  out << d_anchor.x() + yaw * d_anchor.y(), d_anchor.y() - yaw * d_anchor.x(), d_anchor.z(),
      prediction.d_terms.transpose(), prediction.d_lever_arm, d_anchor, d_anchor.dot(turned(pair)), 1.0,
      prediction.d_position.z(), prediction.d_gradient;
  return out;
}

RangeMeasurement measure_range(const model::Surface& surface, const CoreVector& core,
                               const model::OdometrySample& row, const PairParameters& pair,
                               int chart) noexcept {
  // The pose at the time of the measurement: kDelay ago, by the odometry sample held.
  Motion then;
  then.pose = core.segment<3>(kX);
  then.d_core.setIdentity();
  if (core(kDelay) != 0.0) then = move(surface, core, row, -core(kDelay), chart);
  CoreVector core_then = core;
  core_then.segment<3>(kX) = then.pose;

  const model::SurfaceRange prediction = range_from(surface, then.pose, pair, chart);
  RangeMeasurement out;
  out.range_m = prediction.range_m;
  out.d_core = prediction.d_pose.lazyProduct(then.d_core);
  out.d_core(kDelay) = -prediction.d_pose.dot(pose_rate(prediction.sideways, core_then, row));
  out.d_parameters = by_parameters(pair, prediction);
  return out;
}

}  // namespace groma::filter
