#include "host/daemon/robot_input.hpp"

#include <fmt/format.h>

#include <array>
#include <cmath>
#include <cstddef>
#include <utility>

#include <nlohmann/json.hpp>

#include "host/io/error.hpp"
#include "host/model/pose.hpp"

namespace groma::daemon {
namespace {

using InputJson = nlohmann::json;

// False unless the object has a finite number of that name.
bool read_number(const InputJson& object, const char* name, double& out) {
  const auto found = object.find(name);
  if (found == object.end() || !found->is_number()) return false;
  out = found->get<double>();
  return std::isfinite(out);
}

// False where it is there and cannot be one; what is null is not known.
bool read_covariance(const InputJson& object, std::optional<model::PoseCovariance>& out) {
  const auto found = object.find("covariance");
  if (found == object.end() || found->is_null()) return true;
  constexpr std::size_t kAxes = 6;
  constexpr std::array<std::size_t, 3> kPlanar{0, 1, 5};
  if (!found->is_array() || found->size() != kAxes * kAxes) return false;
  model::PoseCovariance covariance{};
  std::size_t known = 0;
  auto next = covariance.begin();
  for (std::size_t row = 0; row < kPlanar.size(); ++row) {
    for (std::size_t column = row; column < kPlanar.size(); ++column, ++next) {
      const InputJson& term = (*found)[kAxes * kPlanar[row] + kPlanar[column]];
      const InputJson& mirrored = (*found)[kAxes * kPlanar[column] + kPlanar[row]];
      if (term.is_null() && mirrored.is_null()) continue;
      if (!term.is_number() || term != mirrored) return false;
      *next = term.get<double>();
      ++known;
    }
  }
  if (known == 0) return true;
  if (known < covariance.size() || !model::is_covariance(covariance)) return false;
  out = covariance;
  return true;
}

}  // namespace

void RobotInput::push(std::span<const std::uint8_t> bytes) {
  waiting_.erase(0, read_);
  read_ = 0;
  waiting_.append(bytes.begin(), bytes.end());
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
  const InputJson object = InputJson::parse(line, nullptr, /*allow_exceptions=*/false);
  if (!object.is_object()) {
    drop(counters_.torn, fmt::format("no JSON object: {}", io::shown(line)));
    return std::nullopt;
  }
  const auto name = object.find("class");
  if (name != object.end() && *name == "ODOMETRY") {
    model::OdometrySample row;
    if (!read_number(object, "t_s", row.t_s) || !read_number(object, "vx_mps", row.vx_mps) ||
        !read_number(object, "vy_mps", row.vy_mps) || !read_number(object, "omega_radps", row.omega_radps)) {
      drop(counters_.bad_value,
           fmt::format("ODOMETRY needs finite t_s, vx_mps, vy_mps, omega_radps: {}", io::shown(line)));
      return std::nullopt;
    }
    ++counters_.odometry;
    return row;
  }
  if (name != object.end() && *name == "POSE_PRIOR") {
    model::PoseSample pose;
    bool good = read_number(object, "t_s", pose.t_s) && read_number(object, "x_m", pose.x_m) &&
                read_number(object, "y_m", pose.y_m) && read_number(object, "z_m", pose.z_m) &&
                read_number(object, "yaw_rad", pose.yaw_rad);
    for (const auto& [key, value] : {std::pair{"roll_rad", &pose.roll_rad}, {"pitch_rad", &pose.pitch_rad}}) {
      if (object.contains(key) && !object.at(key).is_null()) good = read_number(object, key, *value) && good;
    }
    if (!good) {
      drop(counters_.bad_value,
           fmt::format("POSE_PRIOR needs finite t_s, x_m, y_m, z_m, yaw_rad: {}", io::shown(line)));
      return std::nullopt;
    }
    if (!read_covariance(object, pose.covariance)) {
      drop(counters_.bad_value,
           fmt::format("POSE_PRIOR's covariance is not 36 terms that can be one: {}", io::shown(line)));
      return std::nullopt;
    }
    ++counters_.pose_priors;
    return pose;
  }
  drop(counters_.unknown_class, fmt::format("class is neither ODOMETRY nor POSE_PRIOR: {}", io::shown(line)));
  return std::nullopt;
}

void RobotInput::drop(std::uint64_t& counter, std::string problem) {
  ++counter;
  last_problem_ = std::move(problem);
}

}  // namespace groma::daemon
