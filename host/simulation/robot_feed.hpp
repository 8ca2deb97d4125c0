// What the simulated robot tells of itself: odometry and pose priors as JSON lines, in the order of time.
#pragma once

#include <cstdint>
#include <string>

#include "firmware/sim/world/robot.hpp"

namespace groma::simulation {

class RobotFeed {
 public:
  // Keeps a reference to the robot. The first rows are those at or after from_s.
  explicit RobotFeed(const sim::Robot& robot, double from_s = 0.0);

  // Appends the lines due up to and at t_s. An odometry row goes out when it begins to hold: the robot's
  // drives keep to it for that long.
  void lines_until(double t_s, std::string& out);

 private:
  const sim::Robot& robot_;
  std::uint64_t next_odometry_;
  std::uint64_t next_prior_;
};

}  // namespace groma::simulation
