// Numbers of fields are those of schemas/foxglove.proto and schemas/groma_msgs.proto.
#include <fmt/format.h>
#include <fmt/ranges.h>

#include <array>
#include <cmath>
#include <string>
#include <utility>

#include <Eigen/Eigenvalues>

#include "host/convert/encoder.hpp"
#include "host/convert/proto_writer.hpp"
#include "host/convert/schemas.hpp"
#include "host/io/calibration_file.hpp"
#include "host/model/pose.hpp"

namespace groma::convert {

namespace {

using Color = std::array<double, 4>;  // red, green, blue, opacity
constexpr Color kGreen{0.2, 0.7, 0.3, 1.0};
constexpr Color kYellow{0.9, 0.75, 0.1, 1.0};
constexpr Color kRed{0.85, 0.2, 0.2, 1.0};
constexpr Color kBlue{0.15, 0.4, 0.85, 1.0};
constexpr Color kPaleBlue{0.15, 0.4, 0.85, 0.3};
constexpr Color kWhite{1.0, 1.0, 1.0, 1.0};

// Sizes in the scene, m.
constexpr double kAnchor_m = 0.2;
constexpr double kTag_m = 0.1;
constexpr double kText_m = 0.3;
constexpr double kArrow_m = 0.8;
constexpr double kEllipseHeight_m = 0.02;
// The ellipse contains 95 % of a normal distribution in the plane.
constexpr double kEllipseChi2 = 5.991;
constexpr std::uint64_t kEllipseInterval_ns = 100'000'000;

std::string timestamp(double t_s) {
  const std::uint64_t ns = ros2::to_ns(t_s);
  return ProtoWriter().integer(1, ns / ros2::kNsPerS).integer(2, ns % ros2::kNsPerS).message();
}

std::string vector3(const Eigen::Vector3d& of) {
  return ProtoWriter().number(1, of.x()).number(2, of.y()).number(3, of.z()).message();
}

std::string quaternion(const Eigen::Vector4d& of) {
  return ProtoWriter().number(1, of.x()).number(2, of.y()).number(3, of.z()).number(4, of.w()).message();
}

std::string pose(const model::QuaternionPose& of) {
  return ProtoWriter().bytes(1, vector3(of.position_m)).bytes(2, quaternion(of.quaternion)).message();
}

std::string color(const Color& of) {
  return ProtoWriter().number(1, of[0]).number(2, of[1]).number(3, of[2]).number(4, of[3]).message();
}

// The begin of a message with the fields timestamp and frame_id.
ProtoWriter in_frame(double t_s, std::string_view frame) {
  ProtoWriter out;
  out.bytes(1, timestamp(t_s)).bytes(2, frame);
  return out;
}

std::string cube(const Eigen::Vector3d& at_m, double size_m, const Color& of) {
  return ProtoWriter()
      .bytes(1, pose({at_m}))
      .bytes(2, vector3(Eigen::Vector3d::Constant(size_m)))
      .bytes(3, color(of))
      .message();
}

std::string text_above(const Eigen::Vector3d& at_m, const std::string& text) {
  return ProtoWriter()
      .bytes(1, pose({at_m + kText_m * Eigen::Vector3d::UnitZ()}))
      .integer(2, 1)  // faces the viewer
      .number(3, kText_m)
      .bytes(5, color(kWhite))
      .bytes(6, text)
      .message();
}

// Of an anchor's details in Foxglove; the live page draws the ellipse from it.
constexpr std::string_view kCovarianceKey = "covariance_m2";

Color color_of(model::AnchorVerdict verdict) {
  if (verdict == model::AnchorVerdict::kOk) return kGreen;
  return model::is_usable(verdict) ? kYellow : kRed;
}

std::string anchor_entity(double t_s, std::string_view frame, const model::AnchorCalibration& anchor) {
  std::string text = fmt::format("{}", anchor.id);
  if (anchor.verdict != model::AnchorVerdict::kOk) text += fmt::format(" {}", io::word(anchor.verdict));
  const Eigen::Matrix3d covariance_m2 = anchor.covariance.topLeftCorner<3, 3>();  // symmetric
  return in_frame(t_s, frame)
      .bytes(3, fmt::format("anchor {}", anchor.id))
      .bytes(6, ProtoWriter()
                    .bytes(1, kCovarianceKey)
                    .bytes(2, fmt::format("{:.4g}",
                                          fmt::join(covariance_m2.data(), covariance_m2.data() + 9, " ")))
                    .message())
      .bytes(8, cube(anchor.position_m, kAnchor_m, color_of(anchor.verdict)))
      .bytes(13, text_above(anchor.position_m, text))
      .message();
}

// An arrow from base_link forward, and the tags.
std::string robot_entity(double t_s, std::span<const model::Tag> tags) {
  constexpr double kHead_m = 0.3;
  ProtoWriter out = in_frame(t_s, kBaseFrame);
  out.bytes(3, "robot").integer(5, 1);  // frame_locked: it moves with its frame
  out.bytes(7, ProtoWriter()
                   .bytes(1, pose({}))
                   .number(2, kArrow_m - kHead_m)
                   .number(3, 0.1)
                   .number(4, kHead_m)
                   .number(5, 0.25)
                   .bytes(6, color(kBlue))
                   .message());
  for (const model::Tag& tag : tags) out.bytes(9, cube(tag.lever_arm_m, kTag_m, kBlue));  // spheres
  return out.message();
}

std::string ellipse_entity(const Estimate& estimate, std::string_view frame) {
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> axes(estimate.at.covariance.topLeftCorner<2, 2>());
  const Eigen::Vector2d size_m = 2.0 * (kEllipseChi2 * axes.eigenvalues().cwiseMax(0.0)).cwiseSqrt();
  const double angle_rad = std::atan2(axes.eigenvectors()(1, 0), axes.eigenvectors()(0, 0));
  const Eigen::Matrix3d turn = model::rotation_from_zyx(angle_rad, 0.0, 0.0);
  return in_frame(estimate.at.t_s, frame)
      .bytes(3, "uncertainty")
      .bytes(10, ProtoWriter()
                     .bytes(1, pose({estimate.at.pose.position_m, model::quaternion_of(turn)}))
                     .bytes(2, vector3(Eigen::Vector3d(size_m.x(), size_m.y(), kEllipseHeight_m)))
                     .number(3, 1.0)
                     .number(4, 1.0)
                     .bytes(5, color(kPaleBlue))
                     .message())
      .message();
}

std::string range_message(const model::RangeSample& range) {
  ProtoWriter out;
  const auto put_known = [&out](unsigned field, float value) {
    if (std::isfinite(value)) out.number(field, value);
  };
  out.number(1, range.t_s).integer(2, range.tag_id).integer(3, range.anchor_id).number(4, range.range_m);
  put_known(5, range.first_path_power_dbm);
  put_known(6, range.receive_power_dbm);
  put_known(7, range.clock_offset_ppm);
  put_known(8, range.noise);
  out.integer(9, static_cast<std::uint64_t>(range.line_of_sight)).integer(10, range.corrections);
  if (range.network_time_dtu != 0) out.integer(11, static_cast<std::uint64_t>(range.network_time_dtu));
  return out.message();
}

std::uint64_t log_level(filter::State state) {
  switch (state) {
    case filter::State::kDegraded:
      return 3;  // WARNING
    case filter::State::kLost:
    case filter::State::kUninitialized:
      return 4;  // ERROR
    default:
      return 2;  // INFO
  }
}

class FoxgloveEncoder final : public Encoder {
 public:
  FoxgloveEncoder(Write write, const Site& site) : Encoder(std::move(write)), site_(site) {}

  void put_site(double t_s, const model::Calibration& calibration) override {
    ProtoWriter scene;
    for (const model::AnchorCalibration& anchor : calibration.anchors) {
      if (model::has_position(anchor)) scene.bytes(2, anchor_entity(t_s, site_.frame, anchor));
    }
    scene.bytes(2, robot_entity(t_s, site_.tags));
    write("/groma/scene", "foxglove.SceneUpdate", t_s, scene.message());
  }

  void put(std::span<const model::RangeSample> ranges) override {
    const double t_s = ranges.back().t_s;
    ProtoWriter out;
    out.bytes(1, timestamp(t_s));
    for (const model::RangeSample& range : ranges) out.bytes(2, range_message(range));
    write("/groma/ranges", "groma_msgs.Ranges", t_s, out.message());
  }

  void put(const model::OdometrySample& sample) override {
    ProtoWriter out;
    out.bytes(1, timestamp(sample.t_s));
    out.number(2, sample.vx_mps).number(3, sample.vy_mps).number(4, sample.omega_radps);
    write("/groma/input/odometry", "groma_msgs.Odometry", sample.t_s, out.message());
  }

  void put(const InputPose& input) override {
    const bool is_prior = input.kind == InputPose::Kind::kPrior;
    write_pose(is_prior ? "/groma/input/pose_prior" : "/groma/input/absolute_pose", input.t_s, input.pose);
  }

  void put(const model::YawRateSample& sample) override {
    ProtoWriter out;
    out.bytes(1, timestamp(sample.t_s)).number(2, sample.omega_radps);
    write("/groma/input/imu", "groma_msgs.YawRate", sample.t_s, out.message());
  }

  void put(const model::PositionSample& sample) override {
    ProtoWriter out = in_frame(sample.t_s, site_.frame);
    out.number(3, sample.x_m).number(4, sample.y_m).numbers(5, sample.covariance_m2);
    write("/groma/input/gnss", "groma_msgs.Position", sample.t_s, out.message());
  }

  void put(const model::ZeroVelocitySample& sample) override {
    ProtoWriter out;
    out.bytes(1, timestamp(sample.t_s));
    write("/groma/input/zero_velocity", "groma_msgs.ZeroVelocity", sample.t_s, out.message());
  }

  void put(const Estimate& estimate) override {
    const double t_s = estimate.at.t_s;
    write("/tf", "foxglove.FrameTransform", t_s,
          in_frame(t_s, site_.frame)
              .bytes(3, kBaseFrame)
              .bytes(4, vector3(estimate.at.pose.position_m))
              .bytes(5, quaternion(estimate.at.pose.quaternion))
              .message());
    write_pose("/groma/pose", t_s, estimate.at.pose);
    write_estimate(estimate);
    if (ros2::to_ns(t_s) >= next_ellipse_ns_) {
      next_ellipse_ns_ = ros2::to_ns(t_s) + kEllipseInterval_ns;
      ProtoWriter scene;
      scene.bytes(2, ellipse_entity(estimate, site_.frame));
      write("/groma/uncertainty", "foxglove.SceneUpdate", t_s, scene.message());
    }
    write_change(estimate);
  }

 private:
  void write_pose(std::string_view topic, double t_s, const model::QuaternionPose& of) {
    ProtoWriter out = in_frame(t_s, site_.frame);
    out.bytes(3, pose(of));
    write(topic, "foxglove.PoseInFrame", t_s, out.message());
  }

  void write_estimate(const Estimate& estimate) {
    ProtoWriter out = in_frame(estimate.at.t_s, site_.frame);
    const Eigen::Vector3d& at_m = estimate.at.pose.position_m;
    out.number(3, at_m.x()).number(4, at_m.y()).number(5, at_m.z());
    out.number(6, estimate.roll_rad).number(7, estimate.pitch_rad).number(8, estimate.yaw_rad);
    // Symmetric: the order of rows and columns does not matter.
    out.numbers(9, {estimate.at.covariance.data(), static_cast<std::size_t>(estimate.at.covariance.size())});
    out.bytes(10, filter::state_name(estimate.at.state)).bytes(11, filter::reason_name(estimate.at.reason));
    write("/groma/estimate", "groma_msgs.Estimate", estimate.at.t_s, out.message());
  }

  // A line of the log where the state or its reason changes.
  void write_change(const Estimate& estimate) {
    if (is_logged_ && estimate.at.state == state_ && estimate.at.reason == reason_) return;
    is_logged_ = true;
    state_ = estimate.at.state;
    reason_ = estimate.at.reason;
    std::string text(filter::state_name(state_));
    if (reason_ != filter::Reason::kNone) text += fmt::format(": {}", filter::reason_name(reason_));
    ProtoWriter out;
    out.bytes(1, timestamp(estimate.at.t_s)).integer(2, log_level(state_)).bytes(3, text).bytes(4, "groma");
    write("/groma/log", "foxglove.Log", estimate.at.t_s, out.message());
  }

  Site site_;
  std::uint64_t next_ellipse_ns_ = 0;
  bool is_logged_ = false;
  filter::State state_ = filter::State::kUninitialized;
  filter::Reason reason_ = filter::Reason::kNone;
};

}  // namespace

std::unique_ptr<Encoder> make_foxglove_encoder(Write write, const Site& site) {
  return std::make_unique<FoxgloveEncoder>(std::move(write), site);
}

std::uint16_t add_foxglove_channel(mcap::Writer& writer, std::string_view topic, std::string_view schema) {
  return writer.add_channel(topic, "protobuf", {schema, "protobuf", protobuf_schemas()});
}

}  // namespace groma::convert
