// ROS 2: the poses as topics, and what the robot publishes as one of its links.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <string_view>

#include "host/daemon/output.hpp"
#include "host/daemon/ros2_settings.hpp"
#include "host/link/reconnecting_link.hpp"
#include "host/model/types.hpp"

namespace groma::daemon {

struct Ros2Counters {
  std::uint64_t lines = 0;     // of the robot's messages
  std::uint64_t refused = 0;   // messages of the robot
  std::uint64_t left_out = 0;  // poses and messages, for lack of room
};

class Ros2 : public Output {
 public:
  // Poses that may wait for the node's thread; further ones are left out.
  static constexpr std::size_t kMaxPoses = 256;

  struct Opened {
    std::unique_ptr<Ros2> ros2;
    link::LinkError error;  // also if gromad was built without ROS 2
  };
  [[nodiscard]] static Opened open(const Ros2Settings& settings, std::span<const model::Tag> tags);
  ~Ros2() override;

  // "ros2:DOMAIN", the name of the link.
  [[nodiscard]] static std::string link_name(const Ros2Settings& settings) {
    return "ros2:" + std::to_string(settings.domain_id);
  }
  // The link of the robot's messages: lines of robot_input.hpp. Valid as long as this.
  [[nodiscard]] std::unique_ptr<link::ByteLink> make_link();

  [[nodiscard]] Ros2Counters counters() const;

  // Without the heap.
  void on_pose(const PoseEstimate& pose, std::string_view line) override;
  void on_line(std::string_view line) override;
  void on_calibration(const model::Calibration& calibration) override;

 private:
  class State;
  explicit Ros2(std::unique_ptr<State> state);
  std::unique_ptr<State> state_;
};

}  // namespace groma::daemon
