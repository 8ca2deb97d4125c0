// groma import, export and log as child processes.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <sstream>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/io/dataset.hpp"
#include "host/io/dataset_writer.hpp"
#include "host/io/log_file.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"
#include "test/support/small_run.hpp"

namespace groma {
namespace {

using nlohmann::json;
using test::ChildResult;
using test::read_text;
using testing::AllOf;
using testing::HasSubstr;

class DataCommands : public testing::Test {
 protected:
  DataCommands() {
    io::LogEncoder log;
    log.begin_section(io::describe(run_), 1'700'000'000'000'000'000);
    for (const model::OdometrySample& sample : run_.odometry)
      if (sample.t_s < 4.0 || sample.t_s > 6.0) log.put(sample);
    for (const model::RangeSample& range : run_.ranges) log.put(range);
    for (const model::PoseSample& pose : run_.pose_prior) log.put(pose);
    log.put(model::SensorSample(model::YawRateSample{1.0, 0.5}));
    log.flush();
    folder_.write("drive.glog", log.take());
    io::write_dataset(folder_ / "drive", run_);
  }
  static ChildResult groma(std::vector<std::string> arguments) {
    arguments.insert(arguments.begin(), GROMA_EXECUTABLE);
    return test::run_child(arguments);
  }
  static std::vector<json> lines(const std::string& text) {
    std::vector<json> out;
    std::istringstream rows(text);
    for (std::string row; std::getline(rows, row);) out.push_back(json::parse(row));
    return out;
  }

  io::Dataset run_ = test::make_small_run(10.0, 1);
  test::ScratchFolder folder_;
};

TEST_F(DataCommands, LogInfoHasCountsAndGaps) {
  const ChildResult result = groma({"log", "info", folder_ / "drive.glog", "--json"});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  const json section = json::parse(result.out)["sections"].at(0);
  EXPECT_EQ(section["start"], "2023-11-14T22:13:20Z");
  EXPECT_NEAR(section["duration_s"].get<double>(), 9.95, 1e-9);
  const json& kinds = section["kinds"];
  ASSERT_EQ(kinds.size(), 4U);
  EXPECT_EQ(kinds[0]["kind"], "ranges");
  EXPECT_EQ(kinds[0]["count"], run_.ranges.size());
  EXPECT_EQ(kinds[0]["gaps"], 0);
  EXPECT_EQ(kinds[1]["kind"], "odometry");
  EXPECT_EQ(kinds[1]["gaps"], 1);
  EXPECT_NEAR(kinds[1]["longest_gap_s"].get<double>(), 2.1, 1e-9);
  EXPECT_NEAR(kinds[1]["longest_gap_at_s"].get<double>(), 3.95, 1e-9);
  EXPECT_EQ(kinds[3]["kind"], "imu");
  std::size_t ranges = 0;
  for (const json& anchor : section["anchors"]) ranges += anchor["ranges"].get<std::size_t>();
  EXPECT_EQ(ranges, run_.ranges.size());
  EXPECT_EQ(section["tags"].size(), 2U);
  EXPECT_THAT(groma({"log", "info", folder_ / "drive.glog"}).out,
              AllOf(HasSubstr("odometry"), HasSubstr("anchor 9")));
}

TEST_F(DataCommands, LogCutIsALogOfTheInterval) {
  const ChildResult result =
      groma({"log", "cut", folder_ / "drive.glog", "--from", "2", "--to", "3.5", "-o", folder_ / "cut.glog"});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  const io::Dataset whole = io::read_dataset(folder_ / "drive.glog", {.sensors = true});
  const io::Dataset cut = io::read_dataset(folder_ / "cut.glog", {.sensors = true});
  EXPECT_EQ(cut.name, "small");
  EXPECT_EQ(cut.tags.size(), 2U);
  std::vector<model::RangeSample> ranges;
  for (const model::RangeSample& range : whole.ranges)
    if (range.t_s >= 2.0 && range.t_s <= 3.5) ranges.push_back(range);
  ASSERT_EQ(cut.ranges.size(), ranges.size());
  for (std::size_t i = 0; i < ranges.size(); ++i) EXPECT_EQ(cut.ranges[i].range_m, ranges[i].range_m);
  EXPECT_EQ(cut.odometry.size(), 31U);
  EXPECT_EQ(cut.odometry.front().t_s, 2.0);
  const ChildResult nothing =
      groma({"log", "cut", folder_ / "drive.glog", "--from", "20", "-o", folder_ / "cut.glog"});
  EXPECT_EQ(nothing.exit_code, 65);
  EXPECT_THAT(nothing.err, HasSubstr("there are no samples in the chosen time"));
}

TEST_F(DataCommands, LogCatPrintsByTime) {
  const ChildResult result = groma({"log", "cat", folder_ / "drive.glog", "--from", "0.9", "--to", "1.1"});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  const std::vector<json> rows = lines(result.out);
  double last_s = 0.0;
  std::size_t ranges = 0;
  std::size_t rates = 0;
  for (const json& row : rows) {
    EXPECT_GE(row["t_s"], last_s);
    last_s = row["t_s"];
    ranges += row["class"] == "RANGE" ? 1 : 0;
    rates += row["class"] == "IMU" ? 1 : 0;
  }
  EXPECT_NEAR(static_cast<double>(ranges), 20.0, 1.0);
  EXPECT_EQ(rates, 1U);
  EXPECT_EQ(groma({"log", "cat", folder_ / "drive.glog", "--section", "2"}).exit_code, 65);
  EXPECT_EQ(groma({"log", "info", folder_ / "drive/ranges.csv"}).exit_code, 65);
}

TEST_F(DataCommands, ATornLogIsReadUpToItsEnd) {
  const std::string bytes = read_text(folder_ / "drive.glog");
  folder_.write("torn.glog", bytes.substr(0, bytes.size() - 5));
  const ChildResult result = groma({"log", "info", folder_ / "torn.glog"});
  EXPECT_EQ(result.exit_code, 3);
  EXPECT_THAT(result.err, HasSubstr("bytes of the log are damaged"));
}

TEST_F(DataCommands, ImportReplacesWhatTheInputsContain) {
  const std::string before = read_text(folder_ / "drive/ranges.csv");
  const ChildResult exported =
      groma({"export", folder_ / "drive/groundtruth.csv", "--format", "tum", "-o", folder_ / "truth.tum"});
  EXPECT_EQ(exported.exit_code, 0) << exported.err;
  const ChildResult result = groma({"import", "tum", folder_ / "truth.tum", "-o", folder_ / "drive"});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  EXPECT_THAT(result.out, AllOf(HasSubstr("groundtruth.csv: 200 rows of truth.tum, 0.000 to 9.950 s"),
                                HasSubstr("groma check")));
  EXPECT_EQ(read_text(folder_ / "drive/ranges.csv"), before);
  const io::Dataset drive = io::read_dataset(folder_ / "drive");
  ASSERT_EQ(drive.ground_truth.size(), run_.ground_truth.size());
  EXPECT_EQ(drive.ground_truth[7].x_m, run_.ground_truth[7].x_m);
  EXPECT_EQ(drive.surveyed_anchors.size(), run_.surveyed_anchors.size());
}

TEST_F(DataCommands, ImportWarnsOfRowsThatAreDropped) {
  folder_.write("ranges.csv", "t_s,tag_id,anchor_id,range_m\n1,1,4,5\n2,1,4,0\n3,3,4,5\n");
  const ChildResult result = groma({"import", "csv", folder_ / "ranges.csv", "-o", folder_ / "drive"});
  EXPECT_EQ(result.exit_code, 3) << result.err;
  EXPECT_THAT(result.err, AllOf(HasSubstr("2 rows dropped"), HasSubstr("of an unknown tag")));
  folder_.write("other/ranges.csv", "");
  EXPECT_EQ(groma({"import", "csv", folder_ / "ranges.csv", "-o", folder_ / "other"}).exit_code, 2)
      << "a table of somebody else";
  EXPECT_EQ(groma({"import", "csv", folder_ / "missing.csv", "-o", folder_ / "new"}).exit_code, 65);
  EXPECT_FALSE(std::filesystem::exists(folder_ / "new"));
}

TEST_F(DataCommands, ExportsTheAnchorsOfACalibration) {
  model::Calibration calibration =
      model::surveyed_calibration(run_.surveyed_anchors, run_.tags, run_.range_priors, 0.02);
  folder_.write("calibration.yaml", io::format_calibration(calibration));
  const auto exported = [&](std::vector<std::string> more) {
    std::vector<std::string> arguments{"export", folder_ / "calibration.yaml", "-o", folder_ / "anchors.txt",
                                       "--format"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    const ChildResult result = groma(arguments);
    EXPECT_EQ(result.exit_code, 0) << result.err;
    return read_text(folder_ / "anchors.txt");
  };
  EXPECT_THAT(exported({"csv"}), HasSubstr("\n4,-1,-2,2.8,0.02,0.02,0.02,"));
  const json local = json::parse(exported({"geojson"}));
  ASSERT_EQ(local["features"].size(), 6U);
  EXPECT_EQ(local["features"][0]["geometry"], json({{"type", "Point"}, {"coordinates", {-1.0, -2.0, 2.8}}}));
  EXPECT_EQ(local["features"][0]["properties"]["anchor_id"], 4);
  const json global = json::parse(exported({"geojson", "--datum", "50.8,12.9,300"}));
  EXPECT_NEAR(global["features"][0]["geometry"]["coordinates"][1].get<double>(), 50.8, 1e-4);
  EXPECT_EQ(groma({"export", folder_ / "calibration.yaml", "--format", "tum", "-o", folder_ / "x"}).exit_code,
            65);
  EXPECT_EQ(groma({"export", folder_ / "calibration.yaml", "--format", "csv", "--datum", "1,2,3", "-o",
                   folder_ / "x"})
                .exit_code,
            2);
}

}  // namespace
}  // namespace groma
