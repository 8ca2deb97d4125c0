#include "host/filter/range_measurement.hpp"

#include "host/filter/propagation.hpp"
#include "host/model/antenna_pattern.hpp"
#include "host/model/pose.hpp"
#include "host/model/range_model.hpp"

namespace groma::filter {

namespace {

RangeMeasurement measure(const model::Surface& surface, const CoreVector& core,
                         const model::OdometrySample& row, const Parameters& parameters, int anchor, int tag,
                         double beta_m, double gamma, const model::PatternTerms& pattern_m) noexcept {
  const ParameterVector& values = parameters.values();
  const Eigen::Vector3d surveyed = values.segment<3>(parameters.position(anchor));
  const Eigen::Vector3d lever_arm = values.segment<3>(parameters.lever_arm(tag));
  const Eigen::Vector4d frame = values.segment<kFrameSize>(parameters.frame());
  const Eigen::Vector3d turned(-surveyed.y(), surveyed.x(), 0.0);
  const Eigen::Vector3d position = surveyed + frame.head<3>() + frame(3) * turned;

  // The pose that the range tells of: a delay ago, by the row held.
  Motion then;
  then.pose = core.segment<3>(kX);
  then.d_core.setIdentity();
  if (core(kDelay) != 0.0) then = move(surface, core, row, -core(kDelay));
  CoreVector core_then = core;
  core_then.segment<3>(kX) = then.pose;

  const model::SurfacePose pose =
      model::pose_on_surface(surface, {then.pose.x(), then.pose.y(), then.pose.z()});
  const model::RangePrediction prediction =
      model::predict_range(pose.pose, lever_arm, position, beta_m, gamma);
  const Eigen::RowVector3d d_pose = model::range_by_planar_pose(prediction, pose, lever_arm);

  RangeMeasurement out;
  // What the pattern adds to the derivatives is a tenth of what the lever arm does, and left out.
  out.range_m = prediction.range_m + values(parameters.slow_error(anchor)) +
                model::pattern_terms(pose.pose.rotation.transpose() * prediction.direction).dot(pattern_m);
  out.distance_m = prediction.distance_m;
  out.d_core.noalias() = d_pose * then.d_core;
  out.d_core(kDelay) = -d_pose.dot(pose_rate(surface, core_then, row));

  const Eigen::RowVector3d& d_anchor = prediction.d_anchor;
  const int p = parameters.position(anchor);
  const int l = parameters.lever_arm(tag);
  const int f = parameters.frame();
  out.index = {
      p,     p + 1, p + 2, parameters.beta(anchor, tag), parameters.gamma(anchor, tag), l, l + 1, l + 2, f,
      f + 1, f + 2, f + 3, parameters.slow_error(anchor)};
  out.d_parameters << d_anchor.x() + frame(3) * d_anchor.y(), d_anchor.y() - frame(3) * d_anchor.x(),
      d_anchor.z(), 1.0, prediction.distance_m, prediction.d_lever_arm, d_anchor, d_anchor.dot(turned), 1.0;
  return out;
}

}  // namespace

RangeMeasurement measure_range(const model::Surface& surface, const CoreVector& core,
                               const model::OdometrySample& row, const Parameters& parameters, int anchor,
                               int tag) noexcept {
  return measure(surface, core, row, parameters, anchor, tag,
                 parameters.values()(parameters.beta(anchor, tag)),
                 parameters.values()(parameters.gamma(anchor, tag)), parameters.pattern_m(tag));
}

RangeMeasurement measure_distance(const model::Surface& surface, const CoreVector& core,
                                  const model::OdometrySample& row, const Parameters& parameters, int anchor,
                                  int tag) noexcept {
  return measure(surface, core, row, parameters, anchor, tag, 0.0, 1.0, model::PatternTerms::Zero());
}

}  // namespace groma::filter
