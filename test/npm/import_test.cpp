// groma import of recordings that others' packages write: @mcap/core, @foxglove/rosmsg2-serialization,
// sql.js.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/io/dataset.hpp"
#include "host/model/pose.hpp"
#include "host/ros2/schemas.hpp"
#include "test/npm/node.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"
#include "test/support/small_run.hpp"

namespace groma {
namespace {

using nlohmann::json;
using test::ChildResult;
using testing::HasSubstr;

// A driver's own message: all anchors of a tag at once, in mm, with a time in us.
constexpr const char* kUwbDefinition =
    "uint64 time_us\n"
    "uint8 tag\n"
    "uwb_driver/Distance[] distances\n"
    "================================================================================\n"
    "MSG: uwb_driver/Distance\n"
    "uint16 anchor\n"
    "float64 distance_mm\n";

constexpr const char* kMap =
    "schema: 1\n"
    "tags:\n"
    "  - {id: 1, lever_arm_m: [0.7, 0.4, 1.9]}\n"
    "  - {id: 2, lever_arm_m: [-0.7, -0.4, 0.5]}\n"
    "surface: {type: plane, z_m: 0.25, normal: [0, 0, 1]}\n"
    "range: {sigma_m: 0.08, beta_m: [0.2, 0.3], gamma: [1.0, 0.005]}\n"
    "sources:\n"
    "  - {topic: /odom, to: odometry}\n"
    "  - {topic: /amcl_pose, to: pose_prior}\n"
    "  - {topic: /imu, to: imu}\n"
    "  - topic: /uwb\n"
    "    to: ranges\n"
    "    columns: {t_s: time_us, tag_id: tag, anchor_id: 'distances[].anchor', range_m: "
    "'distances[].distance_mm'}\n"
    "    units: {time: us, length: mm}\n";

json header(double t_s) {
  const auto ns = static_cast<std::int64_t>(std::llround(t_s * 1e9));
  return {{"stamp", {{"sec", ns / 1'000'000'000}, {"nsec", ns % 1'000'000'000}}}, {"frame_id", "map"}};
}

json pose_of(const model::PoseSample& pose) {
  return {{"position", {{"x", pose.x_m}, {"y", pose.y_m}, {"z", pose.z_m}}},
          {"orientation",
           {{"x", 0.0}, {"y", 0.0}, {"z", std::sin(pose.yaw_rad / 2)}, {"w", std::cos(pose.yaw_rad / 2)}}}};
}

class NpmImport : public test::NpmTest {
 protected:
  NpmImport() {
    json topics = json::array();
    const auto topic = [&](const char* name, const std::string& type, std::string definition) -> json& {
      if (definition.empty()) definition = ros2::schema_of(type);
      topics.push_back(
          {{"name", name}, {"type", type}, {"definition", definition}, {"messages", json::array()}});
      return topics.back()["messages"];
    };
    const auto message = [](double t_s, json value) -> json {
      return {{"time_ns", std::to_string(std::llround(t_s * 1e9) + 5'000'000)}, {"value", std::move(value)}};
    };
    {
      json& odometry = topic("/odom", "nav_msgs/msg/Odometry", "");
      for (const model::OdometrySample& of : run_.odometry) {
        odometry.push_back(message(of.t_s, {{"header", header(of.t_s)},
                                            {"child_frame_id", "base_link"},
                                            {"twist",
                                             {{"twist",
                                               {{"linear", {{"x", of.vx_mps}, {"y", of.vy_mps}}},
                                                {"angular", {{"z", of.omega_radps}}}}}}}}));
      }
    }
    {
      json& poses = topic("/amcl_pose", "geometry_msgs/msg/PoseWithCovarianceStamped", "");
      for (const model::PoseSample& of : run_.pose_prior)
        poses.push_back(message(of.t_s, {{"header", header(of.t_s)}, {"pose", {{"pose", pose_of(of)}}}}));
    }
    {
      json& imu = topic("/imu", "sensor_msgs/msg/Imu", "");
      for (const model::OdometrySample& of : run_.odometry)
        imu.push_back(
            message(of.t_s, {{"header", header(of.t_s)}, {"angular_velocity", {{"z", of.omega_radps}}}}));
    }
    {
      json& ranges = topic("/uwb", "uwb_driver/msg/Distances", kUwbDefinition);
      for (const model::RangeSample& of : run_.ranges)
        ranges.push_back(message(
            of.t_s, {{"time_us", std::llround(of.t_s * 1e6)},
                     {"tag", of.tag_id},
                     {"distances", {{{"anchor", of.anchor_id}, {"distance_mm", 1000.0 * of.range_m}}}}}));
    }
    folder_.write("bag.json", json{{"topics", topics}}.dump());
    folder_.write("map.yaml", kMap);
  }

  void write_bag(const char* storage, const std::filesystem::path& path) const {
    const ChildResult result = test::run_child(
        {test::node(), test::kNpmFolder / "write_bag.mjs", storage, folder_ / "bag.json", path});
    ASSERT_EQ(result.exit_code, 0) << result.err;
  }
  [[nodiscard]] ChildResult import(const std::filesystem::path& bag, const char* map = "map.yaml") const {
    return test::run_child(
        {GROMA_EXECUTABLE, "import", "rosbag2", bag, "--map", folder_ / map, "-o", folder_ / "drive"});
  }
  void expect_drive() const {
    const io::Dataset drive = io::read_dataset(folder_ / "drive", {.sensors = true});
    ASSERT_EQ(drive.ranges.size(), run_.ranges.size());
    for (std::size_t i = 0; i < drive.ranges.size(); ++i) {
      EXPECT_NEAR(drive.ranges[i].t_s, run_.ranges[i].t_s, 1e-6);
      EXPECT_EQ(drive.ranges[i].tag_id, run_.ranges[i].tag_id);
      EXPECT_EQ(drive.ranges[i].anchor_id, run_.ranges[i].anchor_id);
      EXPECT_NEAR(drive.ranges[i].range_m, run_.ranges[i].range_m, 1e-12);
    }
    ASSERT_EQ(drive.odometry.size(), run_.odometry.size());
    for (std::size_t i = 0; i < drive.odometry.size(); ++i) {
      EXPECT_NEAR(drive.odometry[i].t_s, run_.odometry[i].t_s, 1e-9);
      EXPECT_EQ(drive.odometry[i].vx_mps, run_.odometry[i].vx_mps);
      EXPECT_EQ(drive.odometry[i].omega_radps, run_.odometry[i].omega_radps);
    }
    ASSERT_EQ(drive.pose_prior.size(), run_.pose_prior.size());
    for (std::size_t i = 0; i < drive.pose_prior.size(); ++i) {
      EXPECT_EQ(drive.pose_prior[i].x_m, run_.pose_prior[i].x_m);
      EXPECT_NEAR(model::wrap_angle(drive.pose_prior[i].yaw_rad - run_.pose_prior[i].yaw_rad), 0.0, 1e-12);
    }
    EXPECT_EQ(model::samples_of<model::YawRateSample>(drive.sensor_samples).size(), run_.odometry.size());
  }

  io::Dataset run_ = test::make_small_run(80.0, 1);
  test::ScratchFolder folder_;
};

TEST_F(NpmImport, ARecordingInMcapIsImportedAndCalibrated) {
  write_bag("mcap", folder_ / "bag.mcap");
  const ChildResult result = import(folder_ / "bag.mcap");
  EXPECT_EQ(result.exit_code, 0) << result.err;
  EXPECT_THAT(result.out,
              HasSubstr("ranges.csv: 7995 rows of /uwb, 0.000 to 79.940 s, tags 1,2, anchors 4,5,6,7,8,9"));
  expect_drive();
  const ChildResult calibrated =
      test::run_child({GROMA_EXECUTABLE, "calibrate", folder_ / "drive", "-o", folder_ / "calibration.yaml"});
  EXPECT_THAT(calibrated.exit_code, testing::AnyOf(0, 3)) << calibrated.err;
  const model::Calibration calibration = io::read_calibration(folder_ / "calibration.yaml");
  ASSERT_EQ(calibration.anchors.size(), run_.surveyed_anchors.size());
  for (std::size_t i = 0; i < calibration.anchors.size(); ++i) {
    if (calibration.anchors[i].verdict != model::AnchorVerdict::kOk) continue;
    EXPECT_LT((calibration.anchors[i].position_m - run_.surveyed_anchors[i].position_m).norm(), 0.5);
  }
}

TEST_F(NpmImport, ARecordingInSqliteIsImported) {
  std::filesystem::create_directory(folder_ / "bag");
  write_bag("sqlite", folder_ / "bag/bag_0.db3");
  const ChildResult undefined = import(folder_ / "bag");
  EXPECT_EQ(undefined.exit_code, 65);
  EXPECT_THAT(undefined.err, HasSubstr("does not define the type uwb_driver/msg/Distances of /uwb"));
  std::string definition = "    definition: |\n";
  std::istringstream lines(kUwbDefinition);
  for (std::string line; std::getline(lines, line);) definition += "      " + line + '\n';
  folder_.write("defined.yaml", kMap + definition);
  const ChildResult result = import(folder_ / "bag", "defined.yaml");
  EXPECT_EQ(result.exit_code, 0) << result.err;
  expect_drive();
}

TEST_F(NpmImport, ATornSqliteFileGivesWhatIsThere) {
  write_bag("sqlite", folder_ / "bag.db3");
  std::string definition = "    definition: |\n";
  std::istringstream lines(kUwbDefinition);
  for (std::string line; std::getline(lines, line);) definition += "      " + line + '\n';
  folder_.write("defined.yaml", kMap + definition);
  const std::string bytes = test::read_text(folder_ / "bag.db3");
  folder_.write("torn.db3", bytes.substr(0, bytes.size() * 99 / 100));
  const ChildResult result = import(folder_ / "torn.db3", "defined.yaml");
  EXPECT_EQ(result.exit_code, 3) << result.err;
  EXPECT_THAT(result.err, HasSubstr("the file is damaged or cut"));
  EXPECT_GT(io::read_dataset(folder_ / "drive").ranges.size(), run_.ranges.size() * 9 / 10);
  // Pages that lead to all others are missing.
  folder_.write("torn.db3", bytes.substr(0, bytes.size() / 2));
  const ChildResult half = import(folder_ / "torn.db3", "defined.yaml");
  EXPECT_EQ(half.exit_code, 65);
  EXPECT_THAT(half.err, HasSubstr("'sqlite3 FILE .recover' may save a damaged one"));
}

}  // namespace
}  // namespace groma
