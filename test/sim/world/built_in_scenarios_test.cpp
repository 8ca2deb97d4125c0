#include "firmware/sim/world/built_in_scenarios.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "firmware/sim/world/world.hpp"

namespace groma::sim {
namespace {

// When the robot passes the gate, since the drive's begin.
std::vector<double> gate_times_s(const World& world, const DriveTime& drive) {
  constexpr double kGate_m = 20.75;
  std::vector<double> out;
  bool was_outside = false;
  for (double t_s = drive.begin_s; t_s < drive.end_s; t_s += 0.1) {
    const bool is_outside = world.robot().truth(t_s).x_m > kGate_m;
    if (is_outside != was_outside) out.push_back(t_s - drive.begin_s);
    was_outside = is_outside;
  }
  return out;
}

// "Between 90-235 s and 405-600 s the robot is operating outside the building."
TEST(PaperWarehouse, IsOutsideWhenThePapersRobotWas) {
  const Scenario scenario = paper_warehouse();
  const World world(scenario, 1);
  ASSERT_EQ(world.drives().size(), 3U);
  EXPECT_TRUE(gate_times_s(world, world.drives()[0]).empty());
  EXPECT_TRUE(gate_times_s(world, world.drives()[1]).empty());
  const DriveTime& outdoor = world.drives()[2];
  EXPECT_GT(outdoor.end_s - outdoor.begin_s, 600.0);
  const std::vector<double> times_s = gate_times_s(world, outdoor);
  const std::vector<double> expected_s{90.0, 235.0, 405.0, 600.0};
  ASSERT_EQ(times_s.size(), expected_s.size());
  for (std::size_t i = 0; i < times_s.size(); ++i) EXPECT_NEAR(times_s[i], expected_s[i], 3.0);
}

// The paper: 270 s in which the forklift "reverses multiple times to turn on the spot".
TEST(PaperForklift, DrivesAsLongAsThePapersAndReverses) {
  const Scenario scenario = paper_forklift();
  const World world(scenario, 1);
  ASSERT_EQ(world.drives().size(), 2U);
  EXPECT_NEAR(world.drives()[1].end_s - world.drives()[1].begin_s, 270.0, 5.0);
  EXPECT_GE(world.robot().path().gear_changes(), 6U);
  double backwards_m = 0.0;
  for (double t_s = world.drives()[1].begin_s; t_s < world.drives()[1].end_s; t_s += 0.05)
    backwards_m += 0.05 * std::max(0.0, -world.robot().velocity(t_s).vx_mps);
  EXPECT_GT(backwards_m, 30.0);
}

}  // namespace
}  // namespace groma::sim
