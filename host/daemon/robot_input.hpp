// The robot's side of the input: JSON lines with odometry, pose priors and what other sensors tell.
//
//   {"class":"ODOMETRY","t_s":12.02,"vx_mps":0.8,"vy_mps":0.0,"omega_radps":0.1}
//   {"class":"POSE_PRIOR","t_s":12.0,"x_m":1.0,"y_m":2.0,"z_m":0.0,"yaw_rad":0.5}
//   {"class":"IMU","t_s":12.01,"omega_radps":0.1}
//   {"class":"GNSS","t_s":12.0,"x_m":1.0,"y_m":2.0,"covariance":[1.0,0.0,0.0,1.0]}
//   {"class":"ABSOLUTE_POSE","t_s":12.0,"x_m":1.0,"y_m":2.0,"yaw_rad":0.5,"covariance":[...]}
//   {"class":"ZERO_VELOCITY","t_s":12.0}
//
// A pose may also have roll_rad and pitch_rad; yaw_rad is then the ZYX yaw. And a covariance as the pose
// stream has it: 36 numbers, x, y, z, roll, pitch, yaw row by row, null where not known; those of x, y and
// yaw count. An absolute pose needs one, and no z_m. A GNSS position's is that of x and y, row by row. Other
// keys are left alone.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <variant>

#include "host/model/types.hpp"

namespace groma::daemon {

// A pose of its own is a prior.
using RobotMessage = std::variant<model::OdometrySample, model::PoseSample, model::SensorSample>;

// Each line is counted in exactly one of these.
struct RobotInputCounters {
  std::uint64_t odometry = 0;
  std::uint64_t pose_priors = 0;
  std::uint64_t sensors = 0;        // the other classes
  std::uint64_t torn = 0;           // no JSON object, or a line of more than kMaxLine bytes
  std::uint64_t unknown_class = 0;  // no "class", or none of these
  std::uint64_t bad_value = 0;      // a number is missing, is none, or is not finite

  [[nodiscard]] std::uint64_t dropped() const noexcept { return torn + unknown_class + bad_value; }
};

class RobotInput {
 public:
  static constexpr std::size_t kMaxLine = 4096;

  // Appends bytes as they arrived, then next() gives the messages of the lines they completed, until it gives
  // none.
  void push(std::span<const std::uint8_t> bytes);
  [[nodiscard]] std::optional<RobotMessage> next();

  // After the link was opened anew: a line begun is forgotten.
  void reset();

  [[nodiscard]] const RobotInputCounters& counters() const noexcept { return counters_; }
  // What was wrong with the line dropped last; empty if none was.
  [[nodiscard]] const std::string& last_problem() const noexcept { return last_problem_; }

 private:
  [[nodiscard]] std::optional<RobotMessage> parse(std::string_view line);
  void drop(std::uint64_t& counter, std::string problem);

  std::string waiting_;
  std::size_t read_ = 0;   // of waiting_
  bool too_long_ = false;  // the line begun is thrown away up to its end
  RobotInputCounters counters_;
  std::string last_problem_;
};

}  // namespace groma::daemon
