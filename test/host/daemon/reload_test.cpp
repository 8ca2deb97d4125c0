// The check of a configuration with the files that it names, and what a reload may change.
#include "host/daemon/reload.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "host/io/calibration_file.hpp"
#include "host/io/error.hpp"
#include "host/model/calibration.hpp"
#include "test/host/daemon/temporary_folder.hpp"

namespace groma::daemon {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

constexpr const char* kSmallSite = R"(schema: 1
nodes:
  - {path: tag-1}
robot_socket: robot.sock
tags:
  - {id: 1, lever_arm_m: [0.3, 0.2, 0.5]}
odometry: {sigma_vx_mps: 0.05, sigma_vy_mps: 0.04, sigma_omega_radps: 0.01}
range: {sigma_m: 0.12, beta_m: [0.3, 0.4], gamma: [1.0, 0.004]}
surface: {type: plane, z_m: 0.5, normal: [0, 0, 1]}
calibration: {file: calibration.yaml}
)";

class ReloadTest : public ::testing::Test {
 protected:
  void SetUp() override {
    write_calibration("map", {1.0, 2.0, 3.0});
    write(kSmallSite);
  }

  void write(const std::string& text) { file_ = folder_.write("gromad.yaml", text); }
  void write_calibration(const std::string& frame, const Eigen::Vector3d& at_m) {
    const std::vector<model::Anchor> anchors{{7, at_m}};
    const std::vector<model::Tag> tags{{1, {0.3, 0.2, 0.5}}};
    model::Calibration calibration = model::surveyed_calibration(anchors, tags, model::RangePriors{}, 0.1);
    calibration.frame = frame;
    folder_.write("calibration.yaml", io::format_calibration(calibration));
  }
  static std::string with(const std::string& from, const std::string& to) {
    std::string text = kSmallSite;
    const std::size_t at = text.find(from);
    EXPECT_NE(at, std::string::npos) << from;
    return text.replace(at, from.size(), to);
  }
  [[nodiscard]] std::string at(int line, int column) const {
    return file_.string() + ":" + std::to_string(line) + ":" + std::to_string(column) + ": ";
  }

  groma::test::TemporaryFolder folder_;
  std::filesystem::path file_;
};

TEST_F(ReloadTest, CheckFindsNothingInAGoodFile) {
  EXPECT_THAT(check_config(file_), IsEmpty());
}

TEST_F(ReloadTest, CheckReportsAllErrorsAtTheirPlacesWithTheKeysAllowed) {
  std::string text = with("id: 1, lever_arm_m: [0.3, 0.2, 0.5]", "id: 99999, lever: [0.3, 0.2]");
  text.replace(text.find("sigma_vx_mps: 0.05"), 18, "sigma_vx_mps: -1.0");
  text.replace(text.find("normal: [0, 0, 1]"), 17, "normal: [0, 0, 0]");
  text.replace(text.find("robot_socket: robot.sock\n"), 25, "robot_scket: robot.sock\n");
  write(text + "speed: fast\n");
  EXPECT_THAT(
      check_config(file_),
      ElementsAre(HasSubstr(at(1, 1) + "has neither 'robot_socket' nor 'robot'"),
                  testing::AllOf(HasSubstr(at(4, 1) + "unknown key 'robot_scket'"), HasSubstr("pose_stream")),
                  HasSubstr(at(6, 5) + "tags[0] lacks the key lever_arm_m"),
                  HasSubstr(at(6, 10) + "tags[0].id is 99999"),
                  testing::AllOf(HasSubstr(at(6, 17) + "unknown key 'lever'"),
                                 HasSubstr("known here: id, lever_arm_m")),
                  HasSubstr(at(7, 26) + "odometry.sigma_vx_mps is -1"),
                  HasSubstr(at(9, 42) + "surface.normal does not point up"),
                  HasSubstr(at(11, 8) + "speed is not a number")));
}

TEST_F(ReloadTest, CheckReadsTheFilesThatAreNamed) {
  folder_.write("calibration.yaml", "schema: 1\nfraem: map\n");
  EXPECT_THAT(check_config(file_), ElementsAre(HasSubstr("calibration.yaml:")));
  write(with("file: calibration.yaml", "file: other.yaml"));
  EXPECT_THAT(check_config(file_),
              ElementsAre(testing::AllOf(HasSubstr(at(10, 14)), HasSubstr("other.yaml: does not exist"))));
  write("schema: [\n");
  EXPECT_THAT(check_config(file_), ElementsAre(HasSubstr("invalid YAML")));
  EXPECT_THAT(check_config(folder_ / "none.yaml"), ElementsAre(HasSubstr("none.yaml: does not exist")));
}

TEST_F(ReloadTest, TakesAnotherCalibrationAndLeverArm) {
  const Config current = read_config(file_);
  write_calibration("map", {4.0, 5.0, 6.0});
  write("# a comment\n" + with("[0.3, 0.2, 0.5]", "[0.3, 0.2, 0.6]"));
  const Reload reload = prepare_reload(current, "map");
  EXPECT_THAT(reload.problems, IsEmpty());
  ASSERT_TRUE(reload.calibration);
  EXPECT_EQ(reload.calibration->anchors.front().position_m.x(), 4.0);
  EXPECT_EQ(reload.config.tags.front().lever_arm_m.z(), 0.6);
}

TEST_F(ReloadTest, RefusesTheWholeIfOneKeyNeedsARestart) {
  const Config current = read_config(file_);
  write(with("[0.3, 0.2, 0.5]", "[0.3, 0.2, 0.6]") + "speed: 2\n");
  EXPECT_THAT(prepare_reload(current, "map").problems,
              ElementsAre(HasSubstr(at(11, 8) + "speed has changed; restart gromad for it")));
  write(with("id: 1", "id: 2"));
  EXPECT_THAT(prepare_reload(current, "map").problems, ElementsAre(HasSubstr("tags has changed")));
  write(with("{file: calibration.yaml}", "{drive_s: 60}"));
  EXPECT_THAT(prepare_reload(current, "map").problems, ElementsAre(HasSubstr("calibration has changed")));
  write(with("sigma_m: 0.12", "sigma_m: x"));
  EXPECT_THAT(prepare_reload(current, "map").problems,
              ElementsAre(HasSubstr("range.sigma_m is not a number")));
  write(kSmallSite);
  write_calibration("other", {4.0, 5.0, 6.0});
  EXPECT_THAT(prepare_reload(current, "map").problems,
              ElementsAre(HasSubstr("its frame is 'other', not 'map'")));
}

}  // namespace
}  // namespace groma::daemon
