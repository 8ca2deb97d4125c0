// Fields in the order of host/ros2/schemas.cpp.
#include <fmt/format.h>

#include <optional>
#include <string>
#include <utility>

#include "host/convert/encoder.hpp"
#include "host/model/pose.hpp"
#include "host/ros2/cdr_writer.hpp"
#include "host/ros2/messages.hpp"
#include "host/ros2/schemas.hpp"

namespace groma::convert {

namespace {

using ros2::CdrWriter;
using ros2::put_header;

// The values of rmw_qos_profile_t, as rosbag2 records them. A late subscriber gets the last message of a
// latched topic.
std::string qos_profiles(bool is_latched) {
  constexpr std::string_view kInfinite = "{sec: 9223372036, nsec: 854775807}";
  return fmt::format(
      "- {{history: 1, depth: {}, reliability: 1, durability: {}, deadline: {}, lifespan: {}, liveliness: 1, "
      "liveliness_lease_duration: {}, avoid_ros_namespace_conventions: false}}\n",
      is_latched ? 1 : 10, is_latched ? 1 : 2, kInfinite, kInfinite, kInfinite);
}

void put_range(CdrWriter& out, const model::RangeSample& range) {
  out.put(range.t_s).put(range.tag_id).put(range.anchor_id).put(range.range_m);
  out.put(range.first_path_power_dbm)
      .put(range.receive_power_dbm)
      .put(range.clock_offset_ppm)
      .put(range.noise);
  out.put(static_cast<std::uint8_t>(range.line_of_sight)).put(range.corrections).put(range.network_time_dtu);
}

class Ros2Encoder final : public Encoder {
 public:
  Ros2Encoder(Write write, const Site& site)
      : Encoder(std::move(write)), site_(site), messages_({.map = std::string(site.frame)}, true) {}

  void put_site(double t_s, const model::Calibration& calibration) override {
    write(ros2::kAnchorsTopic, "visualization_msgs/msg/MarkerArray", t_s, ros2::anchor_markers(calibration));
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
    ros2::put_twist(out, velocity_of(sample), covariance_of(site_.odometry_noise));
    write("/groma/input/odometry", "geometry_msgs/msg/TwistWithCovarianceStamped", sample.t_s, out.message());
  }

  void put(const InputPose& input) override {
    std::optional<Eigen::Matrix3d> known;
    if (input.covariance) known = model::to_matrix(*input.covariance);
    const bool is_prior = input.kind == InputPose::Kind::kPrior;
    CdrWriter out;
    put_header(out, input.t_s, site_.frame);
    ros2::put_pose(out, input.pose);
    ros2::put_covariance(out, ros2::planar_covariance(known));
    write(is_prior ? "/groma/input/pose_prior" : "/groma/input/absolute_pose",
          "geometry_msgs/msg/PoseWithCovarianceStamped", input.t_s, out.message());
  }

  void put(const model::YawRateSample& sample) override {
    CdrWriter out;
    put_header(out, sample.t_s, kBaseFrame);
    ros2::put_quaternion(out, model::QuaternionPose{}.quaternion);
    put_diagonal(out, {-1.0, 0.0, 0.0});  // no orientation
    ros2::put_vector(out, {0.0, 0.0, sample.omega_radps});
    put_diagonal(out,
                 {ros2::kUnknownVariance, ros2::kUnknownVariance, model::square(site_.gyro_sigma_radps)});
    ros2::put_vector(out, Eigen::Vector3d::Zero());
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
    messages_.put(estimate.at, [this](std::string_view topic, std::string_view type, double t_s,
                                      std::string_view cdr) { write(topic, type, t_s, cdr); });
  }

 private:
  static void put_diagonal(CdrWriter& out, const Eigen::Vector3d& diagonal) {
    const Eigen::Matrix3d matrix = diagonal.asDiagonal();
    for (const double term : matrix.reshaped()) out.put(term);
  }

  Site site_;
  ros2::LocalizationMessages messages_;
};

}  // namespace

std::unique_ptr<Encoder> make_ros2_encoder(Write write, const Site& site) {
  return std::make_unique<Ros2Encoder>(std::move(write), site);
}

std::uint16_t add_ros2_channel(mcap::Writer& writer, std::string_view topic, std::string_view schema) {
  const std::string profiles = qos_profiles(topic == ros2::kAnchorsTopic);
  return writer.add_channel(topic, "cdr", {schema, "ros2msg", ros2::schema_of(schema)},
                            {{"offered_qos_profiles", profiles}});
}

}  // namespace groma::convert
