// The robot's input: JSON lines with odometry, pose priors and samples of other sensors.
//
//   {"class":"ODOMETRY","t_s":12.02,"vx_mps":0.8,"vy_mps":0.0,"omega_radps":0.1}
//   {"class":"STEERING","t_s":12.02,"speed_mps":0.8,"steering_rad":0.1}
//   {"class":"POSE_PRIOR","t_s":12.0,"x_m":1.0,"y_m":2.0,"z_m":0.0,"yaw_rad":0.5}
//   {"class":"IMU","t_s":12.01,"omega_radps":0.1}
//   {"class":"GNSS","t_s":12.0,"x_m":1.0,"y_m":2.0,"covariance":[1.0,0.0,0.0,1.0]}
//   {"class":"ABSOLUTE_POSE","t_s":12.0,"x_m":1.0,"y_m":2.0,"yaw_rad":0.5,"covariance":[...]}
//   {"class":"ZERO_VELOCITY","t_s":12.0}
//   {"class":"INITIAL_POSE","x_m":1.0,"y_m":2.0,"yaw_rad":0.5}
//
// STEERING is the odometry of a car-like vehicle. ODOMETRY may have "odom": base_link in the robot's frame
// odom, as x, y, z and a quaternion x, y, z, w; transforms for ROS 2 are based on it. A POSE_PRIOR starts the
// localization unless it has started; an INITIAL_POSE restarts it, now or at its t_s. A pose may have
// roll_rad and pitch_rad; yaw_rad is then the ZYX yaw. It may have a covariance as in the pose stream: 36
// numbers, row by row, of x, y, z, roll, pitch, yaw; null is unknown. Only x, y and yaw are used. An absolute
// pose requires a covariance and needs no z_m. The covariance of a GNSS position is that of x and y, row by
// row. Other keys are ignored.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <variant>

#include "host/model/odom_frame.hpp"
#include "host/model/state_archive.hpp"
#include "host/model/steering.hpp"
#include "host/model/types.hpp"

namespace groma::daemon {

// A pose from which the localization restarts.
struct InitialPose {
  model::PoseSample pose;
  bool is_now = false;  // without t_s: its time is that of its arrival
};

// A PoseSample is a pose prior; an absolute pose is a SensorSample.
using RobotMessage = std::variant<model::OdometrySample, model::SteeringSample, model::PoseSample,
                                  model::SensorSample, InitialPose>;

// Each line is counted in exactly one of these.
struct RobotInputCounters {
  std::uint64_t odometry = 0;       // and steering
  std::uint64_t pose_priors = 0;    // and initial poses
  std::uint64_t sensors = 0;        // the other classes
  std::uint64_t torn = 0;           // not a JSON object, or longer than kMaxLine bytes
  std::uint64_t unknown_class = 0;  // no "class", or an unknown one
  std::uint64_t bad_value = 0;      // a number is missing, not a number, not finite or not plausible

  [[nodiscard]] std::uint64_t dropped() const noexcept { return torn + unknown_class + bad_value; }
  RobotInputCounters& operator+=(const RobotInputCounters& other) noexcept;
};

class RobotInput {
 public:
  static constexpr std::size_t kMaxLine = 4096;
  // With at most this many bytes at once, valid lines are read without the heap.
  static constexpr std::size_t kReadSize = 4096;

  RobotInput();

  // Appends bytes as they arrived. Then call next() until it returns nothing: it gives the messages of the
  // completed lines.
  void push(std::span<const std::uint8_t> bytes);
  [[nodiscard]] std::optional<RobotMessage> next();

  // What the last odometry sample of next() had as "odom", with the sample's time.
  [[nodiscard]] const std::optional<model::OdomPose>& odom_pose() const noexcept { return odom_; }

  // Discards an incomplete line, after the link was reopened.
  void reset();

  void archive(model::StateArchive& state) {
    state(waiting_, read_, too_long_, odom_, counters_, last_problem_);
  }

  [[nodiscard]] const RobotInputCounters& counters() const noexcept { return counters_; }
  // What was wrong with the last dropped line; empty if none was dropped.
  [[nodiscard]] const std::string& last_problem() const noexcept { return last_problem_; }

 private:
  [[nodiscard]] std::optional<RobotMessage> parse(std::string_view line);
  void drop(std::uint64_t& counter, std::string problem);

  std::string waiting_;
  std::size_t read_ = 0;   // bytes of waiting_ already parsed
  bool too_long_ = false;  // the incomplete line is discarded up to its end
  std::optional<model::OdomPose> odom_;
  RobotInputCounters counters_;
  std::string last_problem_;
};

}  // namespace groma::daemon
