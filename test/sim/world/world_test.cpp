#include "firmware/sim/world/world.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

namespace groma::sim {
namespace {

Scenario scenario() {
  Scenario out;
  out.name = "test";
  out.materials = {{"brick", 9.0, 0.3, 10.0}};
  out.walls = {{{4.0, -3.0}, {4.0, 2.0}, 0.0, 3.0, 0}, {{-4.0, 8.0}, {12.0, 8.0}, 0.0, 5.0, 0}};
  for (std::uint16_t id = 10; id < 22; ++id) {
    out.anchors.push_back({id, {1.3 * (id - 10) - 2.0, id % 2 == 0 ? -2.0 : 7.0, 0.4 + 0.25 * (id - 10)}});
  }
  out.tags = {{1, {0.7, 0.4, 1.9}}, {2, {-0.7, -0.4, 1.2}}, {3, {0.6, -0.4, 0.35}}};
  out.biases = {{0.35, 0.45}, -0.4, 1.2, {1.0, 0.005}};
  out.drives = {{"first", {{0.0, 0.0, {}, 0.0}, {6.0, 0.0, {}, 0.0}, {6.0, 4.0, {}, 0.0}}},
                {"second", {{0.0, 4.0, {}, 0.0}, {0.0, 0.5, {}, 0.0}}}};
  return out;
}

TEST(World, IsReciprocalAtAnyTime) {
  const World world(scenario(), 1);
  for (double t = 0.0; t < 20.0; t += 0.37) {
    for (const auto& [a, b] :
         std::vector<std::pair<std::uint16_t, std::uint16_t>>{{1, 10}, {3, 15}, {10, 13}, {1, 2}}) {
      const Propagation there = world.between(a, b, t);
      const Propagation back = world.between(b, a, t);
      EXPECT_EQ(there.audible, back.audible);
      EXPECT_EQ(there.flight_m, back.flight_m);
      EXPECT_EQ(there.first_path_power_dbm, back.first_path_power_dbm);
    }
  }
}

TEST(World, AnswersDoNotDependOnEarlierQueries) {
  const World one(scenario(), 1);
  const World other(scenario(), 1);
  for (double t = 10.0; t > 0.0; t -= 0.7) (void)other.between(2, 12, t);
  for (const double t : {0.3, 4.0, 9.1})
    EXPECT_EQ(one.between(2, 11, t).flight_m, other.between(2, 11, t).flight_m);
}

TEST(World, FlightInLosIsTheBiasedDistance) {
  Scenario clear = scenario();
  clear.walls.clear();
  clear.climate.floor_reflection_loss_db.reset();
  const World world(clear, 3);
  for (const double t : {0.0, 3.3, 12.0}) {
    for (const model::Anchor& anchor : clear.anchors) {
      for (const model::Tag& tag : clear.tags) {
        const model::SurfacePose pose = world.robot().pose(t);
        const double distance_m =
            (pose.pose.position_m + pose.pose.rotation * tag.lever_arm_m - anchor.position_m).norm();
        const TrueBias bias = world.bias(tag.id, anchor.id);
        EXPECT_NEAR(world.between(tag.id, anchor.id, t).flight_m, bias.gamma * distance_m + bias.beta_m,
                    1e-12);
      }
    }
  }
}

TEST(World, BiasesHaveTheirStatisticsAndBounds) {
  const Scenario options = scenario();
  double sum = 0.0;
  double gammas = 0.0;
  double largest = -9.0;
  double smallest = 9.0;
  int count = 0;
  for (std::uint64_t seed = 0; seed < 100; ++seed) {
    const World world(options, seed);
    for (const model::Anchor& anchor : options.anchors) {
      for (const model::Tag& tag : options.tags) {
        const TrueBias bias = world.bias(tag.id, anchor.id);
        EXPECT_EQ(bias.beta_m, world.bias(anchor.id, tag.id).beta_m);
        sum += bias.beta_m;
        gammas += (bias.gamma - 1.0) * (bias.gamma - 1.0);
        largest = std::max(largest, bias.beta_m);
        smallest = std::min(smallest, bias.beta_m);
        ++count;
      }
    }
  }
  EXPECT_LE(largest, 1.2);
  EXPECT_GT(largest, 1.15);
  EXPECT_GE(smallest, -0.4);
  EXPECT_NEAR(sum / count, 0.36, 0.03);  // 0.35, shifted by the bounds
  EXPECT_NEAR(std::sqrt(gammas / count), 0.005, 0.0003);
}

TEST(World, NodesOfTheSameKindHaveNoBias) {
  const World world(scenario(), 1);
  EXPECT_EQ(world.bias(1, 2).beta_m, 0.0);
  EXPECT_EQ(world.bias(10, 11).gamma, 1.0);
}

TEST(World, UnknownIdsAreInaudible) {
  const World world(scenario(), 1);
  EXPECT_FALSE(world.between(1, 999, 0.0).audible);
  EXPECT_FALSE(world.between(1, 1, 0.0).audible);
  EXPECT_FALSE(world.antenna_m(999, 0.0));
}

TEST(World, DrivesFollowEachOtherWithAStop) {
  const World world(scenario(), 1);
  ASSERT_EQ(world.drives().size(), 2U);
  EXPECT_EQ(world.drives()[0].begin_s, 0.0);
  EXPECT_EQ(world.drives()[0].end_s, world.drives()[1].begin_s);
  EXPECT_EQ(world.drives()[1].end_s, world.robot().path().duration_s());
  const double change_s = world.drives()[0].end_s;
  EXPECT_NEAR(world.robot().truth(change_s).x_m, 6.0, 0.4);
  const BodyVelocity before = world.robot().velocity(change_s - 0.5);
  EXPECT_LT(std::hypot(before.vx_mps, before.vy_mps), 1e-6);
}

}  // namespace
}  // namespace groma::sim
