// What groma convert writes, as the packages read it that viewers use: @mcap/core, protobufjs, and the CDR
// reader of Foxglove. test/npm/read_mcap.mjs decodes a file to JSON and fails where a checksum, an index or a
// schema is wrong.
#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <numbers>
#include <sstream>
#include <string>
#include <vector>

#include <Eigen/Geometry>
#include <nlohmann/json.hpp>

#include "host/filter/replay.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/dataset_writer.hpp"
#include "host/io/log_file.hpp"
#include "test/npm/node.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"
#include "test/support/small_run.hpp"

namespace groma {
namespace {

using nlohmann::json;
using test::ChildResult;
using testing::HasSubstr;

using test::node;

class NpmConvert : public test::NpmTest {
 protected:
  NpmConvert() {
    using model::samples_of;
    io::Dataset& run = run_;
    for (model::RangeSample& range : run.ranges) {
      range.range_m = static_cast<double>(static_cast<float>(range.range_m));  // as in a log
      if (range.anchor_id == 5) continue;                                      // has only the range
      range.first_path_power_dbm = -82.25F;
      range.receive_power_dbm = -80.5F;
      range.clock_offset_ppm = 3.5F;
      range.noise = 40.0F;
      range.line_of_sight = model::LineOfSight::kUncertain;
      range.corrections = model::kAntennaDelaysApplied;
      range.network_time_dtu = 1'000'000'000'000 + std::llround(range.t_s * 63.8976e9);
    }
    samples_of<model::YawRateSample>(run.sensor_samples) = {{1.01, run.odometry.at(20).omega_radps}};
    samples_of<model::PositionSample>(run.sensor_samples) = {{1.02, 5.8, 0.6, {4.0, 0.5, 9.0}}};
    model::PoseSample pose = run.ground_truth.at(21);
    pose.covariance = {0.25, 0.0, 0.0, 0.25, 0.0, 0.0625};
    samples_of<model::PoseSample>(run.sensor_samples) = {pose};
    samples_of<model::ZeroVelocitySample>(run.sensor_samples) = {{1.03}};
    model::Calibration calibration =
        model::surveyed_calibration(run.surveyed_anchors, run.tags, run.range_priors, 0.02);
    calibration.verdict = model::Verdict::kUsable;
    for (model::AnchorCalibration& anchor : calibration.anchors) anchor.verdict = model::AnchorVerdict::kOk;
    folder_.write("calibration.yaml", io::format_calibration(calibration));
    folder_.write("drive.glog", log());
  }

  [[nodiscard]] std::string log() const {
    io::LogEncoder log;
    log.begin_section(io::describe(run_), 17);
    for (const model::OdometrySample& sample : run_.odometry) log.put(sample);
    for (const model::PoseSample& pose : run_.pose_prior) log.put(pose);
    for (const model::RangeSample& range : run_.ranges) log.put(range);
    std::apply(
        [&log](const auto&... tables) {
          const auto put = [&log](const auto& table) {
            for (const auto& sample : table) log.put(model::SensorSample(sample));
          };
          (put(tables), ...);
        },
        run_.sensor_samples);
    log.flush();
    return log.take();
  }

  [[nodiscard]] ChildResult convert(const std::vector<std::string>& more) const {
    std::vector<std::string> arguments{GROMA_EXECUTABLE, "convert", folder_ / "drive.glog", "-o", mcap_};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return test::run_child(arguments);
  }
  // What the packages read of the file.
  [[nodiscard]] json read() const {
    const ChildResult result = test::run_child({node(), test::kNpmFolder / "read_mcap.mjs", mcap_});
    EXPECT_EQ(result.exit_code, 0) << result.err;
    return json::parse(result.out);
  }
  [[nodiscard]] json convert_and_read(std::vector<std::string> more) const {
    more.insert(more.end(), {"--calibration", folder_ / "calibration.yaml"});
    const ChildResult result = convert(more);
    EXPECT_EQ(result.exit_code, 0) << result.err;
    return read();
  }
  // The rows that groma replay writes: the columns t_s, x_m, y_m, yaw_rad, then p_xx.
  [[nodiscard]] std::vector<std::vector<double>> replayed() const {
    const std::filesystem::path path = folder_ / "estimate.csv";
    const ChildResult result = test::run_child({GROMA_EXECUTABLE, "replay", folder_ / "drive.glog",
                                                "--calibration", folder_ / "calibration.yaml", "-o", path});
    EXPECT_EQ(result.exit_code, 0) << result.err;
    std::vector<std::vector<double>> rows;
    std::istringstream text(test::read_text(path));
    std::string line;
    for (std::getline(text, line); std::getline(text, line);) {
      std::istringstream fields(line);
      std::vector<double>& row = rows.emplace_back();
      for (std::string field; row.size() < 5 && std::getline(fields, field, ',');)
        row.push_back(std::stod(field));
    }
    return rows;
  }

  static std::vector<json> of(const json& content, const std::string& topic) {
    std::vector<json> out;
    for (const json& message : content["messages"])
      if (message["topic"] == topic) out.push_back(message);
    return out;
  }
  // Values of the topic's only message.
  static json only(const json& content, const std::string& topic) {
    const std::vector<json> messages = of(content, topic);
    EXPECT_EQ(messages.size(), 1U) << topic;
    return messages.empty() ? json() : messages.front()["value"];
  }
  static double yaw_of(const json& q) {
    const Eigen::Quaterniond rotation(q["w"].get<double>(), q["x"].get<double>(), q["y"].get<double>(),
                                      q["z"].get<double>());
    const Eigen::Vector3d forward = rotation * Eigen::Vector3d::UnitX();
    return std::atan2(forward.y(), forward.x());
  }
  // The ranges of all messages are those of the drive.
  void expect_ranges(const json& content) const {
    std::size_t i = 0;
    for (const json& message : of(content, "/groma/ranges")) {
      for (const json& range : message["value"]["ranges"]) {
        ASSERT_LT(i, run_.ranges.size());
        const model::RangeSample& sample = run_.ranges[i++];
        EXPECT_EQ(range["t_s"], sample.t_s);
        EXPECT_EQ(range["tag_id"], sample.tag_id);
        EXPECT_EQ(range["anchor_id"], sample.anchor_id);
        EXPECT_EQ(range["range_m"], sample.range_m);
        if (sample.anchor_id == 5) continue;
        EXPECT_EQ(range["first_path_power_dbm"], -82.25);
        EXPECT_EQ(range["receive_power_dbm"], -80.5);
        EXPECT_EQ(range["clock_offset_ppm"], 3.5);
        EXPECT_EQ(range["noise"], 40.0);
        EXPECT_EQ(range["corrections"], 4);
      }
    }
    EXPECT_EQ(i, run_.ranges.size());
  }

  io::Dataset run_ = test::make_small_run(12.0, 1);
  test::ScratchFolder folder_;
  std::filesystem::path mcap_ = folder_ / "drive.mcap";
};

TEST_F(NpmConvert, FoxgloveHasTheInputs) {
  const json content = convert_and_read({});
  EXPECT_EQ(content["profile"], "");
  EXPECT_THAT(content["library"].get<std::string>(), testing::StartsWith("groma "));
  for (const auto& [topic, channel] : content["channels"].items()) {
    EXPECT_EQ(channel["message_encoding"], "protobuf") << topic;
    EXPECT_EQ(channel["schema_encoding"], "protobuf") << topic;
  }
  expect_ranges(content);
  const json ranges = of(content, "/groma/ranges").front()["value"]["ranges"];
  EXPECT_EQ(ranges[0]["line_of_sight"], "UNCERTAIN");
  EXPECT_EQ(ranges[0]["network_time_dtu"], "1000000000000");
  const std::vector<json> odometry = of(content, "/groma/input/odometry");
  ASSERT_EQ(odometry.size(), run_.odometry.size());
  for (std::size_t i = 0; i < odometry.size(); ++i)
    EXPECT_EQ(odometry[i]["value"]["vx_mps"], run_.odometry[i].vx_mps);
  EXPECT_EQ(of(content, "/groma/input/pose_prior").size(), run_.pose_prior.size());
  EXPECT_EQ(only(content, "/groma/input/imu")["omega_radps"], run_.odometry.at(20).omega_radps);
  EXPECT_EQ(only(content, "/groma/input/gnss")["covariance_m2"], json({4.0, 0.5, 9.0}));
  const json pose = only(content, "/groma/input/absolute_pose");
  EXPECT_EQ(pose["frame_id"], "map");
  EXPECT_NEAR(yaw_of(pose["pose"]["orientation"]), run_.ground_truth.at(21).yaw_rad, 1e-9);
  EXPECT_EQ(only(content, "/groma/input/zero_velocity")["timestamp"]["nanos"], 30'000'000);
}

TEST_F(NpmConvert, FoxgloveHasThePosesThatReplayComputes) {
  const json content = convert_and_read({});
  const auto rows = replayed();
  const std::vector<json> poses = of(content, "/groma/pose");
  const std::vector<json> estimates = of(content, "/groma/estimate");
  const std::vector<json> transforms = of(content, "/tf");
  ASSERT_EQ(poses.size(), rows.size());
  ASSERT_EQ(estimates.size(), rows.size());
  ASSERT_EQ(transforms.size(), rows.size());
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const json& pose = poses[i]["value"]["pose"];
    EXPECT_EQ(poses[i]["time_ns"], std::to_string(std::llround(rows[i][0] * 1e9)));
    EXPECT_EQ(pose["position"]["x"], rows[i][1]);
    EXPECT_EQ(pose["position"]["y"], rows[i][2]);
    EXPECT_NEAR(pose["position"]["z"].get<double>(), 0.25, 1e-12);
    EXPECT_NEAR(std::remainder(yaw_of(pose["orientation"]) - rows[i][3], 2.0 * std::numbers::pi), 0.0, 1e-9);
    EXPECT_EQ(transforms[i]["value"]["translation"], pose["position"]);
    EXPECT_EQ(transforms[i]["value"]["child_frame_id"], "base_link");
    EXPECT_DOUBLE_EQ(estimates[i]["value"]["covariance"][0].get<double>(), rows[i][4]);
    EXPECT_EQ(estimates[i]["value"]["covariance"].size(), 36U);
  }
  EXPECT_EQ(estimates.back()["value"]["state"], "TRACKING");
}

TEST_F(NpmConvert, FoxgloveHasTheSceneAndTheLog) {
  const json content = convert_and_read({});
  const json entities = only(content, "/groma/scene")["entities"];
  ASSERT_EQ(entities.size(), run_.surveyed_anchors.size() + 1);
  EXPECT_EQ(entities[0]["id"], "anchor 4");
  EXPECT_EQ(entities[0]["cubes"][0]["pose"]["position"], json({{"x", -1.0}, {"y", -2.0}, {"z", 2.8}}));
  EXPECT_EQ(entities[0]["texts"][0]["text"], "4");
  EXPECT_EQ(entities[0]["metadata"][0]["key"], "covariance_m2");
  EXPECT_THAT(entities[0]["metadata"][0]["value"].get<std::string>(), HasSubstr(" "));
  EXPECT_EQ(entities.back()["frame_id"], "base_link");
  EXPECT_EQ(entities.back()["frame_locked"], true);
  EXPECT_EQ(entities.back()["spheres"].size(), run_.tags.size());
  EXPECT_EQ(entities.back()["arrows"].size(), 1U);
  const json ellipse = of(content, "/groma/uncertainty").back()["value"]["entities"][0]["cylinders"][0];
  EXPECT_GT(ellipse["size"]["x"].get<double>(), 0.0);
  EXPECT_EQ(of(content, "/groma/log").front()["value"]["message"], "CONVERGING");
  EXPECT_EQ(of(content, "/groma/log").back()["value"]["message"], "TRACKING");
  EXPECT_EQ(of(content, "/groma/log").back()["value"]["level"], "INFO");
}

TEST_F(NpmConvert, Ros2HasTheInputs) {
  const json content = convert_and_read({"--ros2"});
  EXPECT_EQ(content["profile"], "ros2");
  for (const auto& [topic, channel] : content["channels"].items()) {
    EXPECT_EQ(channel["message_encoding"], "cdr") << topic;
    EXPECT_EQ(channel["schema_encoding"], "ros2msg") << topic;
    EXPECT_THAT(channel["metadata"]["offered_qos_profiles"].get<std::string>(), HasSubstr("reliability: 1"));
  }
  expect_ranges(content);
  const json ranges = of(content, "/groma/ranges").front()["value"]["ranges"];
  EXPECT_EQ(ranges[0]["line_of_sight"], 2);
  EXPECT_EQ(ranges[0]["network_time_dtu"], 1'000'000'000'000);
  const json odometry = of(content, "/groma/input/odometry").at(20)["value"];
  EXPECT_EQ(odometry["header"]["frame_id"], "base_link");
  EXPECT_EQ(odometry["header"]["stamp"], json({{"sec", 1}, {"nsec", 0}}));
  EXPECT_EQ(odometry["twist"]["twist"]["linear"]["x"], run_.odometry.at(20).vx_mps);
  EXPECT_EQ(odometry["twist"]["twist"]["angular"]["z"], run_.odometry.at(20).omega_radps);
  const json& variances = odometry["twist"]["covariance"];
  EXPECT_NEAR(variances[0].get<double>(), 0.02 * 0.02, 1e-12);
  EXPECT_NEAR(variances[35].get<double>(), 0.006 * 0.006, 1e-12);
  EXPECT_EQ(variances[14], 1e6) << "vz is unknown";
  const json imu = only(content, "/groma/input/imu");
  EXPECT_EQ(imu["angular_velocity"]["z"], run_.odometry.at(20).omega_radps);
  EXPECT_EQ(imu["orientation_covariance"][0], -1.0);
  EXPECT_EQ(imu["linear_acceleration_covariance"][0], -1.0);
  EXPECT_EQ(only(content, "/groma/input/gnss")["covariance_m2"], json({4.0, 0.5, 9.0}));
  const json pose = only(content, "/groma/input/absolute_pose");
  EXPECT_EQ(pose["pose"]["covariance"][7], 0.25);
  EXPECT_EQ(pose["pose"]["covariance"][35], 0.0625);
  EXPECT_EQ(of(content, "/groma/input/pose_prior").front()["value"]["pose"]["covariance"][0], 1e6)
      << "unknown";
  EXPECT_EQ(only(content, "/groma/input/zero_velocity")["stamp"], json({{"sec", 1}, {"nsec", 30'000'000}}));
}

TEST_F(NpmConvert, Ros2HasThePosesThatReplayComputes) {
  const json content = convert_and_read({"--ros2"});
  const auto rows = replayed();
  const std::vector<json> poses = of(content, "/groma/pose");
  const std::vector<json> odometry = of(content, "/groma/odometry");
  const std::vector<json> transforms = of(content, "/tf");
  ASSERT_EQ(poses.size(), rows.size());
  ASSERT_EQ(odometry.size(), rows.size());
  ASSERT_EQ(transforms.size(), rows.size());
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const json& pose = poses[i]["value"]["pose"];
    EXPECT_EQ(poses[i]["value"]["header"]["frame_id"], "map");
    EXPECT_EQ(pose["pose"]["position"]["x"], rows[i][1]);
    EXPECT_EQ(pose["pose"]["position"]["y"], rows[i][2]);
    EXPECT_NEAR(std::remainder(yaw_of(pose["pose"]["orientation"]) - rows[i][3], 2.0 * std::numbers::pi), 0.0,
                1e-9);
    EXPECT_DOUBLE_EQ(pose["covariance"][0].get<double>(), rows[i][4]);
    for (std::size_t axis = 0; axis < 6; ++axis) EXPECT_GT(pose["covariance"][7 * axis].get<double>(), 0.0);
    EXPECT_EQ(odometry[i]["value"]["pose"], pose);
    EXPECT_EQ(odometry[i]["value"]["child_frame_id"], "base_link");
    EXPECT_EQ(odometry[i]["value"]["twist"]["twist"]["linear"]["x"],
              run_.odometry[run_.odometry.size() - rows.size() + i].vx_mps);
    // Of the plane: map to odom and odom to base_link add up to the pose.
    const json& map_to_odom = transforms[i]["value"]["transforms"][0];
    const json& odom_to_base = transforms[i]["value"]["transforms"][1];
    EXPECT_EQ(map_to_odom["child_frame_id"], "odom");
    EXPECT_EQ(odom_to_base["child_frame_id"], "base_link");
    const double odom_yaw_rad = yaw_of(map_to_odom["transform"]["rotation"]);
    EXPECT_NEAR(std::remainder(odom_yaw_rad + yaw_of(odom_to_base["transform"]["rotation"]) - rows[i][3],
                               2.0 * std::numbers::pi),
                0.0, 1e-9);
    const auto at = [](const json& transform, const char* axis) {
      return transform["transform"]["translation"][axis].get<double>();
    };
    EXPECT_NEAR(at(map_to_odom, "x") + std::cos(odom_yaw_rad) * at(odom_to_base, "x") -
                    std::sin(odom_yaw_rad) * at(odom_to_base, "y"),
                rows[i][1], 1e-9);
  }
}

TEST_F(NpmConvert, Ros2HasAnchorsAndDiagnostics) {
  const json content = convert_and_read({"--ros2"});
  const json markers = only(content, "/groma/anchors")["markers"];
  ASSERT_EQ(markers.size(), 2 * run_.surveyed_anchors.size() + 1);
  EXPECT_EQ(markers[0]["action"], 3) << "removes those of an earlier message";
  EXPECT_EQ(markers[1]["pose"]["position"], json({{"x", -1.0}, {"y", -2.0}, {"z", 2.8}}));
  EXPECT_EQ(markers[1]["id"], 4);
  EXPECT_EQ(markers[2]["text"], "4 ok");
  EXPECT_EQ(markers.back()["text"], "9 ok");
  EXPECT_THAT(content["channels"]["/groma/anchors"]["metadata"]["offered_qos_profiles"].get<std::string>(),
              HasSubstr("durability: 1"));
  const std::vector<json> diagnostics = of(content, "/diagnostics");
  EXPECT_GE(diagnostics.size(), 12U);
  const json status = diagnostics.back()["value"]["status"][0];
  EXPECT_EQ(status["level"], 0);
  EXPECT_EQ(status["message"], "TRACKING");
  EXPECT_EQ(status["values"][0]["key"], "sigma_x_m");
}

// A log that a power cut ended within a frame.
TEST_F(NpmConvert, ATornLogIsConvertedUpToTheCut) {
  const std::string log = test::read_text(folder_ / "drive.glog");
  folder_.write("drive.glog", log.substr(0, log.size() / 2));
  for (const char* option : {"", "--ros2"}) {
    const std::string format(option);
    const ChildResult result = convert(format.empty() ? std::vector<std::string>{} : std::vector{format});
    EXPECT_EQ(result.exit_code, 3) << result.err;
    EXPECT_THAT(result.err, HasSubstr("bytes of the log are damaged and were skipped"));
    const json content = read();
    EXPECT_GT(of(content, "/groma/input/odometry").size(), run_.odometry.size() / 2);
    EXPECT_GT(of(content, "/groma/ranges").size(), 10U);
    EXPECT_LT(of(content, "/groma/ranges").size(), run_.ranges.size() / 6);
  }
}

}  // namespace
}  // namespace groma
