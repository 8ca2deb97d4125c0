#include "host/daemon/robot_can.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <array>
#include <string>
#include <vector>

#include "host/daemon/config.hpp"
#include "host/daemon/robot_input.hpp"
#include "host/io/error.hpp"
#include "test/host/daemon/temporary_folder.hpp"

namespace groma::daemon {
namespace {

using groma::test::TemporaryFolder;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

constexpr const char* kDbc = R"(BO_ 257 Drive: 8 Base
 SG_ Speed : 0|16@1- (0.001,0) [-20|20] "m/s" Robot
 SG_ Side : 23|16@0- (0.5,0) [0|0] "mm/s" Robot
 SG_ Rate : 32|16@1- (0.01,0) [0|0] "deg/s" Robot
 SG_ Kmh : 0|16@1- (0.01,0) [0|0] "km/h" Robot
 SG_ Wheel : 0|16@1- (1,0) [0|0] "rpm" Robot
 SG_ Plain : 0|16@1- (0.001,0) [0|0] "" Robot
 SG_ Coarse : 0|16@1- (1,0) [0|0] "m/s" Robot
 SG_ Tiny : 0|8@1+ (0.0001,0) [0|0] "m/s" Robot
 SG_ Long : 60|16@1- (0.001,0) [0|0] "m/s" Robot
BO_ 2566914078 Imu: 4 Base
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" Robot
 SG_ RateZ m2 : 8|16@1- (0.001,0) [-30|30] "rad/s" Robot
 SG_ Turn m2 : 8|16@1- (0.1,0) [0|0] ")"
                             "\xB0/s"
                             R"(" Robot
)";

class RobotCan : public ::testing::Test {
 protected:
  Config read(const std::string& signals, const std::string& more = "") {
    folder_.write("robot.dbc", kDbc);
    return read_config(folder_.write("gromad.yaml", R"(schema: 1
nodes: [{path: can:can0/1}]
tags: [{id: 1, lever_arm_m: [0, 0, 0]}]
odometry: {sigma_vx_mps: 0.05, sigma_vy_mps: 0.04, sigma_omega_radps: 0.01}
range: {sigma_m: 0.12}
surface: {type: plane, z_m: 0.5, normal: [0, 0, 1]}
calibration: {drive_s: 120}
robot:
  can: can0
  dbc: robot.dbc
  signals: )" + signals + "\n" + more));
  }
  std::string error_with(const std::string& signals, const std::string& more = "") {
    try {
      read(signals, more);
    } catch (const io::ConfigError& error) {
      return error.what();
    }
    return "no error";
  }
  // With this for vx_mps.
  std::string error_of_speed(const std::string& speed) {
    return error_with("{vx_mps: " + speed + ", omega_radps: {signal: Drive.Rate, scale: 0.0175}}");
  }

  TemporaryFolder folder_;
};

// The messages of lines, as gromad reads them from a socket.
std::vector<RobotMessage> messages_in(const std::string& lines) {
  RobotInput input;
  input.push({reinterpret_cast<const std::uint8_t*>(lines.data()), lines.size()});
  std::vector<RobotMessage> messages;
  while (auto message = input.next()) messages.push_back(*message);
  EXPECT_EQ(input.counters().dropped(), 0U) << input.last_problem();
  return messages;
}

constexpr const char* kOneMessage =
    "{vx_mps: Drive.Speed, vy_mps: {signal: Drive.Side, scale: 0.001}, omega_radps: "
    "{signal: Drive.Rate, scale: -0.017453292519943295}}";

TEST_F(RobotCan, GivesOdometryOfOneMessage) {
  CanSignalDecoder decoder(*read(kOneMessage).robot_can);
  std::string lines;
  // 1.25 m/s; -200 steps of 0.5 mm/s, big-endian; 4500 steps of 0.01 deg/s.
  const std::array<std::uint8_t, 8> payload{0xE2, 0x04, 0xFF, 0x38, 0x94, 0x11, 0, 0};
  decoder.take(257, payload, 1.7e9 + 0.25, lines);
  decoder.take(258, payload, 1.7e9 + 0.26, lines);
  decoder.take(257 | CAN_EFF_FLAG, payload, 1.7e9 + 0.27, lines);
  const std::vector<RobotMessage> messages = messages_in(lines);
  ASSERT_EQ(messages.size(), 1U);
  const auto& odometry = std::get<model::OdometrySample>(messages[0]);
  EXPECT_EQ(odometry.t_s, 1.7e9 + 0.25);
  EXPECT_DOUBLE_EQ(odometry.vx_mps, 1.25);
  EXPECT_DOUBLE_EQ(odometry.vy_mps, -0.1);
  EXPECT_DOUBLE_EQ(odometry.omega_radps, -0.78539816339744828);
  EXPECT_EQ(decoder.counters().samples, 1U);
  EXPECT_EQ(decoder.counters().bad_value, 0U);
}

TEST_F(RobotCan, WaitsForEachMessageOfASample) {
  CanSignalDecoder decoder(
      *read("{vx_mps: Drive.Speed, omega_radps: Imu.RateZ, imu_omega_radps: Imu.RateZ}").robot_can);
  std::string lines;
  const std::uint32_t imu = 2566914078U;
  decoder.take(257, std::array<std::uint8_t, 8>{0xE8, 0x03}, 1.0, lines);
  decoder.take(257, std::array<std::uint8_t, 8>{0xD0, 0x07}, 1.1, lines);
  decoder.take(imu, std::array<std::uint8_t, 4>{1, 0xFF, 0x00}, 1.15, lines);
  EXPECT_THAT(lines, IsEmpty()) << "another page of the multiplexed message";
  decoder.take(imu, std::array<std::uint8_t, 4>{2, 0xF4, 0x01}, 1.2, lines);
  decoder.take(imu, std::array<std::uint8_t, 4>{2, 0xF4, 0x01}, 1.3, lines);
  const std::vector<RobotMessage> messages = messages_in(lines);
  ASSERT_EQ(messages.size(), 3U);
  const auto& odometry = std::get<model::OdometrySample>(messages[0]);
  EXPECT_EQ(odometry.t_s, 1.2);
  EXPECT_EQ(odometry.vx_mps, 2.0);
  EXPECT_EQ(odometry.vy_mps, 0.0);
  EXPECT_EQ(odometry.omega_radps, 0.5);
  for (std::size_t i = 1; i < 3; ++i) {
    const auto& rate = std::get<model::YawRateSample>(std::get<model::SensorSample>(messages[i]));
    EXPECT_EQ(rate.t_s, i == 1 ? 1.2 : 1.3);
    EXPECT_EQ(rate.omega_radps, 0.5);
  }
}

TEST_F(RobotCan, CountsValuesThatAreNotUsed) {
  CanSignalDecoder decoder(*read(kOneMessage).robot_can);
  std::string lines;
  decoder.take(257, std::array<std::uint8_t, 8>{0xFF, 0x7F}, 1.0, lines);  // signal not available: 32.767 m/s
  EXPECT_EQ(decoder.counters().bad_value, 1U);
  EXPECT_THAT(decoder.last_problem(), HasSubstr("Drive.Speed is 32.767"));
  decoder.take(257, std::array<std::uint8_t, 5>{}, 1.1, lines);
  EXPECT_EQ(decoder.counters().bad_value, 2U);
  EXPECT_THAT(decoder.last_problem(), HasSubstr("a frame of Drive.Rate has 5 bytes only"));
  EXPECT_THAT(lines, IsEmpty());
  decoder.take(257, std::array<std::uint8_t, 8>{0x20, 0x4E}, 1.2, lines);  // the bound itself
  EXPECT_EQ(messages_in(lines).size(), 1U);
}

TEST_F(RobotCan, ChecksUnitsAndScales) {
  EXPECT_EQ(error_of_speed("Drive.Speed"), "no error");
  EXPECT_EQ(error_of_speed("{signal: Drive.Speed, scale: -1.03}"), "no error");
  const std::string file = (folder_ / "gromad.yaml").string();
  EXPECT_THAT(error_of_speed("Drive.Kmh"), HasSubstr(file + ":11:21: robot.signals.vx_mps is in 'km/h' by "));
  EXPECT_THAT(error_of_speed("Drive.Kmh"),
              HasSubstr("robot.dbc:5:6, not in m/s; write {signal: Drive.Kmh, scale: 0.2777777777777778}"));
  EXPECT_EQ(error_of_speed("{signal: Drive.Kmh, scale: 0.28}"), "no error");
  EXPECT_THAT(error_of_speed("{signal: Drive.Kmh, scale: 3.6}"),
              HasSubstr("write 0.2777777777777778, or correct"));
  EXPECT_THAT(error_of_speed("{signal: Drive.Kmh, scale: 0}"), HasSubstr("is 0, and the unit in "));
  EXPECT_THAT(
      error_of_speed("Drive.Wheel"),
      HasSubstr(
          "write {signal: Drive.Wheel, scale: X}, X being 0.10471975511965977 times the wheel's radius"));
  EXPECT_EQ(error_of_speed("{signal: Drive.Wheel, scale: 0.0157}"), "no error");
  EXPECT_THAT(error_of_speed("Drive.Plain"), HasSubstr("is in no unit by "));
  EXPECT_THAT(error_of_speed("Drive.Plain"),
              HasSubstr("write {signal: Drive.Plain, scale: 1} if it is in m/s"));
  EXPECT_EQ(error_of_speed("{signal: Drive.Plain, scale: 1}"), "no error");
  EXPECT_THAT(error_of_speed("Imu.RateZ"), HasSubstr("X being 1 times the wheel's radius"));
  EXPECT_THAT(error_with("{vx_mps: Drive.Speed, omega_radps: Imu.Turn}"),
              HasSubstr("write {signal: Imu.Turn, scale: 0.017453292519943295}"));
  EXPECT_THAT(error_of_speed("Drive.Coarse"), HasSubstr("has steps of 1 m/s by its factor"));
  EXPECT_THAT(error_of_speed("Drive.Tiny"), HasSubstr("is at most 0.0256 m/s"));
}

TEST_F(RobotCan, NamesThePlaceOfEachMistake) {
  EXPECT_THAT(error_of_speed("Speed"), HasSubstr("write it as MESSAGE.SIGNAL"));
  EXPECT_THAT(error_of_speed("Driver.Speed"), HasSubstr("name one of its messages: Drive, Imu"));
  EXPECT_THAT(error_of_speed("Drive.Sped"), HasSubstr("name one of its signals: Speed, Side, Rate, Kmh"));
  EXPECT_THAT(error_of_speed("Drive.Long"), HasSubstr("robot.dbc:10:6: Drive.Long does not fit the 8 bytes"));
  EXPECT_THAT(error_with("{vx_mps: Drive.Speed}"), HasSubstr("robot.signals lacks the key omega_radps"));
  EXPECT_THAT(error_with("{vx_mps: Drive.Speed, omega_radps: Imu.RateZ, vz_mps: Drive.Speed}"),
              HasSubstr("unknown key 'vz_mps'"));
  const std::string good = "{vx_mps: Drive.Speed, omega_radps: Imu.RateZ}";
  EXPECT_THAT(error_with(good, "speed: 2"),
              HasSubstr(":12:8: speed cannot be combined with odometry over CAN"));
  EXPECT_EQ(error_with(good), "no error");
}

TEST_F(RobotCan, MayComeBesideJsonLines) {
  const Config config =
      read(kOneMessage, "  listen: [robot.sock, 'udp://127.0.0.1:4723']\nrobot_socket: other.sock\n");
  EXPECT_EQ(config.robot_can->interface, "can0");
  EXPECT_THAT(config.robot_listen, testing::ElementsAre(folder_ / "robot.sock", "udp://127.0.0.1:4723"));
  EXPECT_EQ(config.robot_socket, folder_ / "other.sock");
  EXPECT_THAT(error_with(kOneMessage, "  listen: [a, a]\n"), HasSubstr("robot.listen[1] is given twice"));
  EXPECT_THAT(error_with(kOneMessage, "  listen: []\n"), HasSubstr("robot.listen is empty"));
  EXPECT_THAT(error_with(kOneMessage, "  listen: ['udp://host:4723']\n"),
              HasSubstr("robot.listen[0] is not a numeric address"));
}

TEST_F(RobotCan, NamesItsInterfaceInErrors) {
  CanSignals signals = *read(kOneMessage).robot_can;
  signals.interface = "no-such-can";
  const link::OpenedLink opened = open_robot_can(signals);
  EXPECT_FALSE(opened.link);
  EXPECT_THAT(opened.error.message, HasSubstr("can:no-such-can: "));
}

}  // namespace
}  // namespace groma::daemon
