#include "host/importer/import.hpp"

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sqlite3.h>
#include <sys/stat.h>

#include <cmath>
#include <numbers>
#include <sstream>
#include <string>
#include <string_view>
#include <vector>

#include "host/convert/convert.hpp"
#include "host/convert/export.hpp"
#include "host/io/dataset_writer.hpp"
#include "host/io/error.hpp"
#include "host/mcap/reader.hpp"
#include "test/support/mat_bytes.hpp"
#include "test/support/random.hpp"
#include "test/support/scratch_folder.hpp"
#include "test/support/small_run.hpp"

namespace groma::importer {
namespace {

using testing::AllOf;
using testing::ElementsAre;
using testing::HasSubstr;

class Import : public testing::Test {
 protected:
  // Imports the files of the folder; `map` is the text of the map, empty: none.
  [[nodiscard]] Imported import(Format format, const std::vector<std::string>& names,
                                const std::string& map = "", io::Dataset base = {}) const {
    std::vector<std::filesystem::path> inputs;
    inputs.reserve(names.size());
    for (const std::string& name : names) inputs.push_back(folder_ / name);
    ImportMap read;
    if (!map.empty()) {
      folder_.write("map.yaml", "schema: 1\n" + map);
      read = read_import_map(folder_ / "map.yaml", format);
    }
    return import_files(format, inputs, read, std::move(base));
  }
  [[nodiscard]] std::string problem(Format format, const std::vector<std::string>& names,
                                    const std::string& map = "") const {
    try {
      static_cast<void>(import(format, names, map));
    } catch (const io::Error& error) {
      return error.what();
    }
    return "";
  }

  test::ScratchFolder folder_;
};

constexpr const char* kTags = "tags: [{id: 1, lever_arm_m: [0.3, 0, 0.5]}]\n";

TEST_F(Import, ReadsRangesOfAnyLayout) {
  folder_.write("log.txt",
                "kind;when;anchor;dist\n"
                "range;1000;4;5250\n"
                "other;1010;;\n"
                "range;1020;5;\"4100\"\n");
  const Imported imported =
      import(Format::kCsv, {"log.txt"},
             std::string(kTags) +
                 "sources:\n"
                 "  - file: log.txt\n"
                 "    to: ranges\n"
                 "    separator: semicolon\n"
                 "    rows: {column: kind, equals: range}\n"
                 "    columns: {t_s: when, tag_id: {value: 1}, anchor_id: anchor, range_m: dist}\n"
                 "    units: {time: ms, length: mm}\n");
  const std::vector<model::RangeSample>& ranges = imported.dataset.ranges;
  ASSERT_EQ(ranges.size(), 2U);
  EXPECT_EQ(ranges[0].t_s, 1.0);
  EXPECT_EQ(ranges[0].tag_id, 1);
  EXPECT_EQ(ranges[0].anchor_id, 4);
  EXPECT_EQ(ranges[0].range_m, 5.25);
  EXPECT_EQ(ranges[1].t_s, 1.02);
  EXPECT_EQ(ranges[1].range_m, 4.1);
  EXPECT_EQ(imported.dataset.tags.at(0).lever_arm_m, Eigen::Vector3d(0.3, 0.0, 0.5));
}

TEST_F(Import, ReadsAColumnForEachPair) {
  folder_.write("wide.csv", "# t,d_0_4,d_0_5\n1.5,6.5,0.0\n1.6,,7.25\n");
  const Imported imported = import(Format::kCsv, {"wide.csv"},
                                   "tags: [{id: 0, lever_arm_m: [0, 0, 0]}]\n"
                                   "sources:\n"
                                   "  - to: ranges\n"
                                   "    header: comment\n"
                                   "    columns: {t_s: t}\n"
                                   "    pairs:\n"
                                   "      - {tag: 0, anchor: 4, column: d_0_4}\n"
                                   "      - {tag: 0, anchor: 5, column: d_0_5}\n");
  ASSERT_EQ(imported.dataset.ranges.size(), 2U) << "an empty field and 0 are no ranges";
  EXPECT_EQ(imported.dataset.ranges[1].anchor_id, 5);
  EXPECT_EQ(imported.dataset.ranges[1].range_m, 7.25);
}

TEST_F(Import, ReadsDatesAndColumnsByNumber) {
  folder_.write("log.csv", "1,2022-08-15 09:42:24.75,3.98,\n2,2022-08-15T09:42:25.00Z,3.67,\n");
  const Imported imported = import(Format::kCsv, {"log.csv"},
                                   std::string(kTags) +
                                       "sources:\n"
                                       "  - to: ranges\n"
                                       "    header: none\n"
                                       "    columns: {t_s: 2, tag_id: {value: 1}, anchor_id: 1, range_m: 3}\n"
                                       "    units: {time: date}\n");
  EXPECT_EQ(imported.dataset.ranges.at(0).t_s, 1660556544.75);
  EXPECT_EQ(imported.dataset.ranges.at(1).t_s, 1660556545.0);
}

// The rows of a data set hold until the next.
TEST_F(Import, ReadsOdometryAsIncrements) {
  folder_.write("in.csv", "t,d,turn\n1000,7,7\n1500,250,90\n1750,500,-45\n");
  const std::string map =
      "sources: [{to: odometry, columns: {t_s: t, dx_m: d, dyaw_rad: turn}, units: {time: ms, length: mm, "
      "angle: "
      "deg}}]\n";
  const std::vector<model::OdometrySample> rows = import(Format::kCsv, {"in.csv"}, map).dataset.odometry;
  ASSERT_EQ(rows.size(), 3U);
  EXPECT_EQ(rows[0].t_s, 1.0);
  EXPECT_EQ(rows[0].vx_mps, 0.5);
  EXPECT_DOUBLE_EQ(rows[0].omega_radps, std::numbers::pi);
  EXPECT_EQ(rows[1].vx_mps, 2.0);
  EXPECT_DOUBLE_EQ(rows[1].omega_radps, -std::numbers::pi);
  EXPECT_EQ(rows[2].vx_mps, rows[1].vx_mps);
  folder_.write("in.csv", "t,d,turn\n1000,0,0\n1000,250,0\n");
  EXPECT_THAT(problem(Format::kCsv, {"in.csv"}, map),
              HasSubstr("in.csv:3: dx_m and dyaw_rad have no time in which they happened"));
}

TEST_F(Import, ReadsOdometryAsSpeedsOfTwoWheels) {
  folder_.write("in.csv", "t_s,left_mps,right_mps\n1,0.5,1\n");
  const auto map = [](double base_m) {
    return fmt::format("sources: [{{to: odometry, columns: {{wheel_base_m: {{value: {}}}}}}}]\n", base_m);
  };
  const std::vector<model::OdometrySample> rows =
      import(Format::kCsv, {"in.csv"}, map(0.25)).dataset.odometry;
  ASSERT_EQ(rows.size(), 1U);
  EXPECT_EQ(rows[0].vx_mps, 0.75);
  EXPECT_EQ(rows[0].omega_radps, 2.0) << "to the left";
  EXPECT_THAT(problem(Format::kCsv, {"in.csv"}, map(0.0)), HasSubstr("wheel_base_m is not positive"));
  EXPECT_THAT(problem(Format::kCsv, {"in.csv"}, "sources: [{to: odometry}]\n"),
              HasSubstr("nor left_mps, right_mps and wheel_base_m"));
}

TEST_F(Import, SortsRowsOfAnyOrder) {
  folder_.write("in.csv", "t_s,vx_mps,omega_radps\n3,3,0\n1,1,0\n2,2,0\n");
  const Imported imported = import(Format::kCsv, {"in.csv"}, "sources: [{to: odometry, order: time}]\n");
  std::vector<double> speeds_mps;
  for (const model::OdometrySample& sample : imported.dataset.odometry) speeds_mps.push_back(sample.vx_mps);
  EXPECT_THAT(speeds_mps, ElementsAre(1.0, 2.0, 3.0));
}

TEST_F(Import, ReadsArraysOfMatFiles) {
  const std::string array = test::mat_array("speed", {{1.0, 0.1, 0.25}, {1.0 + 1e-15, 1e300, -0.5}});
  folder_.write("in.mat", test::mat_array("other", {{1.0}}) + array);
  const auto map = [](const std::string& name) {
    return "sources: [{to: odometry, array: " + name + ", columns: {t_s: 1, vx_mps: 2, omega_radps: 3}}]\n";
  };
  const std::vector<model::OdometrySample> rows =
      import(Format::kMat, {"in.mat"}, map("speed")).dataset.odometry;
  ASSERT_EQ(rows.size(), 2U);
  EXPECT_EQ(rows[0].vx_mps, 0.1);
  EXPECT_EQ(rows[1].t_s, 1.0 + 1e-15);
  EXPECT_EQ(rows[1].vx_mps, 1e300);
  EXPECT_EQ(rows[1].omega_radps, -0.5);

  EXPECT_THAT(problem(Format::kMat, {"in.mat"}, map("speeds")),
              AllOf(HasSubstr("in.mat: has no array speeds"), HasSubstr("its arrays are other, speed")));
  EXPECT_THAT(problem(Format::kMat, {"in.mat"}, map("other")),
              HasSubstr("in.mat:1: the row has 1 fields, and column 2 is needed"));
  EXPECT_THAT(problem(Format::kMat, {"in.mat"}), HasSubstr("give it as --map FILE"));
  EXPECT_THAT(problem(Format::kMat, {"in.mat"}, "sources: [{to: odometry}]\n"),
              HasSubstr("lacks the key array"));
  folder_.write("in.mat", test::mat_array("other", {{1.0}}) + array.substr(0, array.size() - 5));
  EXPECT_THAT(problem(Format::kMat, {"in.mat"}, map("speed")), HasSubstr("in.mat: "));
  folder_.write("in.mat", "t_s,vx_mps\n");
  EXPECT_THAT(problem(Format::kMat, {"in.mat"}, map("speed")), HasSubstr("is no MAT file"));
  EXPECT_THAT(problem(Format::kMat, {"none.mat"}, map("speed")), HasSubstr("none.mat"));
}

// A camera 1 m ahead of base_link and 0.5 m above it, looking to the left.
TEST_F(Import, MakesPosesOfAnotherFrameThoseOfBaseLink) {
  folder_.write("in.csv", "t_s,x_m,y_m,z_m,yaw_rad\n1,10,20,0.5,1.5707963267948966\n");
  const std::string base_link = "base_link: {x_m: 0, y_m: 1, z_m: -0.5, yaw_rad: -1.5707963267948966}";
  const model::PoseSample pose =
      import(Format::kCsv, {"in.csv"}, "sources: [{to: pose_prior, " + base_link + "}]\n")
          .dataset.pose_prior.at(0);
  EXPECT_NEAR(pose.x_m, 9.0, 1e-12);
  EXPECT_NEAR(pose.y_m, 20.0, 1e-12);
  EXPECT_NEAR(pose.z_m, 0.0, 1e-12);
  EXPECT_NEAR(pose.yaw_rad, 0.0, 1e-12);
  EXPECT_TRUE(std::isnan(pose.roll_rad) && std::isnan(pose.pitch_rad)) << "still not known";

  folder_.write("in.tum", "1 10 20 0.5 0 0 0.7071067811865476 0.7071067811865476\n");
  const model::PoseSample tum =
      import(Format::kTum, {"in.tum"}, "sources: [{to: groundtruth, " + base_link + "}]\n")
          .dataset.ground_truth.at(0);
  EXPECT_NEAR(tum.x_m, 9.0, 1e-12);
  EXPECT_NEAR(tum.yaw_rad, 0.0, 1e-12);
  EXPECT_NEAR(tum.roll_rad, 0.0, 1e-12);
  EXPECT_THAT(problem(Format::kCsv, {"in.csv"}, "sources: [{to: odometry, " + base_link + "}]\n"),
              HasSubstr("base_link is of poses"));
}

TEST_F(Import, AddsToADataSet) {
  io::Dataset base = test::make_small_run(1.0, 1);
  folder_.write("truth.txt", "0.5 1 2 3 0 0 0.6 0.8\n");
  const Imported imported = import(Format::kTum, {"truth.txt"}, "", base);
  EXPECT_EQ(imported.dataset.ranges.size(), base.ranges.size());
  ASSERT_EQ(imported.dataset.ground_truth.size(), 1U);
  EXPECT_NEAR(imported.dataset.ground_truth[0].yaw_rad, 2.0 * std::atan2(0.6, 0.8), 1e-12);
  EXPECT_EQ(imported.dataset.ground_truth[0].z_m, 3.0);
}

TEST_F(Import, ReadsWhatItsTablesContain) {
  const io::Dataset run = test::make_small_run(5.0, 1);
  io::write_dataset(folder_.path(), run);
  const Imported imported = import(Format::kCsv, {"ranges.csv", "odometry.csv", "groundtruth.csv",
                                                  "pose_prior.csv", "tags.csv", "anchors.csv"});
  folder_.write("again/empty", "");
  io::write_dataset(folder_ / "again", imported.dataset);
  for (const char* name :
       {"ranges.csv", "odometry.csv", "groundtruth.csv", "pose_prior.csv", "tags.csv", "anchors.csv"})
    EXPECT_EQ(test::read_text(folder_ / "again" / name), test::read_text(folder_ / name)) << name;
}

TEST_F(Import, ATrajectoryComesBackAsItWasExported) {
  io::Dataset run = test::make_small_run(5.0, 1);
  for (model::PoseSample& pose : run.ground_truth) {
    pose.roll_rad = 0.1;
    pose.pitch_rad = -0.2;
  }
  io::write_dataset(folder_.path(), run);
  const auto poses = convert::read_export_poses(folder_ / "groundtruth.csv");
  folder_.write("truth.tum", convert::to_tum(poses));
  folder_.write("truth_q.csv", convert::to_csv(poses));
  for (const auto& [format, name] :
       {std::pair(Format::kTum, "truth.tum"), std::pair(Format::kCsv, "truth_q.csv")}) {
    const Imported imported = import(format, {name});
    ASSERT_EQ(imported.dataset.ground_truth.size(), run.ground_truth.size());
    for (std::size_t i = 0; i < run.ground_truth.size(); ++i) {
      const model::PoseSample& pose = imported.dataset.ground_truth[i];
      EXPECT_EQ(pose.t_s, run.ground_truth[i].t_s);
      EXPECT_EQ(pose.x_m, run.ground_truth[i].x_m);
      EXPECT_EQ(pose.y_m, run.ground_truth[i].y_m);
      EXPECT_EQ(pose.z_m, run.ground_truth[i].z_m);
      EXPECT_NEAR(pose.yaw_rad, run.ground_truth[i].yaw_rad, 1e-12);
      EXPECT_NEAR(pose.roll_rad, 0.1, 1e-12);
      EXPECT_NEAR(pose.pitch_rad, -0.2, 1e-12);
    }
  }
}

TEST_F(Import, KittiAxesFollowFromTheMotion) {
  const io::Dataset run = test::make_small_run(5.0, 1);
  Eigen::Matrix3d camera;  // from the robot's axes
  camera << 0, -1, 0, 0, 0, -1, 1, 0, 0;
  for (const bool is_camera : {false, true}) {
    std::string poses;
    std::string times;
    const Eigen::Matrix3d axes = is_camera ? camera : Eigen::Matrix3d(Eigen::Matrix3d::Identity());
    for (const model::PoseSample& pose : run.ground_truth) {
      const Eigen::Matrix3d rotation =
          axes * model::rotation_from_zyx(pose.yaw_rad, 0.0, 0.0) * axes.transpose();
      const Eigen::Vector3d position = axes * Eigen::Vector3d(pose.x_m, pose.y_m, pose.z_m);
      for (Eigen::Index row = 0; row < 3; ++row)
        poses += fmt::format("{}{} {} {} {}", row > 0 ? " " : "", rotation(row, 0), rotation(row, 1),
                             rotation(row, 2), position(row));
      poses += '\n';
      times += fmt::format("{}\n", pose.t_s);
    }
    folder_.write("poses.txt", poses);
    folder_.write("times.txt", times);
    const Imported imported = import(Format::kKitti, {"poses.txt", "times.txt"});
    ASSERT_EQ(imported.dataset.ground_truth.size(), run.ground_truth.size());
    for (std::size_t i = 0; i < run.ground_truth.size(); ++i) {
      const model::PoseSample& pose = imported.dataset.ground_truth[i];
      EXPECT_NEAR(pose.x_m, run.ground_truth[i].x_m, 1e-12);
      EXPECT_NEAR(pose.y_m, run.ground_truth[i].y_m, 1e-12);
      EXPECT_NEAR(pose.yaw_rad, run.ground_truth[i].yaw_rad, 1e-9);
    }
    EXPECT_THAT(imported.tables.at(0).note, HasSubstr(is_camera ? "camera" : "robot"));
  }
  EXPECT_THAT(problem(Format::kKitti, {"poses.txt"}), HasSubstr("two files"));
  folder_.write("times.txt", "0\n");
  EXPECT_THAT(problem(Format::kKitti, {"poses.txt", "times.txt"}), HasSubstr("1 times for 100 poses"));
  folder_.write("poses.txt", "1 0 0 0 0 2 0 0 0 0 1 0\n");
  EXPECT_THAT(problem(Format::kKitti, {"poses.txt", "times.txt"}), HasSubstr("no rotation"));
}

TEST_F(Import, WhatConvertWritesComesBack) {
  io::Dataset run = test::make_small_run(8.0, 1);
  for (std::size_t i = 0; i < run.ranges.size(); i += 2) {
    run.ranges[i].first_path_power_dbm = -82.25F;
    run.ranges[i].line_of_sight = model::LineOfSight::kUncertain;
    run.ranges[i].network_time_dtu = 9'007'199'254'740'993 + static_cast<std::int64_t>(i);  // no double
  }
  model::samples_of<model::YawRateSample>(run.sensor_samples) = {{1.01, 0.125}, {1.02, 0.25}};
  model::samples_of<model::PositionSample>(run.sensor_samples) = {{1.02, 5.8, 0.6, {4.0, 0.5, 9.0}}};
  model::samples_of<model::ZeroVelocitySample>(run.sensor_samples) = {{1.03}};
  model::PoseSample pose = run.ground_truth.at(21);
  pose.covariance = {0.25, 0.0, 0.0, 0.25, 0.0, 0.0625};
  model::samples_of<model::PoseSample>(run.sensor_samples) = {pose};
  folder_.write("drive.mcap", convert::to_mcap({.dataset = &run}, convert::Format::kRos2).bytes);
  const Imported imported = import(Format::kRosbag2, {"drive.mcap"},
                                   "tags:\n"
                                   "  - {id: 1, lever_arm_m: [0.7, 0.4, 1.9]}\n"
                                   "  - {id: 2, lever_arm_m: [-0.7, -0.4, 0.5]}\n");
  EXPECT_THAT(imported.warnings, testing::IsEmpty());
  const io::Dataset& back = imported.dataset;
  ASSERT_EQ(back.ranges.size(), run.ranges.size());
  for (std::size_t i = 0; i < run.ranges.size(); ++i) {
    EXPECT_EQ(back.ranges[i].t_s, run.ranges[i].t_s);
    EXPECT_EQ(back.ranges[i].tag_id, run.ranges[i].tag_id);
    EXPECT_EQ(back.ranges[i].anchor_id, run.ranges[i].anchor_id);
    EXPECT_EQ(back.ranges[i].range_m, run.ranges[i].range_m);
    EXPECT_EQ(std::isnan(back.ranges[i].first_path_power_dbm),
              std::isnan(run.ranges[i].first_path_power_dbm));
    EXPECT_EQ(back.ranges[i].line_of_sight, run.ranges[i].line_of_sight);
    EXPECT_EQ(back.ranges[i].network_time_dtu, run.ranges[i].network_time_dtu);
  }
  ASSERT_EQ(back.odometry.size(), run.odometry.size());
  for (std::size_t i = 0; i < run.odometry.size(); ++i) {
    EXPECT_NEAR(back.odometry[i].t_s, run.odometry[i].t_s, 1e-9);
    EXPECT_EQ(back.odometry[i].vx_mps, run.odometry[i].vx_mps);
    EXPECT_EQ(back.odometry[i].vy_mps, run.odometry[i].vy_mps);
    EXPECT_EQ(back.odometry[i].omega_radps, run.odometry[i].omega_radps);
  }
  ASSERT_EQ(back.pose_prior.size(), run.pose_prior.size());
  for (std::size_t i = 0; i < run.pose_prior.size(); ++i) {
    EXPECT_NEAR(back.pose_prior[i].t_s, run.pose_prior[i].t_s, 1e-9);
    EXPECT_EQ(back.pose_prior[i].x_m, run.pose_prior[i].x_m);
    EXPECT_NEAR(back.pose_prior[i].yaw_rad, run.pose_prior[i].yaw_rad, 1e-12);
    EXPECT_FALSE(back.pose_prior[i].covariance);
  }
  EXPECT_EQ(model::samples_of<model::YawRateSample>(back.sensor_samples).at(1).omega_radps, 0.25);
  EXPECT_EQ(model::samples_of<model::PositionSample>(back.sensor_samples).at(0).covariance_m2[1], 0.5);
  EXPECT_EQ(model::samples_of<model::ZeroVelocitySample>(back.sensor_samples).at(0).t_s, 1.03);
  EXPECT_EQ(model::samples_of<model::PoseSample>(back.sensor_samples).at(0).covariance, pose.covariance);
}

TEST_F(Import, ATornRecordingGivesWhatIsThereAndAWarning) {
  const io::Dataset run = test::make_small_run(80.0, 1);
  const std::string bytes = convert::to_mcap({.dataset = &run}, convert::Format::kRos2).bytes;
  folder_.write("drive.mcap", bytes.substr(0, bytes.size() * 6 / 10));
  const std::string map = "tags: [{id: 1, lever_arm_m: [0, 0, 1]}, {id: 2, lever_arm_m: [0, 0, 1]}]\n";
  const Imported imported = import(Format::kRosbag2, {"drive.mcap"}, map);
  EXPECT_GT(imported.dataset.ranges.size(), 100U);
  EXPECT_LT(imported.dataset.ranges.size(), run.ranges.size());
  ASSERT_EQ(imported.warnings.size(), 1U);
  EXPECT_THAT(imported.warnings[0], HasSubstr("is not complete from byte 3791 on"));
  folder_.write("drive.mcap", bytes.substr(0, 100));
  EXPECT_THAT(problem(Format::kRosbag2, {"drive.mcap"}, map), HasSubstr("no topic has a type that is known"));
}

TEST_F(Import, SaysWhereWhatAndWhy) {
  const auto csv = [&](const std::string& text, const std::string& source) {
    folder_.write("in.csv", text);
    return problem(Format::kCsv, {"in.csv"},
                   source.empty() ? "" : kTags + ("sources:\n  - " + source + "\n"));
  };
  EXPECT_THAT(csv("a,b\n1,2\n", ""), HasSubstr("its columns a, b are not those of a data set"));
  EXPECT_THAT(csv("a,b\n1,2\n", "{to: ranges, columns: {t_s: time}}"),
              AllOf(HasSubstr("in.csv:1: column time is missing"), HasSubstr("the header has a, b")));
  EXPECT_THAT(csv("t_s,b\n1,2\n", "{to: imu}"), HasSubstr("nothing gives omega_radps of imu.csv"));
  EXPECT_THAT(csv("t_s,b\n1,2\n", "{to: odometry}"),
              HasSubstr("in.csv:2: the odometry has neither vx_mps and omega_radps, nor dx_m and dyaw_rad"));
  EXPECT_THAT(csv("t_s,x_m,y_m,yaw_rad\n1,2,3,4\n1,two,3,4\n", "{to: groundtruth}"),
              HasSubstr("in.csv:3:3: 'two' is not a number"));
  EXPECT_THAT(csv("t_s,x_m,y_m,yaw_rad\n1,nan,3,4\n", "{to: groundtruth}"), HasSubstr("not a finite number"));
  EXPECT_THAT(csv("t_s,x_m,y_m,yaw_rad\n1,2,3,4\n1,2", "{to: groundtruth}"),
              HasSubstr("in.csv:3: the row has 2 fields, the header 4"));
  EXPECT_THAT(csv("t_s,x_m,y_m\n1,2,3\n", "{to: groundtruth}"), HasSubstr("neither yaw_rad nor qx"));
  EXPECT_THAT(csv("t_s,x_m,y_m,qx,qy,qz,qw\n1,2,3,0,0,0,0.5\n", "{to: groundtruth}"),
              HasSubstr("in.csv:2: qx, qy, qz and qw have the norm 0.500"));
  EXPECT_THAT(csv("t_s,x_m,y_m,yaw_rad\n", "{to: groundtruth}"), HasSubstr("has no rows"));
  EXPECT_THAT(csv("t_s,tag_id,anchor_id,range_m\n1,1,4.5,2\n", "{to: ranges}"),
              HasSubstr("anchor_id is no id"));
  EXPECT_THAT(csv("t_s,x_m,y_m,yaw_rad\n1,2,3,4\n", "{to: groundtruth, file: other.csv}"),
              HasSubstr("no input is other.csv"));
  EXPECT_THAT(csv("t_s,x_m,y_m,yaw_rad\n1,2,3,4\n", "{to: groundtruth, columns: {x: 1}}"),
              HasSubstr("unknown key"));
  folder_.write("in.csv", "t_s,tag_id,anchor_id,range_m\n1,7,4,2\n");
  EXPECT_THAT(problem(Format::kCsv, {"in.csv"}), HasSubstr("the lever arms of the tags 7 are not known"));
  folder_.write("cut.tum", "1 2 3 0 0 0 0 1\n1.1 2 3 0 0 0");
  EXPECT_THAT(problem(Format::kTum, {"cut.tum"}),
              HasSubstr("cut.tum:2: the row has 6 fields, and column 7 is needed"));
}

TEST_F(Import, AKeyThatTheFormatDoesNotUseIsAnError) {
  const auto map = [&](Format format, const std::string& text) {
    folder_.write("map.yaml", "schema: 1\n" + text + "\n");
    try {
      static_cast<void>(read_import_map(folder_ / "map.yaml", format));
    } catch (const io::ConfigError& error) {
      return std::string(error.what());
    }
    return std::string();
  };
  EXPECT_THAT(map(Format::kCsv, "sources: [{topic: /odom, to: odometry}]"),
              AllOf(HasSubstr("map.yaml:2:"), HasSubstr("sources[0].topic is not used by groma import csv"),
                    HasSubstr("did you mean 'file'?")));
  EXPECT_THAT(map(Format::kRosbag2, "sources: [{file: /odom, to: odometry}]"),
              HasSubstr("did you mean 'topic'?"));
  EXPECT_THAT(map(Format::kRosbag2, "sources: [{to: odometry}]"), HasSubstr("lacks the key topic"));
  EXPECT_THAT(map(Format::kRosbag2, "sources: [{topic: /a, to: odometry, separator: tab}]"),
              HasSubstr("remove it; rosbag2 uses to, topic, columns, units, base_link, definition"));
  for (const char* key : {"pairs: []", "header: none", "rows: {column: 1, equals: a}"})
    EXPECT_THAT(map(Format::kRosbag2, fmt::format("sources: [{{topic: /a, to: ranges, {}}}]", key)),
                HasSubstr("is not used by groma import rosbag2"));
  EXPECT_THAT(map(Format::kCsv, "sources: [{to: odometry, definition: uint8 a}]"), HasSubstr("is not used"));
  EXPECT_THAT(map(Format::kCsv, "sources: [{to: odometry, array: DR}]"), HasSubstr("is not used"));
  EXPECT_THAT(map(Format::kMat, "sources: [{to: odometry, array: DR, separator: tab}]"),
              HasSubstr("is not used by groma import mat"));
  for (const char* key : {"columns: {t_s: 1}", "header: none", "separator: tab", "units: {angle: deg}"}) {
    EXPECT_THAT(map(Format::kTum, fmt::format("sources: [{{to: groundtruth, {}}}]", key)),
                HasSubstr("is not used by groma import tum"));
    EXPECT_THAT(map(Format::kKitti, fmt::format("sources: [{{to: groundtruth, {}}}]", key)),
                HasSubstr("is not used by groma import kitti"));
  }
  EXPECT_THAT(map(Format::kTum, "axes: robot"), HasSubstr("is of KITTI trajectories"));
  EXPECT_THAT(map(Format::kRosbag2, "sources: [{topic: /a, to: odometry, units: {time: date}}]"),
              HasSubstr("is a date, which only tables have"));
  EXPECT_THAT(map(Format::kCsv, "sources: [{to: ranges, columns: {tag_id: 1}, pairs: []}]"),
              HasSubstr("is there beside a column tag_id"));
  EXPECT_THAT(map(Format::kCsv, "sources: [{to: ranges, separater: tab}]"),
              HasSubstr("did you mean 'separator'?"));
  EXPECT_EQ(map(Format::kKitti, "axes: robot\nsources: [{to: pose_prior, units: {time: ns, length: mm}}]"),
            "");
  EXPECT_EQ(map(Format::kTum, "sources: [{file: a.tum, to: pose_prior, units: {time: ns, length: mm}}]"), "");
}

TEST_F(Import, NoticesWrongUnits) {
  std::string ms = "t_s,x_m,y_m,yaw_rad\n";
  std::string mm = "t_s,tag_id,anchor_id,range_m\n";
  std::string degrees = "t_s,x_m,y_m,yaw_rad\n";
  std::string backward = "t_s,x_m,y_m,yaw_rad\n";
  for (int i = 0; i < 100; ++i) {
    ms += fmt::format("{},1,2,0.5\n", 20 * i);
    mm += fmt::format("{},1,4,{}\n", 0.1 * i, 5000 + i);
    degrees += fmt::format("{},1,2,{}\n", 0.1 * i, i % 72 * 5 - 180);
    backward += fmt::format("{},1,2,0.5\n", (i * 37) % 100);
  }
  folder_.write("ms.csv", ms);
  folder_.write("mm.csv", mm);
  folder_.write("degrees.csv", degrees);
  folder_.write("backward.csv", backward);
  EXPECT_THAT(problem(Format::kCsv, {"ms.csv"}), HasSubstr("20 s apart: the times are probably in ms"));
  EXPECT_THAT(problem(Format::kCsv, {"mm.csv"}, kTags), HasSubstr("they are probably in mm"));
  EXPECT_THAT(problem(Format::kCsv, {"degrees.csv"}), HasSubstr("probably in degrees"));
  EXPECT_THAT(problem(Format::kCsv, {"backward.csv"}), HasSubstr("do not increase"));
  EXPECT_EQ(problem(Format::kCsv, {"ms.csv"}, "sources: [{to: groundtruth, units: {time: s}}]\n"), "")
      << "the user's word";
  EXPECT_EQ(problem(Format::kCsv, {"ms.csv"}, "sources: [{to: groundtruth, units: {time: ms}}]\n"), "");
  const Imported imported =
      import(Format::kCsv, {"degrees.csv"}, "sources: [{to: groundtruth, units: {angle: deg}}]\n");
  EXPECT_NEAR(imported.dataset.ground_truth.at(0).yaw_rad, -std::numbers::pi, 1e-12);
}

TEST_F(Import, WarnsOfTimesThatDoNotOverlap) {
  folder_.write("ranges.csv", "t_s,tag_id,anchor_id,range_m\n1,1,4,5\n2,1,4,5\n");
  folder_.write("odometry.csv", "t_s,vx_mps,omega_radps\n100,1,0\n101,1,0\n");
  const Imported imported = import(Format::kCsv, {"ranges.csv", "odometry.csv"}, kTags);
  ASSERT_EQ(imported.warnings.size(), 1U);
  EXPECT_THAT(imported.warnings[0], HasSubstr("they do not overlap"));
  EXPECT_EQ(imported.dataset.odometry.at(0).vy_mps, 0.0) << "not given";
}

TEST_F(Import, NamesTheTopicsThereAre) {
  const io::Dataset run = test::make_small_run(2.0, 1);
  folder_.write("drive.mcap", convert::to_mcap({.dataset = &run}, convert::Format::kRos2).bytes);
  EXPECT_THAT(problem(Format::kRosbag2, {"drive.mcap"}, "sources: [{topic: /odom, to: odometry}]\n"),
              AllOf(HasSubstr("has no topic '/odom'"), HasSubstr("/groma/input/odometry")));
  EXPECT_THAT(
      problem(Format::kRosbag2, {"drive.mcap"},
              "sources: [{topic: /groma/ranges, to: ranges, columns: {range_m: 'ranges[].distance'}}]\n"),
      AllOf(HasSubstr("map.yaml:"), HasSubstr("has no field distance; its fields are t_s, tag_id")));
  folder_.write("drive.mcap", "nothing");
  EXPECT_THAT(problem(Format::kRosbag2, {"drive.mcap"}), HasSubstr("is no MCAP file"));
  folder_.write("drive.db3", std::string("SQLite format 3\0", 16) + std::string(1000, 'x'));
  EXPECT_THAT(problem(Format::kRosbag2, {"drive.db3"}), HasSubstr("cannot be read"));
}

// The messages of an MCAP file as a recording in SQLite, with the tables of ROS 2 Iron.
void write_sqlite(const std::string& mcap, const std::filesystem::path& path) {
  sqlite3* database = nullptr;
  ASSERT_EQ(sqlite3_open(path.c_str(), &database), SQLITE_OK);
  const auto run = [&](const char* query, const std::vector<std::string>& values, std::int64_t time_ns = 0) {
    sqlite3_stmt* statement = nullptr;
    ASSERT_EQ(sqlite3_prepare_v2(database, query, -1, &statement, nullptr), SQLITE_OK) << query;
    for (std::size_t i = 0; i < values.size(); ++i)
      sqlite3_bind_blob(statement, static_cast<int>(i) + 1, values[i].data(),
                        static_cast<int>(values[i].size()), SQLITE_TRANSIENT);
    if (time_ns != 0) sqlite3_bind_int64(statement, static_cast<int>(values.size()) + 1, time_ns);
    ASSERT_EQ(sqlite3_step(statement), SQLITE_DONE) << query;
    sqlite3_finalize(statement);
  };
  run("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)", {});
  run("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)", {});
  run("CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT, "
      "encoded_message_definition TEXT)",
      {});
  run("BEGIN", {});
  std::istringstream file(mcap);
  const auto content =
      mcap::read(file, [&](std::uint16_t channel, std::uint64_t time_ns, std::string_view data) {
        const std::string query =
            fmt::format("INSERT INTO messages(topic_id, data, timestamp) VALUES ({}, ?, ?)", channel + 1);
        run(query.c_str(), {std::string(data)}, static_cast<std::int64_t>(time_ns) + 1);
      });
  for (const auto& [id, channel] : content->channels) {
    const std::string query =
        fmt::format("INSERT INTO topics VALUES ({}, CAST(? AS TEXT), CAST(? AS TEXT), 'cdr')", id + 1);
    run(query.c_str(), {channel.topic, channel.schema->name});
    run("INSERT INTO message_definitions(topic_type, encoding, encoded_message_definition) "
        "VALUES (CAST(? AS TEXT), 'ros2msg', CAST(? AS TEXT))",
        {channel.schema->name, channel.schema->data});
  }
  run("COMMIT", {});
  ASSERT_EQ(sqlite3_close(database), SQLITE_OK);
}

TEST_F(Import, SqliteGivesTheSameAsMcap) {
  const io::Dataset run = test::make_small_run(4.0, 1);
  const std::string mcap = convert::to_mcap({.dataset = &run}, convert::Format::kRos2).bytes;
  folder_.write("drive.mcap", mcap);
  write_sqlite(mcap, folder_ / "drive.db3");
  const std::string tags = "tags: [{id: 1, lever_arm_m: [0, 0, 1]}, {id: 2, lever_arm_m: [0, 0, 1]}]\n";
  io::write_dataset(folder_ / "a", import(Format::kRosbag2, {"drive.mcap"}, tags).dataset);
  io::write_dataset(folder_ / "b", import(Format::kRosbag2, {"drive.db3"}, tags).dataset);
  for (const char* name : {"ranges.csv", "odometry.csv", "pose_prior.csv"})
    EXPECT_EQ(test::read_text(folder_ / "a" / name), test::read_text(folder_ / "b" / name)) << name;

  const std::string good = test::read_text(folder_ / "drive.db3");
  test::Random random(13);
  for (int i = 0; i < 200; ++i) {
    std::string bytes = good;
    for (int change = 0; change < 20; ++change)
      bytes[16 + random.next() % (bytes.size() - 16)] = static_cast<char>(random.next());
    bytes.resize(16 + random.next() % (bytes.size() - 16));
    folder_.write("torn.db3", bytes);
    static_cast<void>(problem(Format::kRosbag2, {"torn.db3"}, tags));  // an error, or what is left
  }
}

// ros2 bag record splits a recording into drive_0 to drive_10 and more, which a shell sorts otherwise.
TEST_F(Import, FilesOfOneRecordingFollowByTime) {
  const io::Dataset run = test::make_small_run(12.0, 1);
  const auto part = [&](double from_s, double to_s) {
    io::Dataset out = run;
    const auto is_outside = [&](const auto& sample) { return sample.t_s < from_s || sample.t_s >= to_s; };
    std::erase_if(out.ranges, is_outside);
    std::erase_if(out.odometry, is_outside);
    std::erase_if(out.pose_prior, is_outside);
    std::erase_if(out.ground_truth, is_outside);
    return convert::to_mcap({.dataset = &out}, convert::Format::kRos2).bytes;
  };
  folder_.write("bag/drive_2.mcap", part(0.0, 4.0));
  folder_.write("bag/drive_10.mcap", part(4.0, 12.0));
  folder_.write("bag/more.mcap/none", "a folder");
  const std::string tags = "tags: [{id: 1, lever_arm_m: [0, 0, 1]}, {id: 2, lever_arm_m: [0, 0, 1]}]\n";
  const Imported imported = import(Format::kRosbag2, {"bag"}, tags);
  ASSERT_EQ(imported.dataset.odometry.size(), run.odometry.size());
  for (std::size_t i = 0; i < run.odometry.size(); ++i)
    ASSERT_NEAR(imported.dataset.odometry[i].t_s, run.odometry[i].t_s, 1e-9);

  std::string other = part(4.0, 12.0);
  const std::string type = "geometry_msgs/msg/TwistWithCovarianceStamped";
  for (std::size_t at = 0; (at = other.find(type, at)) != std::string::npos;) other[at] = 'G';
  other.replace(other.size() - 8 - 4, 4, 4, '\0');  // no checksum of the summary
  folder_.write("bag/drive_10.mcap", other);
  EXPECT_THAT(problem(Format::kRosbag2, {"bag"}, tags),
              AllOf(HasSubstr("drive_10.mcap: topic /groma/input/odometry has the types"),
                    HasSubstr("Geometry_msgs/msg/TwistWith")));
}

TEST_F(Import, SeveralSourcesOfASensorAreMergedByTime) {
  folder_.write("a.csv", "t_s,omega_radps\n1,0.5\n3,0.5\n");
  folder_.write("b.csv", "t_s,omega_radps\n2,0.25\n");
  const Imported imported = import(Format::kCsv, {"a.csv", "b.csv"}, "sources: [{to: imu}]\n");
  const auto& samples = model::samples_of<model::YawRateSample>(imported.dataset.sensor_samples);
  ASSERT_EQ(samples.size(), 3U);
  EXPECT_EQ(samples[1].omega_radps, 0.25);
}

TEST_F(Import, ReadsTextOfOtherPrograms) {
  folder_.write("marked.csv", "\xef\xbb\xbf# t_s,x_m,y_m,yaw_rad\n1,2,3,0.5\n");
  EXPECT_EQ(problem(Format::kCsv, {"marked.csv"}, "sources: [{to: groundtruth, header: comment}]\n"), "");
  folder_.write("twice.csv", "t_s,x_m,x_m,y_m,yaw_rad\n1,2,9,3,0.5\n");
  EXPECT_THAT(problem(Format::kCsv, {"twice.csv"}, "sources: [{to: groundtruth}]\n"),
              HasSubstr("twice.csv:1: column x_m occurs twice"));
  EXPECT_EQ(problem(Format::kCsv, {"twice.csv"}, "sources: [{to: groundtruth, columns: {x_m: 2}}]\n"), "");
  for (const char* date : {"2022-08-15 24:42:24.5", "2022-08-15 09:60:24", "2022-08-15 09:42:61",
                           "2022-08-15 -9:42:24", "2022-08-15 09:42:-4", "2022-13-15 09:42:24"}) {
    folder_.write("dates.csv", fmt::format("t_s,vx_mps,omega_radps\n{},1,0\n", date));
    EXPECT_THAT(problem(Format::kCsv, {"dates.csv"}, "sources: [{to: odometry, units: {time: date}}]\n"),
                HasSubstr("is no date"))
        << date;
  }
  // A recording that is given as a table must not reach the terminal.
  std::string binary;
  for (int i = 0; i < 30000; ++i)
    binary += i % 3 == 0 ? "\x1b[2J" : (i % 3 == 1 ? "," : std::string(60, '\0'));
  folder_.write("binary.csv", binary);
  const std::string message = problem(Format::kCsv, {"binary.csv"});
  EXPECT_THAT(message, HasSubstr("are not those of a data set"));
  EXPECT_LT(message.size(), 8000U);
  EXPECT_EQ(message.find('\x1b'), std::string::npos);
}

TEST_F(Import, ASqliteFileRunsNothing) {
  const auto create = [&](const char* name, const std::string& statements) {
    sqlite3* database = nullptr;
    ASSERT_EQ(sqlite3_open((folder_ / name).c_str(), &database), SQLITE_OK);
    char* error = nullptr;
    EXPECT_EQ(sqlite3_exec(database, statements.c_str(), nullptr, nullptr, &error), SQLITE_OK) << error;
    sqlite3_close(database);
  };
  const std::string topics =
      "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
      "INSERT INTO topics VALUES (1, '/odom', 'nav_msgs/msg/Odometry', 'cdr');";
  // A view without end, which the schema calls a table.
  create("view.db3",
         topics +
             "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
             "SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n;"
             "PRAGMA writable_schema = ON;"
             "UPDATE sqlite_master SET type = 'table' WHERE name = 'messages';");
  EXPECT_THAT(problem(Format::kRosbag2, {"view.db3"}), HasSubstr("cannot be read"));
  // A row of some bytes whose value has 900 MB.
  create("large.db3",
         topics +
             "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
             "data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL);"
             "INSERT INTO messages(id, topic_id, timestamp) VALUES (1, 1, 5);");
  EXPECT_THAT(problem(Format::kRosbag2, {"large.db3"}), HasSubstr("cannot be read"));
  ASSERT_EQ(::mkfifo((folder_ / "pipe").c_str(), 0600), 0);
  EXPECT_THAT(problem(Format::kRosbag2, {"pipe"}), HasSubstr("is not a regular file"));
}

TEST_F(Import, SurvivesRandomBytes) {
  const io::Dataset run = test::make_small_run(1.0, 1);
  const std::string good = convert::to_mcap({.dataset = &run}, convert::Format::kRos2).bytes;
  io::write_dataset(folder_.path(), run);
  const std::string text = test::read_text(folder_ / "groundtruth.csv");
  test::Random random(11);
  std::size_t errors = 0;
  for (int i = 0; i < 300; ++i) {
    std::string bytes = good;
    std::string table = text;
    for (int change = 0; change < 4; ++change) {
      bytes[random.next() % bytes.size()] = static_cast<char>(random.next());
      table[random.next() % table.size()] = static_cast<char>(random.next());
    }
    folder_.write("drive.mcap", bytes);
    folder_.write("table.csv", table);
    if (!problem(Format::kRosbag2, {"drive.mcap"}).empty()) ++errors;
    if (!problem(Format::kCsv, {"table.csv"}).empty()) ++errors;
  }
  EXPECT_GT(errors, 100U);
}

TEST(Export, ADatumPutsTheMapOnTheEarth) {
  const model::Datum datum{50.8, 12.9, 300.0};
  const Eigen::Vector3d origin = model::geographic(Eigen::Vector3d::Zero(), datum);
  EXPECT_NEAR(origin.x(), 12.9, 1e-12);
  EXPECT_NEAR(origin.y(), 50.8, 1e-12);
  EXPECT_NEAR(origin.z(), 300.0, 1e-6);
  // Radii of curvature of WGS84 at 50.8 degrees: 6390986 m across the meridian, 6374002 m along it.
  const Eigen::Vector3d place = model::geographic({100.0, 50.0, 2.0}, datum);
  EXPECT_NEAR(
      (place.x() - 12.9) * std::numbers::pi / 180.0 * 6391286.0 * std::cos(50.8 * std::numbers::pi / 180.0),
      100.0, 0.02);
  EXPECT_NEAR((place.y() - 50.8) * std::numbers::pi / 180.0 * 6374302.0, 50.0, 0.02);
  EXPECT_NEAR(place.z(), 302.0, 0.002);
}

}  // namespace
}  // namespace groma::importer
