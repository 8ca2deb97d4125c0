// In place of ros2.cpp, where there is no Cyclone DDS.
#include "host/daemon/ros2.hpp"

namespace groma::daemon {

class Ros2::State {};

Ros2::Ros2(std::unique_ptr<State> state) : state_(std::move(state)) {}
Ros2::~Ros2() = default;

Ros2::Opened Ros2::open(const Ros2Settings& /*settings*/, std::span<const model::Tag> /*tags*/) {
  return {
      nullptr,
      {link::LinkFault::kUnsuitable,
       "this gromad was built without ROS 2; install Debian's cyclonedds-dev and build it again, or remove "
       "'ros2' from the configuration"}};
}

Ros2Counters Ros2::counters() const {
  return {};
}
std::unique_ptr<link::ByteLink> Ros2::make_link() {
  return nullptr;
}
void Ros2::on_pose(const PoseEstimate& /*pose*/, std::string_view /*line*/) {}
void Ros2::on_line(std::string_view /*line*/) {}
void Ros2::on_calibration(const model::Calibration& /*calibration*/) {}

}  // namespace groma::daemon
