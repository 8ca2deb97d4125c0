// A recording as messages of one format: what convert.cpp passes in order of time, and each format encodes.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <Eigen/Core>

#include "host/convert/convert.hpp"
#include "host/mcap/writer.hpp"
#include "host/model/calibration.hpp"
#include "host/model/pose.hpp"
#include "host/model/types.hpp"

namespace groma::convert {

inline constexpr std::string_view kBaseFrame = "base_link";

// What does not change during the recording.
struct Site {
  std::string frame;                    // of the map
  std::vector<model::Tag> tags;         // in base_link
  model::OdometryNoise odometry_noise;  // of each sample
  double gyro_sigma_radps = 0.0;
};

// A pose of base_link that was an input; placed on the surface.
struct InputPose {
  enum class Kind { kPrior, kAbsolute };
  Kind kind = Kind::kPrior;
  double t_s = 0.0;
  model::QuaternionPose pose;
  std::optional<model::PoseCovariance> covariance;  // none: unknown
};

// vx, vy and yaw rate, and their covariance.
[[nodiscard]] inline Eigen::Vector3d velocity_of(const model::OdometrySample& sample) noexcept {
  return {sample.vx_mps, sample.vy_mps, sample.omega_radps};
}
[[nodiscard]] inline Eigen::Matrix3d covariance_of(const model::OdometryNoise& noise) noexcept {
  return Eigen::Vector3d(noise.sigma_vx_mps, noise.sigma_vy_mps, noise.sigma_omega_radps)
      .cwiseAbs2()
      .asDiagonal();
}

// Receives a message: its topic, which is a literal, its schema's name, its time and its bytes.
using Write = std::function<void(std::string_view topic, std::string_view schema, double t_s,
                                 std::string_view message)>;

class Encoder {
 public:
  virtual ~Encoder() = default;
  Encoder(const Encoder&) = delete;
  Encoder& operator=(const Encoder&) = delete;

  // Each t_s satisfies ros2::has_timestamp(). put_site() comes before the estimates that its calibration
  // gave.
  virtual void put_site(double t_s, const model::Calibration& calibration) = 0;
  // Of at most 50 ms, by time; not empty.
  virtual void put(std::span<const model::RangeSample> ranges) = 0;
  virtual void put(const model::OdometrySample& sample) = 0;
  virtual void put(const InputPose& pose) = 0;
  virtual void put(const model::YawRateSample& sample) = 0;
  virtual void put(const model::PositionSample& sample) = 0;
  virtual void put(const model::ZeroVelocitySample& sample) = 0;
  virtual void put(const Estimate& estimate) = 0;

 protected:
  explicit Encoder(Write write) : write_(std::move(write)) {}
  void write(std::string_view topic, std::string_view schema, double t_s, std::string_view message) const {
    write_(topic, schema, t_s, message);
  }

 private:
  Write write_;
};

// Protobuf messages with the schemas of Foxglove.
[[nodiscard]] std::unique_ptr<Encoder> make_foxglove_encoder(Write write, const Site& site);
[[nodiscard]] std::uint16_t add_foxglove_channel(mcap::Writer& writer, std::string_view topic,
                                                 std::string_view schema);
// Messages of ROS 2.
[[nodiscard]] std::unique_ptr<Encoder> make_ros2_encoder(Write write, const Site& site);
[[nodiscard]] std::uint16_t add_ros2_channel(mcap::Writer& writer, std::string_view topic,
                                             std::string_view schema);

}  // namespace groma::convert
