// A type of Cyclone DDS whose samples are bytes: a message as it is on the wire, with its encapsulation
// header. So the messages of ROS 2 are encoded and read in one place (host/ros2), and what others send
// reaches no generated code. dds_write() takes a const std::string_view*, dds_take() fills a std::string.
#pragma once

#include <dds/dds.h>

#include <string>

namespace groma::dds {

// Creates a topic without a key whose representation is XCDR1. type: such as
// "nav_msgs::msg::dds_::Odometry_". Returns the topic, or an error of DDS.
[[nodiscard]] dds_entity_t create_raw_topic(dds_entity_t participant, const std::string& name,
                                            const std::string& type);

}  // namespace groma::dds
