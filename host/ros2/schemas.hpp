// Definitions of the ROS 2 messages that `groma convert --ros2` writes and `groma import` knows.
#pragma once

#include <string>
#include <string_view>

namespace groma::ros2 {

// The definition of a type, such as "nav_msgs/msg/Odometry", followed by those of all types that it contains:
// the schema of a channel with the schema encoding "ros2msg". Empty: the type is not known.
[[nodiscard]] std::string schema_of(std::string_view type);

}  // namespace groma::ros2
