// Fields in the order of ros2_schemas.cpp.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "host/convert/cdr_writer.hpp"
#include "host/convert/encoder.hpp"
#include "host/convert/ros2_schemas.hpp"
#include "host/io/calibration_file.hpp"
#include "host/model/pose.hpp"

namespace groma::convert {

namespace {

using Covariance = Eigen::Matrix<double, 6, 6>;  // x, y, z and rotations about them

// Consumers invert covariances: a variance is neither zero nor NaN.
constexpr double kUnknownVariance = 1e6;
constexpr double kLeastVariance = 1e-9;

constexpr std::uint64_t kDiagnosticsInterval_ns = kNsPerS;

// The values of rmw_qos_profile_t, as rosbag2 records them. A late subscriber gets the last message of a
// latched topic.
std::string qos_profiles(bool is_latched) {
  constexpr std::string_view kInfinite = "{sec: 9223372036, nsec: 854775807}";
  return fmt::format(
      "- {{history: 1, depth: {}, reliability: 1, durability: {}, deadline: {}, lifespan: {}, liveliness: 1, "
      "liveliness_lease_duration: {}, avoid_ros_namespace_conventions: false}}\n",
      is_latched ? 1 : 10, is_latched ? 1 : 2, kInfinite, kInfinite, kInfinite);
}

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

void put_pose(CdrWriter& out, const Pose& pose) {
  put_vector(out, pose.position_m);
  put_quaternion(out, pose.quaternion);
}

void put_covariance(CdrWriter& out, const Covariance& of) {
  for (Eigen::Index row = 0; row < 6; ++row) {
    for (Eigen::Index column = 0; column < 6; ++column)
      out.put(row == column ? std::max(of(row, column), kLeastVariance) : of(row, column));
  }
}

// Of x, y and the rotation about z only; each is unknown without `known`.
Covariance planar_covariance(const std::optional<Eigen::Matrix3d>& known) {
  Covariance out = kUnknownVariance * Covariance::Identity();
  if (!known) return out;
  out.topLeftCorner<2, 2>() = known->topLeftCorner<2, 2>();
  out.block<2, 1>(0, 5) = known->block<2, 1>(0, 2);
  out.block<1, 2>(5, 0) = known->block<1, 2>(2, 0);
  out(5, 5) = (*known)(2, 2);
  return out;
}

void put_twist(CdrWriter& out, const model::OdometrySample& sample, const model::OdometryNoise& noise) {
  put_vector(out, {sample.vx_mps, sample.vy_mps, 0.0});
  put_vector(out, {0.0, 0.0, sample.omega_radps});
  const Eigen::Vector3d sigmas(noise.sigma_vx_mps, noise.sigma_vy_mps, noise.sigma_omega_radps);
  put_covariance(out, planar_covariance(Eigen::Matrix3d(sigmas.cwiseAbs2().asDiagonal())));
}

void put_range(CdrWriter& out, const model::RangeSample& range) {
  out.put(range.t_s).put(range.tag_id).put(range.anchor_id).put(range.range_m);
  out.put(range.first_path_power_dbm)
      .put(range.receive_power_dbm)
      .put(range.clock_offset_ppm)
      .put(range.noise);
  out.put(static_cast<std::uint8_t>(range.line_of_sight)).put(range.corrections).put(range.network_time_dtu);
}

// visualization_msgs/Marker
enum MarkerType : std::int32_t { kCube = 1, kText = 9 };

struct Marker {
  MarkerType type = kCube;
  std::int32_t id = 0;
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  double size_m = 0.2;
  bool is_usable = true;
  std::string text;
};

void put_marker(CdrWriter& out, double t_s, std::string_view frame, const Marker& marker) {
  constexpr float kFull = 1.0F;
  constexpr float kLow = 0.2F;
  put_header(out, t_s, frame);
  out.put(marker.type == kCube ? "anchors" : "names").put(marker.id);
  out.put(static_cast<std::int32_t>(marker.type)).put(std::int32_t{0});  // adds it
  put_pose(out, {marker.position_m});
  put_vector(out, Eigen::Vector3d::Constant(marker.size_m));
  const bool is_text = marker.type == kText;
  out.put(is_text || !marker.is_usable ? kFull : kLow).put(is_text || marker.is_usable ? kFull : kLow);
  out.put(is_text ? kFull : kLow).put(kFull);      // blue, opacity
  out.put(std::int32_t{0}).put(std::uint32_t{0});  // lifetime: for ever
  out.put(false);                                  // frame_locked
  out.length(0).length(0);                         // points, colors
  out.put("");                                     // texture_resource
  put_header(out, 0.0, "");                        // texture
  out.put("").length(0);
  out.length(0);                     // uv_coordinates
  out.put(marker.text).put("");      // mesh_resource
  out.put("").length(0).put(false);  // mesh_file, mesh_use_embedded_materials
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

class Ros2Encoder final : public Encoder {
 public:
  Ros2Encoder(mcap::Writer& writer, const Site& site) : Encoder(writer), site_(site) {}

  void put_site(double t_s) override {
    std::vector<Marker> markers;
    for (const model::AnchorCalibration& anchor : site_.calibration->anchors) {
      if (!model::has_position(anchor)) continue;
      constexpr double kLabel_m = 0.3;
      const bool is_usable = model::is_usable(anchor.verdict);
      markers.push_back({kCube, anchor.id, anchor.position_m, 0.2, is_usable, ""});
      markers.push_back({kText, anchor.id, anchor.position_m + kLabel_m * Eigen::Vector3d::UnitZ(), kLabel_m,
                         is_usable, fmt::format("{} {}", anchor.id, io::word(anchor.verdict))});
    }
    CdrWriter out;
    out.length(markers.size());
    for (const Marker& marker : markers) put_marker(out, t_s, site_.frame, marker);
    write(kAnchorsTopic, "visualization_msgs/msg/MarkerArray", t_s, out.message());
  }

  void put(std::span<const model::RangeSample> ranges) override {
    const double t_s = ranges.back().t_s;
    CdrWriter out;
    put_header(out, t_s, kBaseFrame);
    out.length(ranges.size());
    for (const model::RangeSample& range : ranges) put_range(out, range);
    write("/groma/ranges", "groma_msgs/msg/Ranges", t_s, out.message());
  }

  void put(const model::OdometrySample& sample) override {
    CdrWriter out;
    put_header(out, sample.t_s, kBaseFrame);
    put_twist(out, sample, site_.odometry_noise);
    write("/groma/input/odometry", "geometry_msgs/msg/TwistWithCovarianceStamped", sample.t_s, out.message());
  }

  void put(const InputPose& input) override {
    std::optional<Eigen::Matrix3d> known;
    if (input.covariance) known = model::to_matrix(*input.covariance);
    const bool is_prior = input.kind == InputPose::Kind::kPrior;
    write_pose(is_prior ? "/groma/input/pose_prior" : "/groma/input/absolute_pose", input.t_s, input.pose,
               planar_covariance(known));
  }

  void put(const model::YawRateSample& sample) override {
    CdrWriter out;
    put_header(out, sample.t_s, kBaseFrame);
    put_quaternion(out, Pose{}.quaternion);
    put_diagonal(out, {-1.0, 0.0, 0.0});  // no orientation
    put_vector(out, {0.0, 0.0, sample.omega_radps});
    put_diagonal(out, {kUnknownVariance, kUnknownVariance, model::square(site_.gyro_sigma_radps)});
    put_vector(out, Eigen::Vector3d::Zero());
    put_diagonal(out, {-1.0, 0.0, 0.0});  // no acceleration
    write("/groma/input/imu", "sensor_msgs/msg/Imu", sample.t_s, out.message());
  }

  void put(const model::PositionSample& sample) override {
    CdrWriter out;
    put_header(out, sample.t_s, site_.frame);
    out.put(sample.x_m).put(sample.y_m);
    for (const double term : sample.covariance_m2) out.put(term);
    write("/groma/input/gnss", "groma_msgs/msg/Position", sample.t_s, out.message());
  }

  void put(const model::ZeroVelocitySample& sample) override {
    CdrWriter out;
    put_header(out, sample.t_s, kBaseFrame);
    write("/groma/input/zero_velocity", "std_msgs/msg/Header", sample.t_s, out.message());
  }

  void put(const Estimate& estimate) override {
    write_transform(estimate);
    write_pose("/groma/pose", estimate.t_s, estimate.pose, estimate.covariance);
    CdrWriter out;
    put_header(out, estimate.t_s, site_.frame);
    out.put(kBaseFrame);
    put_pose(out, estimate.pose);
    put_covariance(out, estimate.covariance);
    put_twist(out, estimate.odometry, site_.odometry_noise);
    write("/groma/odometry", "nav_msgs/msg/Odometry", estimate.t_s, out.message());
    write_diagnostics(estimate);
  }

 protected:
  std::uint16_t add_channel(mcap::Writer& writer, std::string_view topic, std::string_view schema) override {
    const std::string profiles = qos_profiles(topic == kAnchorsTopic);
    return writer.add_channel(topic, "cdr", {schema, "ros2msg", ros2_schema(schema)},
                              {{"offered_qos_profiles", profiles}});
  }

 private:
  static constexpr std::string_view kAnchorsTopic = "/groma/anchors";

  static void put_diagonal(CdrWriter& out, const Eigen::Vector3d& diagonal) {
    const Eigen::Matrix3d matrix = diagonal.asDiagonal();
    for (const double term : matrix.reshaped()) out.put(term);
  }

  void write_pose(std::string_view topic, double t_s, const Pose& pose, const Covariance& covariance) {
    CdrWriter out;
    put_header(out, t_s, site_.frame);
    put_pose(out, pose);
    put_covariance(out, covariance);
    write(topic, "geometry_msgs/msg/PoseWithCovarianceStamped", t_s, out.message());
  }

  void write_transform(const Estimate& estimate) {
    CdrWriter out;
    out.length(1);
    put_header(out, estimate.t_s, site_.frame);
    out.put(kBaseFrame);
    put_pose(out, estimate.pose);  // translation, rotation
    write("/tf", "tf2_msgs/msg/TFMessage", estimate.t_s, out.message());
  }

  // Once a second, and where the state changes.
  void write_diagnostics(const Estimate& estimate) {
    const std::uint64_t now_ns = to_ns(estimate.t_s);
    if (now_ns < next_diagnostics_ns_ && estimate.state == state_ && estimate.reason == reason_) return;
    next_diagnostics_ns_ = now_ns + kDiagnosticsInterval_ns;
    state_ = estimate.state;
    reason_ = estimate.reason;
    const std::string_view reason = filter::reason_name(reason_);
    CdrWriter out;
    put_header(out, estimate.t_s, "");
    out.length(1).put(diagnostic_level(state_)).put("groma: localization");
    out.put(fmt::format("{}{}{}", filter::state_name(state_), reason.empty() ? "" : ": ", reason))
        .put("groma");
    const std::array<std::pair<const char*, double>, 3> sigmas{
        {{"sigma_x_m", estimate.covariance(0, 0)},
         {"sigma_y_m", estimate.covariance(1, 1)},
         {"sigma_yaw_rad", estimate.covariance(5, 5)}}};
    out.length(sigmas.size());
    for (const auto& [name, variance] : sigmas) out.put(name).put(fmt::format("{:.4f}", std::sqrt(variance)));
    write("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", estimate.t_s, out.message());
  }

  Site site_;
  std::uint64_t next_diagnostics_ns_ = 0;
  filter::State state_ = filter::State::kUninitialized;
  filter::Reason reason_ = filter::Reason::kNone;
};

}  // namespace

std::unique_ptr<Encoder> make_ros2_encoder(mcap::Writer& writer, const Site& site) {
  return std::make_unique<Ros2Encoder>(writer, site);
}

}  // namespace groma::convert
