#include "host/daemon/robot_input.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <utility>

#include "host/daemon/json_view.hpp"
#include "host/io/error.hpp"
#include "host/model/plausible.hpp"
#include "host/model/pose.hpp"

namespace groma::daemon {
namespace {

// False if the object has no finite number of that name.
bool read_number(const JsonView& object, std::string_view name, double& out) {
  const auto member = object.find(name);
  const auto number = member ? member->number() : std::nullopt;
  out = number.value_or(out);
  return number.has_value();
}

// False if a covariance is given but invalid. Null terms are unknown: all six or none.
bool read_covariance(const JsonView& object, std::optional<model::PoseCovariance>& out) {
  const auto member = object.find("covariance");
  if (!member || member->is_null()) return true;
  constexpr std::size_t kAxes = 6;
  constexpr std::array<std::size_t, 3> kPlanar{0, 1, 5};
  std::array<double, kAxes * kAxes> terms{};
  if (!member->numbers(terms)) return false;
  model::PoseCovariance covariance{};
  std::size_t known = 0;
  auto next = covariance.begin();
  for (std::size_t row = 0; row < kPlanar.size(); ++row) {
    for (std::size_t column = row; column < kPlanar.size(); ++column, ++next) {
      const double term = terms.at(kAxes * kPlanar[row] + kPlanar[column]);
      const double mirrored = terms.at(kAxes * kPlanar[column] + kPlanar[row]);
      if (std::isnan(term) && std::isnan(mirrored)) continue;
      if (term != mirrored) return false;
      *next = term;
      ++known;
    }
  }
  if (known == 0) return true;
  if (known < covariance.size() || !model::is_covariance(covariance)) return false;
  out = covariance;
  return true;
}

// False if an odom pose is given but invalid.
bool read_odom(const JsonView& object, double t_s, std::optional<model::OdomPose>& out) {
  const auto member = object.find("odom");
  if (!member || member->is_null()) return true;
  std::array<double, 7> terms{};
  if (!member->numbers(terms) ||
      !std::all_of(terms.begin(), terms.end(), [](double term) { return std::isfinite(term); }))
    return false;
  model::OdomPose odom{.t_s = t_s};
  odom.pose.position_m = {terms[0], terms[1], terms[2]};
  odom.pose.quaternion = {terms[3], terms[4], terms[5], terms[6]};
  constexpr double kMostError = 0.01;
  if (std::abs(odom.pose.quaternion.norm() - 1.0) > kMostError) return false;
  odom.pose.quaternion.normalize();
  out = odom;
  return true;
}

std::optional<RobotMessage> read_odometry(const JsonView& object) {
  model::OdometrySample sample;
  if (!read_number(object, "t_s", sample.t_s) || !read_number(object, "vx_mps", sample.vx_mps) ||
      !read_number(object, "vy_mps", sample.vy_mps) ||
      !read_number(object, "omega_radps", sample.omega_radps)) {
    return std::nullopt;
  }
  return sample;
}

std::optional<RobotMessage> read_steering(const JsonView& object) {
  model::SteeringSample sample;
  if (!read_number(object, "t_s", sample.t_s) || !read_number(object, "speed_mps", sample.speed_mps) ||
      !read_number(object, "steering_rad", sample.steering_rad) ||
      std::abs(sample.steering_rad) > model::kMostSteering_rad) {
    return std::nullopt;
  }
  return sample;
}

// All keys except z_m and t_s.
bool read_place(const JsonView& object, model::PoseSample& out) {
  for (const auto& [key, value] : {std::pair{"roll_rad", &out.roll_rad}, {"pitch_rad", &out.pitch_rad}}) {
    const auto angle = object.find(key);
    if (angle && !angle->is_null() && !read_number(object, key, *value)) return false;
  }
  return read_number(object, "x_m", out.x_m) && read_number(object, "y_m", out.y_m) &&
         read_number(object, "yaw_rad", out.yaw_rad) && read_covariance(object, out.covariance);
}

bool read_pose(const JsonView& object, model::PoseSample& out) {
  return read_number(object, "t_s", out.t_s) && read_place(object, out);
}

std::optional<RobotMessage> read_pose_prior(const JsonView& object) {
  model::PoseSample pose;
  if (!read_pose(object, pose) || !read_number(object, "z_m", pose.z_m) || !model::is_plausible(pose))
    return std::nullopt;
  return pose;
}

std::optional<RobotMessage> read_initial_pose(const JsonView& object) {
  InitialPose initial;
  const auto time = object.find("t_s");
  initial.is_now = !time || time->is_null();
  if (!initial.is_now && !read_number(object, "t_s", initial.pose.t_s)) return std::nullopt;
  if (!read_place(object, initial.pose) || !model::is_plausible(initial.pose)) return std::nullopt;
  return initial;
}

std::optional<RobotMessage> read_absolute_pose(const JsonView& object) {
  model::PoseSample pose;
  if (!read_pose(object, pose) || !pose.covariance || !model::is_plausible(pose)) return std::nullopt;
  return model::SensorSample(pose);
}

std::optional<RobotMessage> read_imu(const JsonView& object) {
  model::YawRateSample sample;
  if (!read_number(object, "t_s", sample.t_s) || !read_number(object, "omega_radps", sample.omega_radps)) {
    return std::nullopt;
  }
  return model::SensorSample(sample);
}

std::optional<RobotMessage> read_gnss(const JsonView& object) {
  model::PositionSample sample;
  const auto covariance = object.find("covariance");
  std::array<double, 4> terms{};
  if (!read_number(object, "t_s", sample.t_s) || !read_number(object, "x_m", sample.x_m) ||
      !read_number(object, "y_m", sample.y_m) || !covariance || !covariance->numbers(terms)) {
    return std::nullopt;
  }
  sample.covariance_m2 = {terms[0], terms[1], terms[3]};
  // A null is NaN, and not plausible.
  if (terms[1] != terms[2] || !model::is_plausible(sample)) return std::nullopt;
  return model::SensorSample(sample);
}

std::optional<RobotMessage> read_zero_velocity(const JsonView& object) {
  model::ZeroVelocitySample sample;
  if (!read_number(object, "t_s", sample.t_s)) return std::nullopt;
  return model::SensorSample(sample);
}

struct MessageClass {
  std::string_view name;
  std::string_view needs;
  std::uint64_t RobotInputCounters::*counter;
  std::optional<RobotMessage> (*read)(const JsonView& object);
};

constexpr std::array<MessageClass, 8> kClasses{{
    {"ODOMETRY", "finite t_s, vx_mps, vy_mps, omega_radps; if given, a valid odom of 7 terms",
     &RobotInputCounters::odometry, read_odometry},
    {"STEERING", "finite t_s, speed_mps, and a steering_rad within 1.5", &RobotInputCounters::odometry,
     read_steering},
    {"POSE_PRIOR", "plausible t_s, x_m, y_m, z_m, yaw_rad; if given, a valid covariance of 36 terms",
     &RobotInputCounters::pose_priors, read_pose_prior},
    {"INITIAL_POSE", "plausible x_m, y_m, yaw_rad; if given, a valid covariance of 36 terms",
     &RobotInputCounters::pose_priors, read_initial_pose},
    {"IMU", "finite t_s, omega_radps", &RobotInputCounters::sensors, read_imu},
    {"GNSS", "plausible t_s, x_m, y_m, and a valid covariance of 4 terms", &RobotInputCounters::sensors,
     read_gnss},
    {"ABSOLUTE_POSE", "plausible t_s, x_m, y_m, yaw_rad, and a valid covariance of 36 terms",
     &RobotInputCounters::sensors, read_absolute_pose},
    {"ZERO_VELOCITY", "a finite t_s", &RobotInputCounters::sensors, read_zero_velocity},
}};

}  // namespace

RobotInputCounters& RobotInputCounters::operator+=(const RobotInputCounters& other) noexcept {
  odometry += other.odometry;
  pose_priors += other.pose_priors;
  sensors += other.sensors;
  torn += other.torn;
  unknown_class += other.unknown_class;
  bad_value += other.bad_value;
  return *this;
}

RobotInput::RobotInput() {
  waiting_.reserve(kMaxLine + kReadSize);
}

void RobotInput::push(std::span<const std::uint8_t> bytes) {
  waiting_.erase(0, read_);
  read_ = 0;
  waiting_.append(reinterpret_cast<const char*>(bytes.data()), bytes.size());
}

std::optional<RobotMessage> RobotInput::next() {
  while (true) {
    const std::size_t end = waiting_.find('\n', read_);
    if (end == std::string::npos) {
      if (waiting_.size() - read_ > kMaxLine) {
        waiting_.clear();
        read_ = 0;
        too_long_ = true;
      }
      return std::nullopt;
    }
    const std::string_view line(waiting_.data() + read_, end - read_);
    read_ = end + 1;
    if (std::exchange(too_long_, false) || line.size() > kMaxLine) {
      drop(counters_.torn, fmt::format("a line is longer than {} bytes", kMaxLine));
      continue;
    }
    if (line.find_first_not_of(" \t\r") == std::string_view::npos) continue;
    if (auto message = parse(line)) return message;
  }
}

void RobotInput::reset() {
  if (read_ < waiting_.size() || too_long_) drop(counters_.torn, "the link broke within a line");
  waiting_.clear();
  read_ = 0;
  too_long_ = false;
}

std::optional<RobotMessage> RobotInput::parse(std::string_view line) {
  const auto object = JsonView::parse(line);
  if (!object || !object->is_object()) {
    drop(counters_.torn, fmt::format("not a JSON object: {}", io::shown(line)));
    return std::nullopt;
  }
  const auto name = object->find("class");
  const auto known = std::find_if(kClasses.begin(), kClasses.end(),
                                  [&](const MessageClass& of) { return name && name->string() == of.name; });
  if (known == kClasses.end()) {
    drop(counters_.unknown_class, fmt::format("unknown class: {}", io::shown(line)));
    return std::nullopt;
  }
  std::optional<RobotMessage> message = known->read(*object);
  if (message && std::holds_alternative<model::OdometrySample>(*message)) {
    odom_.reset();
    if (!read_odom(*object, std::get<model::OdometrySample>(*message).t_s, odom_)) message.reset();
  }
  if (message) {
    ++(counters_.*known->counter);
  } else {
    drop(counters_.bad_value, fmt::format("{} needs {}: {}", known->name, known->needs, io::shown(line)));
  }
  return message;
}

void RobotInput::drop(std::uint64_t& counter, std::string problem) {
  ++counter;
  last_problem_ = std::move(problem);
}

}  // namespace groma::daemon
