// Ranges joined with the poses of the drive: where each tag's antenna was at the instant of each range.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "host/calibration/drive.hpp"
#include "host/model/pose.hpp"
#include "host/model/power_class.hpp"

namespace groma::calibration {

// One range with the robot's state at its instant, as the solver needs it; map frame.
struct Observation {
  double t_s = 0.0;
  double range_m = 0.0;
  Eigen::Vector3d tag_m = Eigen::Vector3d::Zero();               // antenna
  Eigen::Vector3d velocity_mps = Eigen::Vector3d::Zero();        // of the antenna
  Eigen::Vector2d yaw_arm_m = Eigen::Vector2d::Zero();           // d tag_m / d yaw, its x and y
  Eigen::Quaternionf attitude = Eigen::Quaternionf::Identity();  // rotates from base_link to map
  // Covariance of the antenna's position due to the pose's white error: xx, xy, yy, m^2; zero if the poses
  // report none.
  Eigen::Vector3f pose_spread_m2 = Eigen::Vector3f::Zero();
  std::uint32_t tag = 0;    // index in Association::tags
  std::uint32_t index = 0;  // among the anchor's rows
  model::PowerClass power_class = model::kNoPowerClass;
};

struct AnchorObservations {
  model::NodeId id = 0;
  std::vector<Observation> rows = {};  // by time
  std::size_t rejected = 0;            // invalid range, unknown tag, or no pose near it
  std::size_t left_out = 0;            // not selected by choose_measurements()
};

// Covariance that a pose reports of itself.
struct PoseSpread {
  double t_s = 0.0;
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();  // of x, y (m) and yaw (rad)
};

struct Association {
  std::vector<model::Tag> tags;             // by id, ascending
  std::vector<AnchorObservations> anchors;  // by id, ascending: every anchor that any range names
  std::vector<PoseSpread> pose_spreads;     // by time: of the poses that report one
};

// Height of the drive's poses: their own, or that of the surface below them.
enum class HeightSource { kPose, kSurface };

// The robot's pose between two samples, with `fraction` in [0, 1]: position linear, angles along the shorter
// arc. Roll or pitch that the samples lack is the surface's at that place and heading.
[[nodiscard]] model::RigidPose interpolate_pose(const model::PoseSample& from, const model::PoseSample& to,
                                                double fraction, const model::Surface& surface,
                                                HeightSource height = HeightSource::kPose) noexcept;

[[nodiscard]] Association associate(const Drive& drive, HeightSource height);

// At most max_rows_per_tag observations of each tag, spread evenly along the tag's path: a long stop counts
// no more than a short one.
[[nodiscard]] std::vector<Observation> spread_along_the_way(std::span<const Observation> rows,
                                                            std::size_t tag_count,
                                                            std::size_t max_rows_per_tag);

// Root mean square of pose height minus surface height, m; zero without poses or surface.
[[nodiscard]] double height_disagreement_m(const Drive& drive) noexcept;

}  // namespace groma::calibration
