// The simulated robot's odometry and pose priors as JSON lines, in order of time.
#pragma once

#include <cstdint>
#include <string>

#include "firmware/sim/world/robot.hpp"

namespace groma::simulation {

class RobotFeed {
 public:
  // Keeps a reference to the robot. The first samples are those at or after from_s.
  explicit RobotFeed(const sim::Robot& robot, double from_s = 0.0);

  // Appends the lines due up to and including t_s. An odometry sample is sent at the start of its interval,
  // over which the robot's drives keep its velocity.
  void lines_until(double t_s, std::string& out);

 private:
  const sim::Robot& robot_;
  std::uint64_t next_odometry_;
  std::uint64_t next_prior_;
};

}  // namespace groma::simulation
