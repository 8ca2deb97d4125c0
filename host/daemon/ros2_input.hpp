// What a robot publishes on ROS 2, as lines of robot_input.hpp: so it is captured and replayed as they are.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <utility>

#include <Eigen/Core>

#include "host/daemon/ros2_settings.hpp"
#include "host/ros2/message.hpp"

namespace groma::daemon {

enum class Ros2Kind : std::uint8_t { kOdometry, kImu, kFix, kPose, kInitialPose };
inline constexpr std::size_t kRos2Kinds = 5;
// "nav_msgs/msg/Odometry" and so on.
[[nodiscard]] std::string_view ros2_type(Ros2Kind kind) noexcept;

class Ros2Input {
 public:
  // A longer message is refused: none of these types needs as much.
  static constexpr std::size_t kMaxMessage = 16'384;

  struct Counters {
    std::uint64_t lines = 0;
    std::uint64_t refused = 0;
    std::uint64_t without_fix = 0;  // of satellites
  };

  explicit Ros2Input(const Ros2Settings& settings);

  // The map's frame, in which poses have to be.
  void set_map_frame(std::string frame) { map_frame_ = std::move(frame); }

  // The line of a message (CDR); empty: it was refused, or has no fix.
  [[nodiscard]] std::string take(Ros2Kind kind, std::string_view cdr);

  [[nodiscard]] const Counters& counters() const noexcept { return counters_; }
  // Why the last message was refused, and what to do.
  [[nodiscard]] const std::string& last_problem() const noexcept { return last_problem_; }

 private:
  class Fields;

  [[nodiscard]] std::string line_of(Ros2Kind kind, std::string_view cdr);
  [[nodiscard]] std::string odometry_line(const Fields& fields);
  [[nodiscard]] static std::string imu_line(const Fields& fields);
  [[nodiscard]] std::string fix_line(const Fields& fields);
  [[nodiscard]] std::string pose_line(const Fields& fields, bool is_initial) const;

  Ros2Settings settings_;
  std::string map_frame_ = "map";
  std::array<ros2::MessageDefinition, kRos2Kinds> definitions_;
  std::optional<Eigen::Vector3d> still_m_;  // odometry's pose since its twist is zero
  Counters counters_;
  std::string last_problem_;
};

}  // namespace groma::daemon
