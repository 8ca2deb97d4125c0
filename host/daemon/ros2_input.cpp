#include "host/daemon/ros2_input.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <utility>
#include <variant>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "host/io/error.hpp"
#include "host/model/geographic.hpp"
#include "host/ros2/schemas.hpp"

namespace groma::daemon {
namespace {

constexpr std::array<std::string_view, kRos2Kinds> kTypes{
    "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix",
    "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"};

ros2::MessageDefinition definition_of(Ros2Kind kind) {
  return {ros2_type(kind), ros2::schema_of(ros2_type(kind))};
}

// What is wrong with a message.
struct Refused : std::runtime_error {
  using std::runtime_error::runtime_error;
};

}  // namespace

std::string_view ros2_type(Ros2Kind kind) noexcept {
  return kTypes.at(static_cast<std::size_t>(kind));
}

// The fields of a message by their paths; throws Refused.
class Ros2Input::Fields {
 public:
  explicit Fields(const ros2::MessageValue& message) : message_(message) {}

  [[nodiscard]] double number(const std::string& path) const {
    const ros2::MessageValue& value = at(path);
    const auto* const whole = std::get_if<std::int64_t>(&value.content);
    const double number = whole != nullptr ? static_cast<double>(*whole) : std::get<double>(value.content);
    if (!std::isfinite(number)) throw Refused(path + " is not a finite number");
    return number;
  }
  [[nodiscard]] std::vector<double> numbers(const std::string& path) const {
    std::vector<double> out;
    for (const ros2::MessageValue& each : std::get<ros2::MessageValues>(at(path).content)) {
      out.push_back(std::get<double>(each.content));
      if (!std::isfinite(out.back())) throw Refused(path + " has a term that is not a finite number");
    }
    return out;
  }
  [[nodiscard]] const std::string& text(const std::string& path) const {
    return std::get<std::string>(at(path).content);
  }
  [[nodiscard]] double timestamp_s() const {
    const double sec = number("header.stamp.sec");
    if (sec <= 0.0) throw Refused("header.stamp is not a time since 1970; its publisher has to set it");
    return sec + 1e-9 * number("header.stamp.nanosec");
  }
  [[nodiscard]] Eigen::Vector3d vector(const std::string& path) const {
    return {number(path + ".x"), number(path + ".y"), number(path + ".z")};
  }
  [[nodiscard]] Eigen::Quaterniond quaternion(const std::string& path) const {
    const Eigen::Quaterniond read(number(path + ".w"), number(path + ".x"), number(path + ".y"),
                                  number(path + ".z"));
    constexpr double kMostError = 0.01;
    if (std::abs(read.norm() - 1.0) > kMostError) throw Refused(path + " is not a unit quaternion");
    return read.normalized();
  }
  void expect_frame(const std::string& path, const std::string& frame, std::string_view advice) const {
    const std::string& given = text(path);
    if (given != frame)
      throw Refused(fmt::format("{} is {}, not {}; {}", path, io::shown(given), io::shown(frame), advice));
  }

 private:
  [[nodiscard]] const ros2::MessageValue& at(const std::string& path) const {
    return *ros2::values_at(message_, *ros2::FieldPath::parse(path)).at(0);
  }

  const ros2::MessageValue& message_;
};

Ros2Input::Ros2Input(const Ros2Settings& settings)
    : settings_(settings),
      definitions_{definition_of(Ros2Kind::kOdometry), definition_of(Ros2Kind::kImu),
                   definition_of(Ros2Kind::kFix), definition_of(Ros2Kind::kPose),
                   definition_of(Ros2Kind::kInitialPose)} {}

std::string Ros2Input::take(Ros2Kind kind, std::string_view cdr) {
  try {
    std::string line = line_of(kind, cdr);
    if (!line.empty()) ++counters_.lines;
    return line;
  } catch (const Refused& refused) {
    ++counters_.refused;
    last_problem_ = fmt::format("{}: {}", ros2_type(kind), refused.what());
    return {};
  }
}

std::string Ros2Input::line_of(Ros2Kind kind, std::string_view cdr) {
  if (cdr.size() > kMaxMessage) throw Refused(fmt::format("it has {} bytes", cdr.size()));
  const auto message = definitions_.at(static_cast<std::size_t>(kind)).read(cdr);
  if (!message) throw Refused("its bytes are no such message");
  const Fields fields(*message);
  switch (kind) {
    case Ros2Kind::kOdometry:
      return odometry_line(fields);
    case Ros2Kind::kImu:
      return imu_line(fields);
    case Ros2Kind::kFix:
      return fix_line(fields);
    case Ros2Kind::kPose:
      return pose_line(fields, false);
    case Ros2Kind::kInitialPose:
      return pose_line(fields, true);
  }
  return {};
}

std::string Ros2Input::odometry_line(const Fields& fields) {
  fields.expect_frame("header.frame_id", settings_.odom_frame, "set ros2: odom_frame to it");
  fields.expect_frame("child_frame_id", settings_.base_frame, "set ros2: base_frame to it");
  const Eigen::Vector3d position_m = fields.vector("pose.pose.position");
  const Eigen::Quaterniond turned = fields.quaternion("pose.pose.orientation");
  const Eigen::Vector3d velocity(fields.number("twist.twist.linear.x"), fields.number("twist.twist.linear.y"),
                                 fields.number("twist.twist.angular.z"));
  // A robot whose wheels slip has a twist; one without any in its messages would seem to be stationary.
  constexpr double kMoved_m = 0.5;
  still_m_ = velocity.isZero(0.0) ? still_m_.value_or(position_m) : std::optional<Eigen::Vector3d>();
  if (still_m_ && (position_m - *still_m_).norm() > kMoved_m)
    throw Refused("its pose moves, but its twist is zero; its publisher has to fill in the twist");
  return fmt::format(
      "{{\"class\":\"ODOMETRY\",\"t_s\":{},\"vx_mps\":{},\"vy_mps\":{},\"omega_radps\":{},"
      "\"odom\":[{},{},{},{},{},{},{}]}}\n",
      fields.timestamp_s(), velocity.x(), velocity.y(), velocity.z(), position_m.x(), position_m.y(),
      position_m.z(), turned.x(), turned.y(), turned.z(), turned.w());
}

std::string Ros2Input::imu_line(const Fields& fields) {
  if (fields.number("angular_velocity_covariance[0]") == -1.0)
    throw Refused("it has no angular velocity, as its covariance says");
  return fmt::format("{{\"class\":\"IMU\",\"t_s\":{},\"omega_radps\":{}}}\n", fields.timestamp_s(),
                     fields.number("angular_velocity.z"));
}

std::string Ros2Input::fix_line(const Fields& fields) {
  if (fields.number("status.status") < 0.0) {
    ++counters_.without_fix;
    return {};
  }
  if (fields.number("position_covariance_type") == 0.0)
    throw Refused("position_covariance_type is 0, unknown; a fix needs a covariance");
  const model::Datum place{fields.number("latitude"), fields.number("longitude"), fields.number("altitude")};
  if (!model::is_on_earth(place)) throw Refused("latitude or longitude is beyond its range");
  const std::vector<double> terms = fields.numbers("position_covariance");
  const Eigen::Vector3d at_m = model::place_in_map(place, *settings_.datum);
  return fmt::format("{{\"class\":\"GNSS\",\"t_s\":{},\"x_m\":{},\"y_m\":{},\"covariance\":[{},{},{},{}]}}\n",
                     fields.timestamp_s(), at_m.x(), at_m.y(), terms[0], terms[1], terms[3], terms[4]);
}

std::string Ros2Input::pose_line(const Fields& fields, bool is_initial) const {
  fields.expect_frame("header.frame_id", map_frame_, "publish the pose in the map's frame");
  const Eigen::Vector3d at_m = fields.vector("pose.pose.position");
  const Eigen::Matrix3d turned = fields.quaternion("pose.pose.orientation").toRotationMatrix();
  const std::vector<double> terms = fields.numbers("pose.covariance");
  for (std::size_t axis : {0U, 1U, 5U}) {
    if (terms[7 * axis] <= 0.0) throw Refused(fmt::format("pose.covariance[{}] is not positive", 7 * axis));
  }
  // An initial pose holds at its arrival: the clock of the computer where someone clicked is not the robot's.
  const std::string head =
      is_initial ? "\"INITIAL_POSE\"" : fmt::format("\"ABSOLUTE_POSE\",\"t_s\":{}", fields.timestamp_s());
  return fmt::format(
      "{{\"class\":{},\"x_m\":{},\"y_m\":{},\"z_m\":{},\"roll_rad\":{},\"pitch_rad\":{},\"yaw_rad\":{},"
      "\"covariance\":[{}]}}\n",
      head, at_m.x(), at_m.y(), at_m.z(), std::atan2(turned(2, 1), turned(2, 2)),
      std::atan2(-turned(2, 0), std::hypot(turned(0, 0), turned(1, 0))),
      std::atan2(turned(1, 0), turned(0, 0)), fmt::join(terms, ","));
}

}  // namespace groma::daemon
