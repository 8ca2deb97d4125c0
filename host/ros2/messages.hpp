// The messages that describe a localization to ROS 2: the same on the wire and in recordings. Topics have the
// names of the namespace "groma".
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "host/filter/tracker.hpp"
#include "host/model/calibration.hpp"
#include "host/model/odom_frame.hpp"
#include "host/model/pose.hpp"
#include "host/model/types.hpp"
#include "host/ros2/cdr_writer.hpp"

namespace groma::ros2 {

using Covariance = Eigen::Matrix<double, 6, 6>;  // x, y, z and rotations about them; twists likewise

// Consumers invert covariances: a variance is neither zero nor NaN.
inline constexpr double kUnknownVariance = 1e6;
inline constexpr double kLeastVariance = 1e-9;

// geometry_msgs: header.stamp and frame_id; Vector3; Quaternion; Pose; the 36 terms of a covariance.
void put_header(CdrWriter& out, double t_s, std::string_view frame);
void put_vector(CdrWriter& out, const Eigen::Vector3d& of);
void put_quaternion(CdrWriter& out, const Eigen::Vector4d& of);
void put_pose(CdrWriter& out, const model::QuaternionPose& pose);
void put_covariance(CdrWriter& out, const Covariance& of);
// velocity: vx and vy (m/s), yaw rate (rad/s), with their covariance; NaN is unknown.
void put_twist(CdrWriter& out, const Eigen::Vector3d& velocity, const Eigen::Matrix3d& covariance);

// Of x, y and the rotation about z only; each is unknown without `known`.
[[nodiscard]] Covariance planar_covariance(const std::optional<Eigen::Matrix3d>& known);

// Names of frames.
struct Frames {
  std::string map = "map";
  std::string odom = "odom";
  std::string base = "base_link";
};

// The localization at one instant.
struct Localization {
  double t_s = 0.0;
  model::QuaternionPose pose;  // of the base in the map
  Covariance covariance = Covariance::Zero();
  Eigen::Vector3d velocity = Eigen::Vector3d::Zero();  // as of put_twist()
  Eigen::Matrix3d velocity_covariance = Eigen::Matrix3d::Zero();
  std::optional<model::OdomPose> odom;  // none: no transforms
  filter::State state = filter::State::kUninitialized;
  filter::Reason reason = filter::Reason::kNone;
};

// A message: its topic, its type such as "nav_msgs/msg/Odometry", its time and its bytes (CDR).
using Write =
    std::function<void(std::string_view topic, std::string_view type, double t_s, std::string_view cdr)>;

inline constexpr std::string_view kPoseTopic = "/groma/pose";
inline constexpr std::string_view kOdometryTopic = "/groma/odometry";
inline constexpr std::string_view kAnchorsTopic = "/groma/anchors";
inline constexpr std::string_view kTransformTopic = "/tf";
inline constexpr std::string_view kDiagnosticsTopic = "/diagnostics";
// The name of the state in diagnostics.
inline constexpr std::string_view kStateName = "groma: localization";

class LocalizationMessages {
 public:
  // map to odom holds until the next one: like that of other localizers, its timestamp is ahead by this.
  static constexpr double kTransformTolerance_s = 0.1;

  LocalizationMessages(Frames frames, bool has_transforms)
      : frames_(std::move(frames)), has_transforms_(has_transforms) {}

  // geometry_msgs/PoseWithCovarianceStamped and nav_msgs/Odometry in the map; tf2_msgs/TFMessage with map to
  // odom (REP-105), and odom to base if odom is integrated here; once a second, and where the state changes,
  // diagnostic_msgs/DiagnosticArray. Without has_timestamp() nothing.
  void put(const Localization& at, const Write& write);

 private:
  void put_transforms(const Localization& at, const Write& write) const;
  void put_diagnostics(const Localization& at, const Write& write);

  Frames frames_;
  bool has_transforms_;
  std::uint64_t next_diagnostics_ns_ = 0;
  std::optional<std::pair<filter::State, filter::Reason>> state_;  // of the last diagnostics
};

// visualization_msgs/MarkerArray: a cube and a label for each anchor with a position, valid at any time.
// Removes those of an earlier message.
[[nodiscard]] std::string anchor_markers(const model::Calibration& calibration);

// A line from a tag to an anchor in the map.
struct LinkLine {
  Eigen::Vector3d tag_m;
  Eigen::Vector3d anchor_m;
  double used_share = 1.0;  // of its ranges, by the filter
};
// visualization_msgs/MarkerArray: the lines, green if all ranges are used, red if none. For a second.
[[nodiscard]] std::string link_markers(std::span<const LinkLine> links, double t_s, std::string_view frame);

// diagnostic_msgs/DiagnosticStatus
struct Diagnostic {
  std::uint8_t level = 0;  // 0 OK, 1 WARN, 2 ERROR
  std::string name;
  std::string message;
  std::vector<std::pair<std::string, std::string>> values;
};
// diagnostic_msgs/DiagnosticArray
[[nodiscard]] std::string diagnostics_message(std::span<const Diagnostic> diagnostics, double t_s);

}  // namespace groma::ros2
