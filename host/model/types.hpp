// Inputs of the estimators: plain values, SI units, radians, REP-103 axes.
#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <string_view>
#include <tuple>
#include <type_traits>
#include <variant>
#include <vector>

#include <Eigen/Core>

namespace groma::model {

// Anchors and tags share one number space of 16 bits.
using NodeId = std::uint16_t;

[[nodiscard]] constexpr double square(double x) noexcept {
  return x * x;
}

inline constexpr float kUnknown = std::numeric_limits<float>::quiet_NaN();

// A hint from the first path's power relative to the total power and from the distance between the first and
// the strongest path. The wire and files use these numbers.
enum class LineOfSight : std::uint8_t { kNotKnown, kLikely, kUncertain, kUnlikely };

// Corrections that were applied to a range: bits, as on the wire and in files.
inline constexpr std::uint8_t kAntennaDelaysApplied = 4;
inline constexpr std::uint8_t kTemperatureCorrected = 8;
inline constexpr std::uint8_t kSupplyCorrected = 16;
inline constexpr std::uint8_t kPowerBiasCorrected = 32;

// One two-way range between an onboard tag and an anchor.
struct RangeSample {
  double t_s = 0.0;  // time of the measurement, not of its arrival
  NodeId tag_id = 0;
  NodeId anchor_id = 0;
  double range_m = 0.0;  // antenna delays applied, pair bias not
  float first_path_power_dbm = kUnknown;
  float receive_power_dbm = kUnknown;
  float clock_offset_ppm = kUnknown;  // the anchor's clock against the tag's; positive: the anchor's is fast
  float noise = kUnknown;  // standard deviation of the channel's impulse response, the chip's units
  LineOfSight line_of_sight = LineOfSight::kNotKnown;
  std::uint8_t corrections = 0;
  // Time of the measurement in network time: ticks of 1/63.8976 GHz of the master's clock; 0: unknown.
  std::int64_t network_time_dtu = 0;
};

// Mean of two-way ranges between two anchors: antenna delays applied, pair bias not.
struct AnchorRange {
  NodeId anchor_id = 0;
  NodeId other_id = 0;
  double range_m = 0.0;
  double sigma_m = 0.0;  // of a single range
  std::size_t count = 1;
};

// Body velocity in base_link; holds from t_s until the next sample.
struct OdometrySample {
  double t_s = 0.0;
  double vx_mps = 0.0;
  double vy_mps = 0.0;
  double omega_radps = 0.0;
};

[[nodiscard]] inline bool is_finite(const OdometrySample& sample) noexcept {
  return std::isfinite(sample.t_s) && std::isfinite(sample.vx_mps) && std::isfinite(sample.vy_mps) &&
         std::isfinite(sample.omega_radps);
}

// The upper triangle of the covariance of x, y and yaw (m, rad): xx, xy, xt, yy, yt, tt.
using PoseCovariance = std::array<double, 6>;

// A pose of base_link in the map frame. If roll and pitch are unknown (NaN), yaw is the heading on the
// surface, R_WR = R_WT(x, y) R_z(yaw); if they are known, it is the ZYX yaw.
struct PoseSample {
  double t_s = 0.0;
  double x_m = 0.0;
  double y_m = 0.0;
  double z_m = 0.0;
  double yaw_rad = 0.0;
  double roll_rad = std::numeric_limits<double>::quiet_NaN();
  double pitch_rad = std::numeric_limits<double>::quiet_NaN();
  std::optional<PoseCovariance> covariance = std::nullopt;  // none: unknown
};

// A gyro's rate about base_link's z axis.
struct YawRateSample {
  double t_s = 0.0;
  double omega_radps = 0.0;
};

// An antenna's position in the map frame (GNSS), without height: the surface is more accurate.
struct PositionSample {
  double t_s = 0.0;
  double x_m = 0.0;
  double y_m = 0.0;
  std::array<double, 3> covariance_m2{};  // xx, xy, yy
};

// The robot is stationary.
struct ZeroVelocitySample {
  double t_s = 0.0;
};

// A sample of a sensor other than odometry and ranges; a pose comes from another localization system, with
// its covariance. Each sensor is registered here, and its name in files and reports below, in the same order.
using SensorSample = std::variant<YawRateSample, PositionSample, PoseSample, ZeroVelocitySample>;
inline constexpr std::size_t kSensors = std::variant_size_v<SensorSample>;
inline constexpr std::array<std::string_view, kSensors> kSensorNames{"imu", "gnss", "absolute_pose",
                                                                     "zero_velocity"};

// A sensor's index in that order.
template <class Sample>
inline constexpr std::size_t kSensorOf = [] {
  return []<class... Each>(const std::variant<Each...>* /*samples*/) {
    std::size_t at = 0;
    static_cast<void>((... || (std::is_same_v<Each, Sample> || (++at, false))));
    return at;
  }(static_cast<const SensorSample*>(nullptr));
}();

// The samples of each sensor: a tuple of vectors, in that order.
template <class Samples>
struct TablesOf;
template <class... Each>
struct TablesOf<std::variant<Each...>> {
  using Type = std::tuple<std::vector<Each>...>;
};
using SensorTables = TablesOf<SensorSample>::Type;
template <class Sample>
[[nodiscard]] const std::vector<Sample>& samples_of(const SensorTables& tables) noexcept {
  return std::get<kSensorOf<Sample>>(tables);
}
template <class Sample>
[[nodiscard]] std::vector<Sample>& samples_of(SensorTables& tables) noexcept {
  return std::get<kSensorOf<Sample>>(tables);
}

// std::visit for functions that must not throw; the variant holds a value.
template <std::size_t kAt = 0, class Variant, class Use>
auto visit(const Variant& variant, const Use& use) noexcept {
  if constexpr (kAt + 1 < std::variant_size_v<Variant>) {
    if (variant.index() != kAt) return visit<kAt + 1>(variant, use);
  }
  const auto* held = std::get_if<kAt>(&variant);
  if (held == nullptr) __builtin_unreachable();  // GCC 12 warns of a null pointer
  return use(*held);
}

[[nodiscard]] inline double time_of(const SensorSample& sample) noexcept {
  return model::visit(sample, [](const auto& of) { return of.t_s; });
}

// Configured properties of these sensors; none: not configured.
struct SensorDescription {
  std::optional<double> gyro_sigma_radps;  // white, per sample
  std::optional<double> gyro_bias_sigma_radps;
  std::optional<Eigen::Vector3d> gnss_lever_arm_m;  // of the antenna, in base_link
};

// An estimated planar pose: x, y and heading in the map frame, with their covariance in this order.
struct PlanarEstimate {
  double t_s = 0.0;
  double x_m = 0.0;
  double y_m = 0.0;
  double yaw_rad = 0.0;
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();
};

// An onboard tag: its antenna's lever arm in base_link.
struct Tag {
  NodeId id = 0;
  Eigen::Vector3d lever_arm_m = Eigen::Vector3d::Zero();
};

// A fixed anchor: its antenna's position in the map frame.
struct Anchor {
  NodeId id = 0;
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
};

// A Gaussian prior of one scalar.
struct ScalarPrior {
  double mean = 0.0;
  double sigma = 0.0;
};

// White noise of one odometry sample, constant over its interval. It excludes scale and yaw-rate bias.
// Defaults by hand; every data set and configuration may set them, and the filter estimates the noise from
// the samples.
struct OdometryNoise {
  double sigma_vx_mps = 0.05;
  double sigma_vy_mps = 0.05;
  double sigma_omega_radps = 0.01;
  // Not white: of the relative error of the yaw rate, which lasts as long as a curve (wheelbase or track
  // width, slip of the wheels).
  double sigma_curve = 0.0;
};

}  // namespace groma::model
