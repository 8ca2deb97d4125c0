// The pose now. The core state's is that of where the robot was when its odometry was true: where odometry
// comes late, some way behind.
#pragma once

#include <Eigen/Core>

#include "host/filter/link_delay.hpp"
#include "host/filter/state.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

struct PresentPose {
  Eigen::Vector3d pose;  // x, y, theta, not wrapped
  PoseRows d_core;
  Eigen::Matrix3d noise;  // covariance by what the core does not tell of the odometry's delay
  int chart = 0;
};

[[nodiscard]] PresentPose present_pose(const model::Surface& surface, const CoreVector& core,
                                       const model::OdometrySample& row, const LinkDelays& delays,
                                       int chart = 0) noexcept;

}  // namespace groma::filter
