// The key `ros2` of the configuration.
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "host/model/geographic.hpp"

namespace groma::daemon {

struct Ros2Settings {
  // How the node announces itself to `ros2 node list`.
  enum class Graph : std::uint8_t { kOff, kHumble, kIron };

  std::uint32_t domain_id = 0;
  std::string name_space =
      "groma";  // of the topics pose, odometry, anchors and links; without slashes at its ends
  bool publishes_tf = true;
  Graph graph = Graph::kOff;
  std::string tf_topic = "/tf";
  std::string odom_frame = "odom";
  std::string base_frame = "base_link";
  // What the robot publishes; empty: not read.
  std::string odometry_topic;
  std::string imu_topic;
  std::string fix_topic;
  std::string pose_topic;
  std::string initialpose = "/initialpose";
  std::optional<model::Datum> datum;  // of the map's origin; given if fix_topic is
};

}  // namespace groma::daemon
