#include "host/filter/present_pose.hpp"

#include "host/filter/propagation.hpp"
#include "host/model/pose.hpp"

namespace groma::filter {

PresentPose present_pose(const model::Surface& surface, const CoreVector& core,
                         const model::OdometrySample& row, const LinkDelays& delays, int chart) noexcept {
  const double share = delays.odometry_share();
  if (!(share > 0.0)) {
    return {.pose = core.segment<3>(kX),
            .d_core = PoseRows::Identity(),
            .noise = Eigen::Matrix3d::Zero(),
            .chart = chart};
  }
  const Motion motion = move(surface, core, row, delays.odometry_s(core(kDelay)), chart);
  CoreVector now = core;
  now.segment<3>(kX) = motion.pose;
  const model::SurfacePose there =
      model::pose_on_surface(surface, {motion.pose.x(), motion.pose.y(), motion.pose.z(), chart});
  const Eigen::Vector3d rate = pose_rate(there.pose.rotation.topLeftCorner<2, 2>(), now, row);
  PresentPose out{.pose = motion.pose,
                  .d_core = motion.d_core,
                  .noise = delays.odometry_variance_s2() * rate * rate.transpose(),
                  .chart = chart};
  out.d_core.col(kDelay) -= share * rate;
  return out;
}

}  // namespace groma::filter
