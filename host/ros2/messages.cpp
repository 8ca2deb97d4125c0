// Fields in the order of schemas.cpp.
#include "host/ros2/messages.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <span>
#include <utility>
#include <vector>

#include <Eigen/Geometry>

#include "host/io/calibration_file.hpp"
#include "host/ros2/time.hpp"

namespace groma::ros2 {

namespace {

constexpr std::uint64_t kDiagnosticsInterval_ns = kNsPerS;

Eigen::Isometry3d transform_of(const model::QuaternionPose& pose) {
  Eigen::Isometry3d out = Eigen::Isometry3d::Identity();
  out.linear() = Eigen::Quaterniond(pose.quaternion).normalized().toRotationMatrix();
  out.translation() = pose.position_m;
  return out;
}

void put_transform(CdrWriter& out, double t_s, std::string_view frame, std::string_view child,
                   const model::QuaternionPose& of) {
  put_header(out, t_s, frame);
  out.put(child);
  put_pose(out, of);  // translation, rotation
}

std::uint8_t diagnostic_level(filter::State state) {
  switch (state) {
    case filter::State::kTracking:
      return 0;  // OK
    case filter::State::kConverging:
    case filter::State::kDegraded:
      return 1;  // WARN
    default:
      return 2;  // ERROR
  }
}

// visualization_msgs/Marker
enum MarkerType : std::int32_t { kCube = 1, kLines = 5, kText = 9 };
enum MarkerAction : std::int32_t { kAdd = 0, kDeleteAll = 3 };

using Color = std::array<float, 4>;  // red, green, blue, opacity
constexpr Color kWhite{1.0F, 1.0F, 1.0F, 1.0F};
constexpr Color kGreen{0.2F, 1.0F, 0.2F, 1.0F};
constexpr Color kRed{1.0F, 0.2F, 0.2F, 1.0F};

struct Marker {
  std::string_view group;
  MarkerType type = kCube;
  MarkerAction action = kAdd;
  std::int32_t id = 0;
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  double size_m = 0.2;
  Color color = kWhite;
  std::uint32_t lifetime_s = 0;  // 0: for ever
  std::vector<Eigen::Vector3d> points;
  std::vector<Color> colors;  // of the points
  std::string text;
};

void put_color(CdrWriter& out, const Color& color) {
  for (const float part : color) out.put(part);
}

void put_marker(CdrWriter& out, double t_s, std::string_view frame, const Marker& marker) {
  put_header(out, t_s, frame);
  out.put(marker.group).put(marker.id);
  out.put(static_cast<std::int32_t>(marker.type)).put(static_cast<std::int32_t>(marker.action));
  put_pose(out, {.position_m = marker.position_m});
  put_vector(out, Eigen::Vector3d::Constant(marker.size_m));
  put_color(out, marker.color);
  out.put(static_cast<std::int32_t>(marker.lifetime_s)).put(std::uint32_t{0});
  out.put(false);  // frame_locked
  out.length(marker.points.size());
  for (const Eigen::Vector3d& point : marker.points) put_vector(out, point);
  out.length(marker.colors.size());
  for (const Color& color : marker.colors) put_color(out, color);
  out.put("");               // texture_resource
  put_header(out, 0.0, "");  // texture
  out.put("").length(0);
  out.length(0);                     // uv_coordinates
  out.put(marker.text).put("");      // mesh_resource
  out.put("").length(0).put(false);  // mesh_file, mesh_use_embedded_materials
}

std::string marker_array(std::span<const Marker> markers, double t_s, std::string_view frame) {
  CdrWriter out;
  out.length(markers.size());
  for (const Marker& marker : markers) put_marker(out, t_s, frame, marker);
  return out.message();
}

}  // namespace

void put_header(CdrWriter& out, double t_s, std::string_view frame) {
  const std::uint64_t ns = to_ns(t_s);
  out.put(static_cast<std::int32_t>(ns / kNsPerS)).put(static_cast<std::uint32_t>(ns % kNsPerS)).put(frame);
}

void put_vector(CdrWriter& out, const Eigen::Vector3d& of) {
  out.put(of.x()).put(of.y()).put(of.z());
}

void put_quaternion(CdrWriter& out, const Eigen::Vector4d& of) {
  out.put(of.x()).put(of.y()).put(of.z()).put(of.w());
}

void put_pose(CdrWriter& out, const model::QuaternionPose& pose) {
  put_vector(out, pose.position_m);
  put_quaternion(out, pose.quaternion);
}

void put_covariance(CdrWriter& out, const Covariance& of) {
  for (Eigen::Index row = 0; row < 6; ++row) {
    for (Eigen::Index column = 0; column < 6; ++column)
      out.put(row == column ? std::max(of(row, column), kLeastVariance) : of(row, column));
  }
}

Covariance planar_covariance(const std::optional<Eigen::Matrix3d>& known) {
  Covariance out = kUnknownVariance * Covariance::Identity();
  if (!known) return out;
  out.topLeftCorner<2, 2>() = known->topLeftCorner<2, 2>();
  out.block<2, 1>(0, 5) = known->block<2, 1>(0, 2);
  out.block<1, 2>(5, 0) = known->block<1, 2>(2, 0);
  out(5, 5) = (*known)(2, 2);
  return out;
}

void put_twist(CdrWriter& out, const Eigen::Vector3d& velocity, const Eigen::Matrix3d& covariance) {
  const bool is_known = velocity.allFinite() && covariance.allFinite();
  const Eigen::Vector3d shown = is_known ? velocity : Eigen::Vector3d::Zero();
  put_vector(out, {shown.x(), shown.y(), 0.0});
  put_vector(out, {0.0, 0.0, shown.z()});
  put_covariance(out, planar_covariance(is_known ? std::optional(covariance) : std::nullopt));
}

void LocalizationMessages::put(const Localization& at, const Write& write) {
  if (!has_timestamp(at.t_s)) return;
  if (has_transforms_ && at.odom) put_transforms(at, write);
  CdrWriter pose;
  put_header(pose, at.t_s, frames_.map);
  put_pose(pose, at.pose);
  put_covariance(pose, at.covariance);
  write(kPoseTopic, "geometry_msgs/msg/PoseWithCovarianceStamped", at.t_s, pose.message());
  CdrWriter odometry;
  put_header(odometry, at.t_s, frames_.map);
  odometry.put(frames_.base);
  put_pose(odometry, at.pose);
  put_covariance(odometry, at.covariance);
  put_twist(odometry, at.velocity, at.velocity_covariance);
  write(kOdometryTopic, "nav_msgs/msg/Odometry", at.t_s, odometry.message());
  put_diagnostics(at, write);
}

void LocalizationMessages::put_transforms(const Localization& at, const Write& write) const {
  const Eigen::Isometry3d map_to_odom = transform_of(at.pose) * transform_of(at.odom->pose).inverse();
  CdrWriter out;
  out.length(at.odom->is_integrated ? 2 : 1);
  put_transform(out, at.t_s + kTransformTolerance_s, frames_.map, frames_.odom,
                {map_to_odom.translation(), model::quaternion_of(map_to_odom.linear())});
  if (at.odom->is_integrated) put_transform(out, at.t_s, frames_.odom, frames_.base, at.odom->pose);
  write(kTransformTopic, "tf2_msgs/msg/TFMessage", at.t_s, out.message());
}

void LocalizationMessages::put_diagnostics(const Localization& at, const Write& write) {
  const std::uint64_t now_ns = to_ns(at.t_s);
  const std::pair state(at.state, at.reason);
  // A clock that was set back must not silence it.
  const bool is_due =
      now_ns >= next_diagnostics_ns_ || now_ns + kDiagnosticsInterval_ns < next_diagnostics_ns_;
  if (!is_due && state_ == state) return;
  next_diagnostics_ns_ = now_ns + kDiagnosticsInterval_ns;
  state_ = state;
  const std::string_view reason = filter::reason_name(at.reason);
  const auto sigma = [&](Eigen::Index axis) {
    return fmt::format("{:.4f}", std::sqrt(at.covariance(axis, axis)));
  };
  const Diagnostic diagnostic{
      diagnostic_level(at.state),
      std::string(kStateName),
      fmt::format("{}{}{}", filter::state_name(at.state), reason.empty() ? "" : ": ", reason),
      {{"sigma_x_m", sigma(0)}, {"sigma_y_m", sigma(1)}, {"sigma_yaw_rad", sigma(5)}}};
  write(kDiagnosticsTopic, "diagnostic_msgs/msg/DiagnosticArray", at.t_s,
        diagnostics_message(std::span(&diagnostic, 1), at.t_s));
}

std::string anchor_markers(const model::Calibration& calibration) {
  std::vector<Marker> markers{{.group = "", .action = kDeleteAll}};
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (!model::has_position(anchor)) continue;
    constexpr double kLabel_m = 0.3;
    const Color color = model::is_usable(anchor.verdict) ? kGreen : kRed;
    markers.push_back({.group = "anchors", .id = anchor.id, .position_m = anchor.position_m, .color = color});
    markers.push_back({.group = "names",
                       .type = kText,
                       .id = anchor.id,
                       .position_m = anchor.position_m + kLabel_m * Eigen::Vector3d::UnitZ(),
                       .size_m = kLabel_m,
                       .text = fmt::format("{} {}", anchor.id, io::word(anchor.verdict))});
  }
  return marker_array(markers, 0.0, calibration.frame);
}

std::string link_markers(std::span<const LinkLine> links, double t_s, std::string_view frame) {
  Marker lines{.group = "links", .type = kLines, .size_m = 0.03, .lifetime_s = 2};
  for (const LinkLine& link : links) {
    const auto share = static_cast<float>(link.used_share);
    lines.points.push_back(link.tag_m);
    lines.points.push_back(link.anchor_m);
    lines.colors.insert(lines.colors.end(), 2, Color{1.0F - share, share, 0.2F, 0.6F});
  }
  return marker_array(std::span(&lines, 1), t_s, frame);
}

std::string diagnostics_message(std::span<const Diagnostic> diagnostics, double t_s) {
  CdrWriter out;
  put_header(out, t_s, "");
  out.length(diagnostics.size());
  for (const Diagnostic& each : diagnostics) {
    out.put(each.level).put(each.name).put(each.message).put("groma");
    out.length(each.values.size());
    for (const auto& [key, value] : each.values) out.put(key).put(value);
  }
  return out.message();
}

}  // namespace groma::ros2
