#include "host/daemon/config.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <string>

#include "host/io/error.hpp"
#include "test/host/daemon/temporary_folder.hpp"

namespace groma::daemon {
namespace {

using groma::test::TemporaryFolder;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

constexpr const char* kGood = R"(schema: 1
nodes:
  - {path: tag-1, baud: 115200}
  - {path: /dev/ttyACM7}
robot_socket: robot.sock
tags:
  - {id: 2, lever_arm_m: [-0.3, 0.1, 0.6]}
  - {id: 1, lever_arm_m: [0.3, 0.2, 0.5]}
odometry: {sigma_vx_mps: 0.05, sigma_vy_mps: 0.04, sigma_omega_radps: 0.01}
range: {sigma_m: 0.12, beta_m: [0.3, 0.4], gamma: [1.0, 0.004]}
surface: {type: plane, z_m: 0.5, normal: [0, 0, 1]}
calibration: {drive_s: 120, output: kept.yaml}
model: inflated
pose_stream: {address: "::1", port: 4000}
reorder_lag_s: 0.3
speed: 4
)";

class ConfigFile : public ::testing::Test {
 protected:
  Config read(const std::string& text) { return read_config(folder_.write("gromad.yaml", text)); }

  // The error message for the good file with one text replaced.
  std::string error_with(const std::string& from, const std::string& to) {
    std::string text = kGood;
    const std::size_t at = text.find(from);
    EXPECT_NE(at, std::string::npos) << from;
    text.replace(at, from.size(), to);
    try {
      read(text);
    } catch (const io::ConfigError& error) {
      return error.what();
    }
    return "no error";
  }

  TemporaryFolder folder_;
};

TEST_F(ConfigFile, HasASteeringInPlaceOfOdometry) {
  const std::string odometry =
      "odometry: {sigma_vx_mps: 0.05, sigma_vy_mps: 0.04, sigma_omega_radps: 0.01}\n";
  std::string text = kGood;
  text.replace(text.find(odometry), odometry.size(),
               "steering: {wheelbase_m: 1.6, rear_axle_x_m: -0.5, sigma_speed_mps: 0.03}\n");
  const Config config = read(text);
  ASSERT_TRUE(config.steering);
  EXPECT_EQ(config.steering->wheelbase_m, 1.6);
  EXPECT_EQ(config.steering->rear_axle_x_m, -0.5);
  EXPECT_EQ(config.odometry.sigma_vx_mps, 0.03);
  EXPECT_THAT(error_with(odometry, ""), HasSubstr("has neither 'odometry' nor 'steering'"));
  EXPECT_THAT(error_with(odometry, odometry + "steering: {wheelbase_m: 1.6}\n"),
              HasSubstr("has both 'odometry' and 'steering'"));
  EXPECT_THAT(error_with(odometry, "steering: {wheelbase_m: 0}\n"), HasSubstr("steering.wheelbase_m"));
}

TEST_F(ConfigFile, IsReadAgainFromTheTextsThatItKept) {
  const std::filesystem::path path =
      folder_.write("gromad.yaml", kGood + std::string("ring: {folder: kept}\n"));
  const Config config = read_config(path);
  ASSERT_TRUE(config.ring);
  EXPECT_EQ(config.ring->folder, folder_ / "kept");
  EXPECT_EQ(config.ring->size_mib, 256U);
  std::filesystem::remove(path);
  const ConfigReading again = parse_config(path, config.files);
  EXPECT_TRUE(again.problems.empty());
  EXPECT_EQ(again.config.values, config.values);
  EXPECT_EQ(again.config.files, config.files);
  EXPECT_FALSE(parse_config(path).problems.empty());
}

TEST_F(ConfigFile, ReadsLearnAndLog) {
  const auto with = [&](const std::string& calibration, const std::string& more = "") {
    std::string text = kGood;
    const std::string line = "calibration: {drive_s: 120, output: kept.yaml}";
    text.replace(text.find(line), line.size(), "calibration: " + calibration);
    return read(text + more);
  };
  Config config = with("{learn: true}", "log: drive.glog\n");
  EXPECT_TRUE(config.calibration.learn);
  EXPECT_FALSE(config.calibration.file || config.calibration.output);
  EXPECT_EQ(config.log, folder_ / "drive.glog");
  EXPECT_EQ(config.description().back().name, "dataset.yaml");
  config = with("{learn: true, file: a.yaml, output: b.yaml}");
  EXPECT_EQ(config.calibration.file, folder_ / "a.yaml");
  EXPECT_EQ(config.calibration.output, folder_ / "b.yaml");
  EXPECT_FALSE(config.log);
  EXPECT_FALSE(with("{learn: false, file: a.yaml}").calibration.learn);

  const std::string line = "{drive_s: 120, output: kept.yaml}";
  EXPECT_THAT(error_with(line, "{learn: true, drive_s: 120}"),
              HasSubstr("calibration.drive_s cannot be combined with"));
  EXPECT_THAT(error_with(line, "{learn: maybe}"), HasSubstr("calibration.learn"));
  EXPECT_THAT(
      error_with(line, "site.yaml"),
      HasSubstr("calibration needs keys, and is a single value; write it as {file: ...}; its keys are file, "
                "drive_s, learn, output"));
  EXPECT_THAT(error_with("model: inflated", "model: smidt"),
              HasSubstr("model is 'smidt'; did you mean 'schmidt'? it has to be one of odometry, "));
  EXPECT_THAT(error_with(line, "{file: a.yaml, output: b.yaml}"), HasSubstr("requires 'drive_s' or 'learn'"));
  EXPECT_THAT(error_with("speed: 4", "log: ''"), HasSubstr("log is empty"));
}

TEST_F(ConfigFile, ReadsEachKey) {
  const Config config = read(kGood);
  ASSERT_EQ(config.nodes.size(), 2U);
  EXPECT_EQ(config.nodes[0].path, folder_ / "tag-1");
  EXPECT_EQ(config.nodes[0].baud, 115200U);
  EXPECT_EQ(config.nodes[1].path, "/dev/ttyACM7");
  EXPECT_EQ(config.nodes[1].baud, 1'000'000U);
  EXPECT_EQ(config.robot_socket, folder_ / "robot.sock");
  ASSERT_EQ(config.tags.size(), 2U);
  EXPECT_EQ(config.tags[0].id, 1);
  EXPECT_EQ(config.tags[1].lever_arm_m, Eigen::Vector3d(-0.3, 0.1, 0.6));
  EXPECT_EQ(config.odometry.sigma_vy_mps, 0.04);
  EXPECT_EQ(config.range.beta_m.sigma, 0.4);
  EXPECT_EQ(config.surface.at(3.0, 4.0).z_m, 0.5);
  EXPECT_FALSE(config.calibration.file);
  EXPECT_EQ(config.calibration.drive_s, 120.0);
  EXPECT_EQ(config.calibration.output, folder_ / "kept.yaml");
  EXPECT_EQ(config.model, filter::Model::kInflated);
  EXPECT_EQ(config.pose_stream.address, "::1");
  EXPECT_EQ(config.pose_stream.port, 4000);
  EXPECT_EQ(config.reorder_lag_s, 0.3);
  EXPECT_EQ(config.speed, 4.0);
  EXPECT_EQ(config.filter_config().range_sigma_m, 0.12);
  EXPECT_EQ(config.filter_config().odometry.sigma_vy_mps, 0.04);
}

TEST_F(ConfigFile, ServesOnlyThisComputerByDefault) {
  std::string text = kGood;
  text.resize(text.find("model:"));
  const Config config = read(text);
  EXPECT_EQ(config.pose_stream.address, "127.0.0.1");
  EXPECT_EQ(config.pose_stream.port, 4721);
  EXPECT_FALSE(config.web);
  EXPECT_EQ(config.speed, 1.0);
  EXPECT_EQ(config.model, filter::Config{}.model);
}

TEST_F(ConfigFile, ReadsTheWebServer) {
  const Config config = read(std::string(kGood) + "web: {}\n");
  ASSERT_TRUE(config.web);
  EXPECT_EQ(config.web->endpoint.port, 4722);
  EXPECT_THAT(error_with("speed: 4", "web: {prot: 80}"), HasSubstr("prot"));
}

TEST_F(ConfigFile, ReadsRos2) {
  Config config = read(std::string(kGood) + "ros2: {}\n");
  ASSERT_TRUE(config.ros2);
  EXPECT_EQ(config.ros2->domain_id, 0U);
  EXPECT_EQ(config.ros2->name_space, "groma");
  EXPECT_TRUE(config.ros2->publishes_tf);
  EXPECT_EQ(config.ros2->odometry_topic, "") << "the robot's socket has it";
  EXPECT_EQ(config.ros2->initialpose, "/initialpose");
  EXPECT_EQ(config.robot_links(), 2U);
  std::string alone = kGood;
  const std::size_t at = alone.find("robot_socket");
  alone.erase(at, alone.find('\n', at) + 1 - at);
  config = read(alone +
                "ros2: {domain_id: 7, graph: iron, publish_tf: false, datum: [1, 2, 3], fix_topic: /fix}\n");
  EXPECT_EQ(config.ros2->odometry_topic, "/odom");
  EXPECT_EQ(config.ros2->graph, Ros2Settings::Graph::kIron);
  EXPECT_FALSE(config.ros2->publishes_tf);
  EXPECT_EQ(config.ros2->datum->longitude_deg, 2.0);
  EXPECT_EQ(config.robot_links(), 1U);
  EXPECT_THAT(error_with("speed: 4", "ros2: {domain_id: 233}"), HasSubstr("ros2.domain_id"));
  EXPECT_THAT(error_with("speed: 4", "ros2: {graph: jazzy}"), HasSubstr("ros2.graph"));
  EXPECT_THAT(error_with("speed: 4", "ros2: {odometry_topic: odom}"), HasSubstr("is no name of a topic"));
  EXPECT_THAT(error_with("speed: 4", "ros2: {namespace: /groma/}"), HasSubstr("without slashes at its ends"));
  EXPECT_THAT(error_with("speed: 4", "ros2: {odom_frame: /odom}"), HasSubstr("without a slash in front"));
  EXPECT_THAT(error_with("speed: 4", "ros2: {fix_topic: /fix}"), HasSubstr("needs 'datum'"));
  EXPECT_THAT(error_with("speed: 4", "ros2: {datum: [91, 0, 0]}"), HasSubstr("is beyond the Earth"));
}

TEST_F(ConfigFile, NamesThePlaceOfEachMistake) {
  const std::string file = (folder_ / "gromad.yaml").string();
  EXPECT_THAT(error_with("speed: 4", "spede: 4"), HasSubstr(file + ":16:1: "));
  EXPECT_THAT(error_with("speed: 4", "spede: 4"),
              HasSubstr("unknown key 'spede'; did you mean 'speed'? known here: schema, "));
  EXPECT_THAT(error_with("baud: 115200", "boud: 115200"), HasSubstr(file + ":3:19: "));
  EXPECT_THAT(error_with("baud: 115200", "baud: fast"), HasSubstr(file + ":3:25: "));
  EXPECT_THAT(error_with("/dev/ttyACM7", "tag-1"), HasSubstr("twice"));
  EXPECT_THAT(error_with("schema: 1", "schema: 2"), HasSubstr("schema"));
  EXPECT_THAT(error_with("id: 2", "id: 1"), HasSubstr("twice"));
  EXPECT_THAT(error_with("id: 2", "id: 70000"), HasSubstr(file + ":7:"));
  EXPECT_THAT(error_with("0.1, 0.6]", "0.6]"), HasSubstr("lever_arm_m"));
  EXPECT_THAT(error_with("sigma_vx_mps: 0.05", "sigma_vx_mps: .nan"), HasSubstr(file + ":9:"));
  EXPECT_THAT(error_with("normal: [0, 0, 1]", "normal: [0, 0, -1]"), HasSubstr("normal"));
  EXPECT_THAT(error_with("drive_s: 120", "drive_s: 1"), HasSubstr("from 10 to 3600"));
  EXPECT_THAT(error_with("drive_s: 120", "file: a.yaml"), HasSubstr("output"));
  EXPECT_THAT(error_with("drive_s: 120, output: kept.yaml", ""), HasSubstr("either"));
  EXPECT_THAT(error_with("inflated", "magic"), HasSubstr("schmidt"));
  EXPECT_THAT(error_with("\"::1\"", "localhost"), HasSubstr("127.0.0.1"));
  EXPECT_THAT(error_with("port: 4000", "port: 66000"), HasSubstr(file + ":14:"));
  EXPECT_THAT(error_with("reorder_lag_s: 0.3", "reorder_lag_s: 3"), HasSubstr("reorder_lag_s"));
  EXPECT_THAT(error_with("speed: 4", "speed: 0"), HasSubstr("speed"));
  EXPECT_THAT(error_with("robot_socket: robot.sock\n", ""), HasSubstr("robot_socket"));
  EXPECT_THAT(error_with("  - {id: 2", "  - {id: 2\n  ]"), HasSubstr(file + ":"));
}

TEST_F(ConfigFile, KeepsThePathsOfNodesOnACanBus) {
  std::string text = kGood;
  text.replace(text.find("tag-1, baud: 115200"), 19, "can:can0/2");
  text.replace(text.find("/dev/ttyACM7"), 12, "canfd:can1/2");
  const Config config = read(text);
  ASSERT_EQ(config.nodes.size(), 2U);
  EXPECT_EQ(config.nodes[0].path, "can:can0/2");
  EXPECT_EQ(config.nodes[1].path, "canfd:can1/2");
  EXPECT_LT(config.nodes[0].baud, config.nodes[1].baud);

  const std::string file = (folder_ / "gromad.yaml").string();
  EXPECT_THAT(error_with("/dev/ttyACM7", "can:can0"), HasSubstr(file + ":4:12: "));
  EXPECT_THAT(error_with("/dev/ttyACM7", "can:can0"), HasSubstr("can:can0/3"));
  EXPECT_THAT(error_with("/dev/ttyACM7", "can:can0/1, baud: 9600"), HasSubstr("ip link"));
  EXPECT_THAT(error_with("/dev/ttyACM7}", "can:can0/1}\n  - {path: canfd:can0/1}"), HasSubstr("twice"));
}

TEST_F(ConfigFile, KeepsTheAddressesOfSerialServersAndUsbDevices) {
  std::string text = kGood;
  text.replace(text.find("path: tag-1"), 11, "path: tcp://gate:4001");
  text.replace(text.find("path: /dev/ttyACM7"), 18, "serial: 000760123456");
  const Config config = read(text);
  EXPECT_EQ(config.nodes[0].path, "tcp://gate:4001");
  EXPECT_EQ(config.nodes[0].baud, 115200U);
  EXPECT_EQ(config.nodes[1].path, "serial:000760123456");

  const std::string second = "path: /dev/ttyACM7}";
  EXPECT_THAT(error_with(second, "path: tcp://gate}"),
              HasSubstr(":4:12: nodes[1].path is no address; write it"));
  EXPECT_THAT(error_with(second, "baud: 115200}"), HasSubstr("nodes[1] must have either 'path' or 'serial'"));
  EXPECT_THAT(error_with(second, "path: tag, serial: '7'}"),
              HasSubstr("must have either 'path' or 'serial'"));
  EXPECT_THAT(error_with(second, "path: can:can0/1, serial: '7'}"),
              HasSubstr("cannot be combined with a node"));
  EXPECT_THAT(error_with(second, "serial: ''}"), HasSubstr("nodes[1].serial is empty"));
  EXPECT_THAT(error_with(second, "serial: '007'}\n  - {serial: '7'}"), HasSubstr("nodes[2] is given twice"));
}

TEST_F(ConfigFile, KnowsWhereTheRobotsLinesComeFrom) {
  const std::string socket = "robot_socket: robot.sock";
  const auto with = [&](const std::string& robot) {
    std::string text = kGood;
    text.replace(text.find(socket), socket.size(), robot);
    return read(text);
  };
  EXPECT_EQ(with("robot_socket: tcp://robot:4723").robot_socket, "tcp://robot:4723");
  EXPECT_THAT(with("robot: {listen: robot.sock}").robot_listen, ElementsAre(folder_ / "robot.sock"));
  const Config config = with("robot: {listen: 'udp://[::1]:4723'}");
  EXPECT_THAT(config.robot_listen, ElementsAre("udp://[::1]:4723"));
  EXPECT_TRUE(config.robot_socket.empty());
  EXPECT_FALSE(config.robot_can);

  EXPECT_THAT(error_with(socket, "robot: {listen: 'tcp://here:4723'}"),
              HasSubstr("write tcp://127.0.0.1:4723"));
  EXPECT_THAT(error_with(socket, "robot: {listen: 'tcp://127.0.0.1'}"),
              HasSubstr("robot.listen is no address"));
  EXPECT_THAT(error_with(socket, "robot: {listen: a, can: can0}"), HasSubstr("robot lacks the key dbc"));
  EXPECT_THAT(error_with(socket, "robot: {}"), HasSubstr("robot lacks the key can"));
  EXPECT_THAT(error_with(socket, "robot: a"),
              HasSubstr("robot needs keys, and is a single value; write it as {listen: ...}; its keys are "
                        "listen, can, dbc, signals"));
}

TEST_F(ConfigFile, ReadsASplineFromItsFolder) {
  std::string rows = "# grid\n0,0,10,10,4,4\n";
  for (int i = 0; i < 4; ++i) rows += "1.5,1.5,1.5,1.5\n";
  folder_.write("surface.csv", rows);
  std::string text = kGood;
  const std::string plane = "{type: plane, z_m: 0.5, normal: [0, 0, 1]}";
  text.replace(text.find(plane), plane.size(), "{type: bspline, file: surface.csv}");
  EXPECT_NEAR(read(text).surface.at(5.0, 5.0).z_m, 1.5, 1e-12);
  folder_.write("surface.csv", "0,0,10,10,4,4\n1,2\n");
  EXPECT_THROW(read(text), io::DataError);
}

}  // namespace
}  // namespace groma::daemon
