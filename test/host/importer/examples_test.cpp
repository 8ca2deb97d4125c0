// The maps of examples/import on files of the layout that each is for, as it is published; the numbers are
// ours.
#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <functional>
#include <map>
#include <numbers>
#include <string>
#include <vector>

#include "host/importer/import.hpp"
#include "test/support/mat_bytes.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::importer {
namespace {

struct Example {
  std::vector<std::pair<std::string, std::string>> files;  // name, content
  std::function<void(const io::Dataset&)> expect;
  Format format = Format::kCsv;
};

void expect_range(const model::RangeSample& range, double t_s, int tag, int anchor, double range_m) {
  EXPECT_NEAR(range.t_s, t_s, 1e-6);
  EXPECT_EQ(range.tag_id, tag);
  EXPECT_EQ(range.anchor_id, anchor);
  EXPECT_EQ(range.range_m, range_m);
}

// A quaternion's heading of 2 atan2(0.6, 0.8).
const double kYaw_rad = 2.0 * std::atan2(0.6, 0.8);

Example starloc() {
  return {
      {{"uwb.csv",
        "time_s,to_id,range,from_id,x,y,z,w,rot_x,rot_y,rot_z,tag_pos_x,tag_pos_y,tag_pos_z,bias,gt_range\n"
        "0.02,9,5.61,1,-0.3,1.9,2.0,0.8,0,0,0.6,-0.1,2.0,2.1,-0.1,5.7\n"
        "0.12,12,3.31,1,-0.4,1.8,2.1,0.8,0,0,0.6,-0.1,2.0,2.1,-0.1,3.3\n"}},
      [](const io::Dataset& drive) {
        ASSERT_EQ(drive.ranges.size(), 2U);
        expect_range(drive.ranges[1], 0.12, 1, 12, 3.31);
        ASSERT_EQ(drive.ground_truth.size(), 2U);
        EXPECT_EQ(drive.ground_truth[1].x_m, -0.4);
        EXPECT_EQ(drive.ground_truth[1].z_m, 2.1);
        EXPECT_NEAR(drive.ground_truth[1].yaw_rad, kYaw_rad, 1e-12);
      }};
}

Example inrol() {
  return {{{"uwb.txt", "0 0.008 4 2.142\n1 0.018 5 1.939\n"},
           {"imu_pose.txt",
            "# timestamp tx ty tz qx qy qz qw\n0.02 -0.027 -0.023 0.696 0 0 0.6 0.8\n0.03 -0.028 -0.023 "
            "0.697 0 0 "
            "0.6 0.8\n"},
           {"anchor.txt",
            "# anchor_id tx ty tz qx qy qz qw\n3 -1.5 1.7 0.26 0.5 0.5 0.5 -0.5\n1 1.2 -2.3 0.3 0.5 0.5 0.5 "
            "-0.5\n"}},
          [](const io::Dataset& drive) {
            ASSERT_EQ(drive.ranges.size(), 2U);
            expect_range(drive.ranges[0], 0.008, 0, 4, 2.142);
            ASSERT_EQ(drive.ground_truth.size(), 2U);
            EXPECT_EQ(drive.ground_truth[0].z_m, 0.696);
            EXPECT_NEAR(drive.ground_truth[0].yaw_rad, kYaw_rad, 1e-12);
            ASSERT_EQ(drive.surveyed_anchors.size(), 2U);
            EXPECT_EQ(drive.surveyed_anchors[0].id, 1);
            EXPECT_EQ(drive.surveyed_anchors[1].position_m, Eigen::Vector3d(-1.5, 1.7, 0.26));
          }};
}

Example labyrinth() {
  return {{{"Indoor_UWB_Input.txt",
            "range2 0 2.95 0.04 -0.02 -0.01 105 0\nrange2 0.13 1.25 0.04 2.38 2.36 108 0\n"
            "odom2diff 0 0.35 0.4 0 0.0785 0.0001 0.0001 0.0001\n"}},
          [](const io::Dataset& drive) {
            ASSERT_EQ(drive.ranges.size(), 2U);
            expect_range(drive.ranges[1], 0.13, 0, 108, 1.25);
            ASSERT_EQ(drive.odometry.size(), 1U);
            EXPECT_DOUBLE_EQ(drive.odometry[0].vx_mps, 0.375);
            EXPECT_NEAR(drive.odometry[0].omega_radps, 0.05 / 0.157, 1e-12) << "a turn to the left";
          }};
}

Example lias() {
  std::string ranges;
  for (int row = 0; row < 2; ++row) {
    ranges += fmt::format("2022-08-15 9:42:24.{}5,", row);
    for (int i = 0; i < 24; ++i) ranges += fmt::format("{:.2f},", 1.0 + 0.01 * i + row);
    ranges += '\n';
  }
  // The body has z down, and is turned by 2 degrees about it.
  constexpr double kDegree = std::numbers::pi / 180.0;
  const std::string pose =
      fmt::format("0.25,1.5,0.96,0,{:.12f},{:.12f},0", std::cos(kDegree), std::sin(kDegree));
  return {{{"UWB_dynamic_exp_fast.csv", ranges},
           {"motion_capture_dynamic_exp_fast.csv",
            "time,x,y,z,rotation,,,\n2022-08-15 9:42:24.500," + pose + "\n"}},
          [](const io::Dataset& drive) {
            ASSERT_EQ(drive.ranges.size(), 48U);
            expect_range(drive.ranges[0], 1660556544.05, 0, 0, 1.0);
            expect_range(drive.ranges[5], 1660556544.05, 2, 1, 1.05);
            expect_range(drive.ranges[47], 1660556544.15, 2, 7, 2.23);
            ASSERT_EQ(drive.ground_truth.size(), 1U);
            const model::PoseSample& truth = drive.ground_truth[0];
            EXPECT_EQ(Eigen::Vector3d(truth.x_m, truth.y_m, truth.z_m), Eigen::Vector3d(0.25, 1.5, 0.96));
            EXPECT_NEAR(truth.yaw_rad, 9.0 * kDegree, 1e-5);
            EXPECT_NEAR(truth.roll_rad, 0.0, 1e-5);
            EXPECT_NEAR(truth.pitch_rad, 0.0, 1e-5);
          }};
}

Example mcd() {
  std::string header = "# t,pt0x,pt0y,pt0z,pt1x,pt1y,pt1z";
  std::string row = "1644828646.25,48.4,108.8,7.5,48.8,109.5,7.5";
  for (int tag = 0; tag < 2; ++tag) {
    for (int anchor = 0; anchor < 10; ++anchor) {
      header += fmt::format(",dis_{0}_{1},fps_{0}_{1},rss_{0}_{1}", tag, anchor);
      row += anchor == 3 ? fmt::format(",6.{}25,-81.5,-77.0", tag) : ",0.0,-200.0,-200.0";
    }
  }
  return {{{"ntu_day_06_packed.csv", header + '\n' + row + '\n'}}, [](const io::Dataset& drive) {
            ASSERT_EQ(drive.ranges.size(), 2U);
            expect_range(drive.ranges[0], 1644828646.25, 0, 3, 6.025);
            expect_range(drive.ranges[1], 1644828646.25, 1, 3, 6.125);
          }};
}

Example plaza() {
  return {{{"Plaza1_.mat", test::mat_array("GT", {{10.0, 1.0, 2.0, 0.5}, {10.25, 1.5, 2.0, 0.75}}) +
                               test::mat_array("DR", {{10.25, 0.5, 0.25}, {10.5, 0.25, -0.125}}) +
                               test::mat_array("TD", {{4485.0, 2.0, 1.0, 7.0}, {4483.984, 2.0, 6.0, 36.5}}) +
                               test::mat_array("TL", {{6.0, 22.0, 23.0}})}},
          [](const io::Dataset& drive) {
            ASSERT_EQ(drive.ranges.size(), 2U);
            expect_range(drive.ranges[0], 4483.984, 2, 6, 36.5);
            ASSERT_EQ(drive.odometry.size(), 2U);
            EXPECT_EQ(drive.odometry[0].vx_mps, 1.0);
            EXPECT_EQ(drive.odometry[0].omega_radps, -0.5);
            ASSERT_EQ(drive.ground_truth.size(), 2U);
            EXPECT_EQ(drive.ground_truth[1].yaw_rad, 0.75);
            ASSERT_EQ(drive.surveyed_anchors.size(), 1U);
            EXPECT_EQ(drive.surveyed_anchors[0].position_m, Eigen::Vector3d(22.0, 23.0, 0.0));
          },
          Format::kMat};
}

Example aau() {
  return {{{"d01_ranges.csv",
            "t,range_raw,range_corr,R,UWB_ID1,UWB_ID2,type_ID1,type_ID2,LOS\n"
            "1693508300.67,4.53,0.0,0.0,0,1,84,65,False\n"
            "1693508300.68,-22601.38,0.0,0.0,0,2,84,65,False\n"}},
          [](const io::Dataset& drive) {
            ASSERT_EQ(drive.ranges.size(), 2U);
            expect_range(drive.ranges[0], 1693508300.67, 0, 1, 4.53);
          }};
}

TEST(ImportExamples, EachReadsItsPublishedLayout) {
  const std::map<std::string, Example> examples{
      {"aau", aau()}, {"inrol", inrol()}, {"labyrinth", labyrinth()}, {"lias", lias()},
      {"mcd", mcd()}, {"plaza", plaza()}, {"starloc", starloc()}};
  std::size_t maps = 0;
  for (const auto& entry :
       std::filesystem::directory_iterator(std::filesystem::path(GROMA_SOURCE_DIR) / "examples/import")) {
    ++maps;
    const auto example = examples.find(entry.path().stem());
    ASSERT_NE(example, examples.end()) << entry.path() << " has no test";
    SCOPED_TRACE(example->first);
    const test::ScratchFolder folder;
    std::vector<std::filesystem::path> inputs;
    for (const auto& [name, content] : example->second.files) {
      folder.write(name, content);
      inputs.push_back(folder / name);
    }
    const Format format = example->second.format;
    const Imported imported = import_files(format, inputs, read_import_map(entry.path(), format), {});
    EXPECT_FALSE(imported.dataset.tags.empty());
    for (const model::RangeSample& range : imported.dataset.ranges)
      EXPECT_TRUE(std::any_of(imported.dataset.tags.begin(), imported.dataset.tags.end(),
                              [&](const model::Tag& tag) { return tag.id == range.tag_id; }));
    example->second.expect(imported.dataset);
  }
  EXPECT_EQ(maps, examples.size());
}

}  // namespace
}  // namespace groma::importer
