// Ranges joined with the poses of the drive: where each tag's antenna was at the instant of each range.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "host/calibration/drive.hpp"
#include "host/model/pose.hpp"
#include "host/model/power_class.hpp"

namespace groma::calibration {

// One range with all that the solver needs to know of the robot at that instant; map frame.
struct Observation {
  double t_s = 0.0;
  double range_m = 0.0;
  Eigen::Vector3d tag_m = Eigen::Vector3d::Zero();               // antenna
  Eigen::Vector3d velocity_mps = Eigen::Vector3d::Zero();        // of the antenna
  Eigen::Vector2d yaw_arm_m = Eigen::Vector2d::Zero();           // d tag_m / d yaw, its x and y
  Eigen::Quaternionf attitude = Eigen::Quaternionf::Identity();  // takes base_link's vectors into the map
  // Covariance of the antenna's place by the pose's own error that is new at each pose: xx, xy, yy, m^2; zero
  // where the poses do not tell it.
  Eigen::Vector3f pose_spread_m2 = Eigen::Vector3f::Zero();
  std::uint32_t tag = 0;    // index in Association::tags
  std::uint32_t index = 0;  // among the anchor's rows
  model::PowerClass power_class = model::kNoPowerClass;
};

struct AnchorObservations {
  model::NodeId id = 0;
  std::vector<Observation> rows = {};  // by time
  std::size_t rejected = 0;            // not a range at all, or no pose near it
  std::size_t left_out = 0;            // ranges with a pose that were not chosen
};

// What a pose tells of its own error.
struct PoseSpread {
  double t_s = 0.0;
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();  // of x, y and yaw
};

struct Association {
  std::vector<model::Tag> tags;             // by id, ascending
  std::vector<AnchorObservations> anchors;  // by id, ascending: every anchor that any range names
  std::vector<PoseSpread> pose_spreads;     // by time: of the poses that tell it
};

// Which height the drive's poses have: their own, or that of the surface beneath them.
enum class HeightSource { kPose, kSurface };

// The robot's pose at a time between two samples, fraction in [0, 1] of the way: position linear, angles on
// the circle. Roll or pitch that the samples lack are the surface's at that place and heading.
[[nodiscard]] model::RigidPose interpolate_pose(const model::PoseSample& from, const model::PoseSample& to,
                                                double fraction, const model::Surface& surface,
                                                HeightSource height = HeightSource::kPose) noexcept;

[[nodiscard]] Association associate(const Drive& drive, HeightSource height);

// Root mean square of pose height minus surface height; zero without poses.
[[nodiscard]] double height_disagreement_m(const Drive& drive) noexcept;

}  // namespace groma::calibration
