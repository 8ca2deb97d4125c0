#include "firmware/sim/world/scenario_file.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <string>

#include "firmware/sim/world/world.hpp"
#include "host/io/error.hpp"

namespace groma::sim {
namespace {

const std::string kSmall = R"(schema: 1
name: small
materials:
  - {name: brick, loss_db: 9, excess_m: 0.3}
walls:
  - {material: brick, top_m: 3, along_m: [[4, 0], [4, 5], [9, 5]]}
anchors:
  - {id: 12, position_m: [5, 1, 2]}
  - {id: 11, position_m: [0, 3, 2]}
tags:
  - {id: 1, lever_arm_m: [0.5, 0, 1]}
drives:
  - name: only
    waypoints:
      - {at_m: [0, 0]}
      - {at_m: [3, 0], stop_s: 1}
)";

std::string with(const std::string& from, const std::string& to) {
  std::string text = kSmall;
  const std::size_t at = text.find(from);
  EXPECT_NE(at, std::string::npos) << from;
  return text.replace(at, from.size(), to);
}

std::string error_of(const std::string& text) {
  try {
    (void)parse_scenario("site.yaml", text);
  } catch (const io::ConfigError& error) {
    return error.what();
  }
  return "no error";
}

TEST(ScenarioFile, ReadsACar) {
  const std::string car =
      with("drives:",
           "robot: {drive: car, wheelbase_m: 2, max_steering_rad: 0.6, corner_radius_m: 3}\n"
           "odometry: {sigma_steering_rad: 0.004, sigma_curve: 0.05, slips: [{at_s: 4, duration_s: 0.5, "
           "scale: 1.5}],"
           " areas: [{from_m: [1, -1], to_m: [2, 1], noise_factor: 3}]}\ndrives:");
  const Scenario scenario = parse_scenario("site.yaml", car);
  ASSERT_TRUE(scenario.odometry.car);
  EXPECT_EQ(scenario.path.drive, Drive::kCar);
  EXPECT_EQ(scenario.odometry.car->vehicle.wheelbase_m, 2.0);
  EXPECT_EQ(scenario.odometry.noise.sigma_omega_radps, 0.002);
  ASSERT_EQ(scenario.odometry.slips.size(), 1U);
  EXPECT_EQ(scenario.odometry.slips[0].to_s, 4.5);
  EXPECT_EQ(scenario.odometry.noise.sigma_curve, 0.05);
  ASSERT_EQ(scenario.odometry.areas.size(), 1U);
  EXPECT_EQ(scenario.odometry.areas[0].to_m, Eigen::Vector2d(2.0, 1.0));

  const std::string corner = "      - {at_m: [3, 0], stop_s: 1}\n";
  std::string tight = car;
  tight.replace(tight.find(corner), corner.size(), corner + "      - {at_m: [3, 4]}\n");
  EXPECT_THAT(error_of(tight), testing::HasSubstr("a radius of 1.50 m, but the car needs 2.92 m"));
  std::string back = car;
  back.replace(back.find(corner), corner.size(), corner + "      - {at_m: [-9, 0]}\n");
  EXPECT_EQ(error_of(back), "no error");
  std::string loop = car;
  loop.replace(loop.find("radius_m: 3"), 11, "radius_m: 3, loop: true");
  loop.replace(loop.find(corner), corner.size(),
               "      - {at_m: [20, 0]}\n      - {at_m: [10, 0]}\n      - {at_m: [10, 10]}\n      - {at_m: "
               "[0, 10]}\n");
  EXPECT_THAT(error_of(loop), testing::HasSubstr("reverse 1 times in a loop"));
  EXPECT_THAT(error_of(with("drives:", "robot: {wheelbase_m: 2}\ndrives:")),
              testing::HasSubstr("robot.wheelbase_m is for a car"));
  EXPECT_THAT(error_of(with("drives:", "robot: {drive: car, max_steering_rad: 30}\ndrives:")),
              testing::HasSubstr("robot.max_steering_rad is no steering angle"));
}

TEST(ScenarioFile, ReadsItsContent) {
  const Scenario scenario = parse_scenario("site.yaml", kSmall);
  EXPECT_EQ(scenario.name, "small");
  ASSERT_EQ(scenario.walls.size(), 2U);
  EXPECT_EQ(scenario.walls[1].from_m, Eigen::Vector2d(4.0, 5.0));
  EXPECT_EQ(scenario.walls[1].top_m, 3.0);
  ASSERT_EQ(scenario.anchors.size(), 2U);
  EXPECT_EQ(scenario.anchors[0].id, 11) << "sorted by id";
  EXPECT_EQ(scenario.drives[0].waypoints[1].stop_s, 1.0);
  EXPECT_EQ(scenario.radio.clock_ppm, RadioOptions{}.clock_ppm);
}

TEST(ScenarioFile, ErrorsNameLineAndColumn) {
  using ::testing::HasSubstr;
  EXPECT_THAT(error_of(with("name: small", "name: small\ncolour: red")),
              HasSubstr("site.yaml:3:1: unknown key"));
  EXPECT_THAT(error_of(with("excess_m: 0.3", "excess: 0.3")), HasSubstr("site.yaml:4:31: unknown key"));
  EXPECT_THAT(error_of(with("id: 11", "id: 12")), HasSubstr("site.yaml:9:10"));
  EXPECT_THAT(error_of(with("material: brick", "material: glass")), HasSubstr("site.yaml:6:16"));
  EXPECT_THAT(error_of(with("loss_db: 9", "loss_db: nine")), HasSubstr("site.yaml:4:28"));
  EXPECT_THAT(error_of(with("loss_db: 9", "loss_db: -9")), HasSubstr("site.yaml:4:28"));
  EXPECT_THAT(error_of(with("at_m: [3, 0]", "at_m: [0, 0]")), HasSubstr("site.yaml:16:16"));
  EXPECT_THAT(error_of(with("stop_s: 1", "yaw_rad: 1")), HasSubstr("omnidirectional"));
  EXPECT_THAT(error_of(with("schema: 1", "schema: 2")), HasSubstr("site.yaml:1:9"));
  EXPECT_THAT(error_of(with("name: small", "radio: {loss: 1}\nname: small")), HasSubstr("site.yaml:2:15"));
  EXPECT_THAT(error_of(with("name: small", "ground: {type: plane, normal: [0, 0, -1]}\nname: small")),
              HasSubstr("does not point up"));
  EXPECT_THAT(error_of(with("name: small\n", "name: small\nbiases: {beta_m: [2, 0.1]}\n")),
              HasSubstr("beta_bounds_m"));
  EXPECT_THAT(error_of("a: [1"), HasSubstr("site.yaml:"));
}

TEST(ScenarioFile, RanksBackUpsAsListedAndLeavesThemUnsetIfItListsNone) {
  const auto scheduled = [](const std::string& keys) {
    return with("name: small\n", "name: small\nschedule: {" + keys + "}\n");
  };
  EXPECT_FALSE(parse_scenario("s", kSmall).schedule.backup_ids);
  EXPECT_EQ(parse_scenario("s", kSmall).schedule.master_id, 11);
  const Scenario named = parse_scenario("s", scheduled("master_id: 12, backup_ids: [11]"));
  EXPECT_THAT(named.schedule.backup_ids.value(), ::testing::ElementsAre(11));
  EXPECT_THAT(parse_scenario("s", scheduled("backup_ids: []")).schedule.backup_ids.value(),
              ::testing::IsEmpty());
  EXPECT_THAT(error_of(scheduled("backup_ids: [11]")), ::testing::HasSubstr("has its rank already"));
  EXPECT_THAT(error_of(scheduled("backup_ids: [12, 12]")), ::testing::HasSubstr("has its rank already"));
  EXPECT_THAT(error_of(scheduled("backup_ids: [99]")), ::testing::HasSubstr("name one of the anchors"));
}

TEST(ScenarioFile, AMissingFileIsAnError) {
  EXPECT_THROW((void)read_scenario("/nowhere/site.yaml"), io::Error);
}

TEST(ScenarioFile, GroundsOfEachTypeAreRead) {
  const Scenario plane = parse_scenario(
      "s", with("name: small", "ground: {type: plane, z_m: 0.5, normal: [-0.1, 0, 1]}\nname: small"));
  EXPECT_NEAR(plane.ground.at(2.0, 9.0).z_m, 0.7, 1e-12);
  const Scenario spline =
      parse_scenario("s", with("name: small",
                               "ground: {type: bspline, origin_m: [0, 0], step_m: [1, 2], heights_m: "
                               "[[1,1,1,1,1],[1,1,1,1,1],[1,1,1,1,1],[1,1,1,1,1]]}\nname: small"));
  EXPECT_NEAR(spline.ground.at(0.4, 1.7).z_m, 1.0, 1e-12);
  const Scenario uneven = parse_scenario(
      "s", with("name: small",
                "ground: {type: uneven, origin_m: [-2, -2], step_m: [1, 1], size: [40, 20], areas: [{from_m: "
                "[10, 0], to_m: [30, 14], edge_m: 2, slope: [0.05, 0]}]}\nname: small"));
  EXPECT_NEAR(uneven.ground.at(4.0, 5.0).z_m, 0.0, 1e-12);
  EXPECT_NEAR(uneven.ground.at(20.0, 7.0).z_m, 0.5, 1e-9);
}

class ShippedScenario : public ::testing::TestWithParam<std::filesystem::path> {};

TEST_P(ShippedScenario, CanBeRead) {
  const Scenario scenario = read_scenario(GetParam());
  const World world(scenario, 1);
  EXPECT_GT(world.drives().front().end_s, 5.0);
}

std::vector<std::filesystem::path> shipped() {
  std::vector<std::filesystem::path> paths;
  for (const auto& entry : std::filesystem::directory_iterator(GROMA_SCENARIOS))
    paths.push_back(entry.path());
  std::sort(paths.begin(), paths.end());
  return paths;
}

INSTANTIATE_TEST_SUITE_P(All, ShippedScenario, ::testing::ValuesIn(shipped()),
                         [](const auto& scenario) { return scenario.param.stem().string(); });

// The properties that the demo promises of its world.
TEST(PaperHall, HasThePromisedDifficulty) {
  const Scenario scenario = read_scenario(std::filesystem::path(GROMA_SCENARIOS) / "paper_hall.yaml");
  EXPECT_EQ(scenario.anchors.size(), 12U);
  EXPECT_EQ(scenario.tags.size(), 3U);
  EXPECT_EQ(scenario.radio.clock_ppm, 20.0);
  EXPECT_EQ(scenario.radio.timestamp_sigma_ns, 0.1);
  EXPECT_EQ(scenario.radio.loss, 0.02);
  EXPECT_EQ(scenario.biases.beta_max_m, 1.2);

  double largest_beta_m = 0.0;
  for (std::uint64_t seed = 1; seed <= 5; ++seed) {
    const World world(scenario, seed);
    for (const model::Anchor& anchor : scenario.anchors) {
      for (const model::Tag& tag : scenario.tags) {
        largest_beta_m = std::max(largest_beta_m, world.bias(tag.id, anchor.id).beta_m);
      }
    }
  }
  EXPECT_GT(largest_beta_m, 1.0);

  const World world(scenario, 1);
  ASSERT_EQ(world.drives().size(), 2U);
  EXPECT_GE(world.drives()[0].end_s, 120.0);
  EXPECT_GE(world.drives()[1].end_s - world.drives()[1].begin_s, 180.0);

  for (const DriveTime& drive : world.drives()) {
    int audible = 0;
    int nlos = 0;
    double furthest_m = 0.0;
    double deepest_m = 0.0;
    for (double t = drive.begin_s; t < drive.end_s; t += 0.25) {
      furthest_m = std::max(furthest_m, world.robot().truth(t).x_m);
      deepest_m = std::min(deepest_m, world.robot().truth(t).z_m);
      for (const model::Anchor& anchor : scenario.anchors) {
        for (const model::Tag& tag : scenario.tags) {
          const Propagation path = world.between(tag.id, anchor.id, t);
          if (!path.audible) continue;
          ++audible;
          nlos += world.is_los(tag.id, anchor.id, t) ? 0 : 1;
        }
      }
    }
    const double share = static_cast<double>(nlos) / audible;
    EXPECT_GE(share, 0.10) << drive.name;
    EXPECT_LE(share, 0.20) << drive.name;
    const bool outside = drive.name == "yard";
    EXPECT_EQ(furthest_m > 25.0, outside);
    EXPECT_EQ(deepest_m < -0.02, outside);
  }
}

}  // namespace
}  // namespace groma::sim
