#include "host/simulation/robot_feed.hpp"

#include <gtest/gtest.h>

#include <string>
#include <variant>

#include "firmware/sim/world/world.hpp"
#include "host/daemon/robot_input.hpp"
#include "test/host/simulation/small_site.hpp"

namespace groma::simulation {
namespace {

TEST(RobotFeed, SendsEverySampleOnceExactlyAndInOrderOfTime) {
  const sim::World world(small_site(), 1);
  const sim::Robot& robot = world.robot();
  RobotFeed feed(robot);
  daemon::RobotInput input;
  std::uint64_t odometry = 0;
  std::uint64_t priors = 0;
  double last_s = 0.0;
  for (double t_s = 0.0; t_s < 3.0; t_s += 0.0137) {
    std::string lines;
    feed.lines_until(t_s, lines);
    input.push({reinterpret_cast<const std::uint8_t*>(lines.data()), lines.size()});
    while (const auto message = input.next()) {
      double row_s = 0.0;
      if (const auto* row = std::get_if<model::OdometrySample>(&*message)) {
        const model::OdometrySample wanted = robot.odometry(odometry++);
        EXPECT_EQ(row->t_s, wanted.t_s);
        EXPECT_EQ(row->vx_mps, wanted.vx_mps);
        EXPECT_EQ(row->omega_radps, wanted.omega_radps);
        row_s = row->t_s;
      } else {
        const auto& pose = std::get<model::PoseSample>(*message);
        const model::PoseSample wanted = robot.pose_prior(priors++);
        EXPECT_EQ(pose.t_s, wanted.t_s);
        EXPECT_EQ(pose.x_m, wanted.x_m);
        EXPECT_EQ(pose.yaw_rad, wanted.yaw_rad);
        row_s = pose.t_s;
      }
      EXPECT_GE(row_s, last_s);
      EXPECT_LE(row_s, t_s);
      last_s = row_s;
    }
  }
  EXPECT_EQ(odometry, 150U);
  EXPECT_EQ(priors, 30U);
  EXPECT_EQ(input.counters().dropped(), 0U);
}

TEST(RobotFeed, StartsAtTheGivenTime) {
  const sim::World world(small_site(), 1);
  RobotFeed feed(world.robot(), 2.0);
  std::string lines;
  feed.lines_until(1.99, lines);
  EXPECT_TRUE(lines.empty());
  feed.lines_until(2.0, lines);
  EXPECT_NE(lines.find("\"t_s\":2,"), std::string::npos) << lines;
}

}  // namespace
}  // namespace groma::simulation
