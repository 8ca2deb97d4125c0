#include "host/daemon/robot_input.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "test/support/allocations.hpp"

namespace groma::daemon {
namespace {

constexpr std::string_view kOdometry =
    R"({"class":"ODOMETRY","t_s":1.5,"vx_mps":0.5,"vy_mps":-0.25,"omega_radps":0.125})";

void push(RobotInput& input, std::string_view text) {
  input.push(std::vector<std::uint8_t>(text.begin(), text.end()));
}

std::vector<RobotMessage> take_all(RobotInput& input) {
  std::vector<RobotMessage> all;
  while (auto message = input.next()) all.push_back(*message);
  return all;
}

TEST(RobotInput, ReadsBothClasses) {
  RobotInput input;
  push(
      input,
      std::string(kOdometry) + "\r\n\n" +
          R"({"class":"POSE_PRIOR","t_s":2,"x_m":1,"y_m":2,"z_m":3,"yaw_rad":0.5,"source":"slam"})"
          "\n" +
          R"({"class":"POSE_PRIOR","t_s":3,"x_m":1,"y_m":2,"z_m":3,"yaw_rad":0.5,"roll_rad":0.1,"pitch_rad":null})"
          "\n");
  const auto messages = take_all(input);
  ASSERT_EQ(messages.size(), 3U);
  const auto& odometry = std::get<model::OdometrySample>(messages[0]);
  EXPECT_EQ(odometry.t_s, 1.5);
  EXPECT_EQ(odometry.vx_mps, 0.5);
  EXPECT_EQ(odometry.vy_mps, -0.25);
  EXPECT_EQ(odometry.omega_radps, 0.125);
  const auto& pose = std::get<model::PoseSample>(messages[1]);
  EXPECT_EQ(pose.t_s, 2.0);
  EXPECT_EQ(pose.z_m, 3.0);
  EXPECT_TRUE(std::isnan(pose.roll_rad));
  EXPECT_EQ(std::get<model::PoseSample>(messages[2]).roll_rad, 0.1);
  EXPECT_TRUE(std::isnan(std::get<model::PoseSample>(messages[2]).pitch_rad));
  EXPECT_EQ(input.counters().odometry, 1U);
  EXPECT_EQ(input.counters().pose_priors, 2U);
  EXPECT_EQ(input.counters().dropped(), 0U);
}

TEST(RobotInput, ReadsThePoseInOdomBesideOdometry) {
  RobotInput input;
  const std::string head = R"({"class":"ODOMETRY","t_s":2,"vx_mps":0,"vy_mps":0,"omega_radps":0,"odom":)";
  push(input, head + "[1,2,3,0,0,0.6,0.8]}\n");
  ASSERT_EQ(take_all(input).size(), 1U);
  ASSERT_TRUE(input.odom_pose());
  EXPECT_EQ(input.odom_pose()->t_s, 2.0);
  EXPECT_EQ(input.odom_pose()->pose.quaternion.z(), 0.6);
  push(input, std::string(kOdometry) + "\n");
  ASSERT_EQ(take_all(input).size(), 1U);
  EXPECT_FALSE(input.odom_pose());
  for (const char* wrong : {"[1,2,3,0,0,0,0]", "[1,2,3]", "[1,2,null,0,0,0,1]", "7"}) {
    push(input, head + wrong + "}\n");
    EXPECT_TRUE(take_all(input).empty()) << wrong;
  }
  EXPECT_EQ(input.counters().bad_value, 4U);
}

TEST(RobotInput, AnInitialPoseHoldsNowOrAtItsTime) {
  RobotInput input;
  push(input, R"({"class":"INITIAL_POSE","x_m":1,"y_m":2,"yaw_rad":0.5})"
              "\n"
              R"({"class":"INITIAL_POSE","t_s":4,"x_m":1,"y_m":2,"yaw_rad":0.5})"
              "\n"
              R"({"class":"INITIAL_POSE","t_s":"4","x_m":1,"y_m":2,"yaw_rad":0.5})"
              "\n");
  const auto messages = take_all(input);
  ASSERT_EQ(messages.size(), 2U);
  EXPECT_TRUE(std::get<InitialPose>(messages[0]).is_now);
  EXPECT_FALSE(std::get<InitialPose>(messages[1]).is_now);
  EXPECT_EQ(std::get<InitialPose>(messages[1]).pose.t_s, 4.0);
  EXPECT_EQ(input.counters().bad_value, 1U);
}

// A covariance as in the pose stream: 6 x 6, of which the terms of x, y and yaw are used.
std::string pose_with(const std::string& covariance) {
  return R"({"class":"POSE_PRIOR","t_s":2,"x_m":1,"y_m":2,"z_m":3,"yaw_rad":0.5,"covariance":)" + covariance +
         "}\n";
}

TEST(RobotInput, ReadsThePlanarPartOfACovariance) {
  RobotInput input;
  push(input,
       pose_with("[4,1,null,null,null,0.5, 1,9,null,null,null,0.25, null,null,null,null,null,null,"
                 "null,null,null,null,null,null, null,null,null,null,null,null, 0.5,0.25,null,null,null,1]"));
  std::string unknown = "[null";
  for (int i = 1; i < 36; ++i) unknown += ",null";
  push(input, pose_with(unknown + "]"));
  push(input, pose_with("null"));
  const auto messages = take_all(input);
  ASSERT_EQ(messages.size(), 3U);
  const model::PoseCovariance expected{4.0, 1.0, 0.5, 9.0, 0.25, 1.0};
  EXPECT_EQ(std::get<model::PoseSample>(messages[0]).covariance, expected);
  EXPECT_FALSE(std::get<model::PoseSample>(messages[1]).covariance.has_value());
  EXPECT_FALSE(std::get<model::PoseSample>(messages[2]).covariance.has_value());
}

TEST(RobotInput, DropsAPoseWithAnInvalidCovariance) {
  RobotInput input;
  std::string zeros = "[0";
  std::string text = "[\"a\"";
  for (int i = 1; i < 36; ++i) {
    zeros += ",0";
    text += ",1";
  }
  push(input, pose_with("[1,0,0,1,0,1]"));
  push(input, pose_with("4"));
  push(input, pose_with(zeros + "]"));
  push(input, pose_with(text + "]"));
  // A negative variance of yaw, one unknown term, and an asymmetric pair.
  for (const std::string last : {"0,0,0,0,0,-1]", "null,0,0,0,0,1]", "0.5,0,0,0,0,1]"}) {
    push(input, pose_with("[1,0,0,0,0,0, 0,1,0,0,0,0, 0,0,1,0,0,0, 0,0,0,1,0,0, 0,0,0,0,1,0, " + last));
  }
  EXPECT_TRUE(take_all(input).empty());
  EXPECT_EQ(input.counters().bad_value, 7U);
  EXPECT_THAT(input.last_problem(), testing::HasSubstr("covariance"));
}

TEST(RobotInput, ReadsTheSteeringOfACar) {
  RobotInput input;
  push(input, R"({"class":"STEERING","t_s":1.5,"speed_mps":-0.75,"steering_rad":0.25}
{"class":"STEERING","t_s":1.6,"speed_mps":1,"steering_rad":14.3}
{"class":"STEERING","t_s":1.7,"speed_mps":1}
)");
  const auto messages = take_all(input);
  ASSERT_EQ(messages.size(), 1U);
  const auto& sample = std::get<model::SteeringSample>(messages[0]);
  EXPECT_EQ(sample.t_s, 1.5);
  EXPECT_EQ(sample.speed_mps, -0.75);
  EXPECT_EQ(sample.steering_rad, 0.25);
  EXPECT_EQ(input.counters().odometry, 1U);
  EXPECT_EQ(input.counters().bad_value, 2U);
}

TEST(RobotInput, DropsImplausiblePoses) {
  RobotInput input;
  for (const std::string line : {
           R"({"class":"POSE_PRIOR","t_s":1,"x_m":1e9,"y_m":0,"z_m":0,"yaw_rad":0})",
           R"({"class":"POSE_PRIOR","t_s":1,"x_m":0,"y_m":0,"z_m":-1e308,"yaw_rad":0})",
           R"({"class":"POSE_PRIOR","t_s":1,"x_m":0,"y_m":0,"z_m":0,"yaw_rad":1e7})",
           R"({"class":"POSE_PRIOR","t_s":1,"x_m":0,"y_m":0,"z_m":0,"yaw_rad":0,"roll_rad":3})",
           R"({"class":"GNSS","t_s":2,"x_m":3,"y_m":-1e300,"covariance":[1,0,0,1]})",
           R"({"class":"GNSS","t_s":2,"x_m":3,"y_m":4,"covariance":[1e-300,0,0,1]})",
           R"({"class":"GNSS","t_s":2,"x_m":3,"y_m":4,"covariance":[1,0,0,1e300]})",
       }) {
    push(input, line + "\n");
    EXPECT_TRUE(take_all(input).empty()) << line;
  }
  EXPECT_EQ(input.counters().bad_value, 7U);
}

TEST(RobotInput, ReadsOtherSensors) {
  RobotInput input;
  push(input, R"({"class":"IMU","t_s":1,"omega_radps":0.25}
{"class":"GNSS","t_s":2,"x_m":3,"y_m":4,"covariance":[0.5,0.125,0.125,0.25]}
{"class":"ABSOLUTE_POSE","t_s":3,"x_m":1,"y_m":2,"yaw_rad":0.5,"covariance":)" +
                  std::string("[4,1,null,null,null,0.5, 1,9,null,null,null,0.25, "
                              "null,null,null,null,null,null, null,null,null,null,null,null, "
                              "null,null,null,null,null,null, 0.5,0.25,null,null,null,1]}\n") +
                  R"({"class":"ZERO_VELOCITY","t_s":4}
)");
  const auto messages = take_all(input);
  ASSERT_EQ(messages.size(), 4U);
  std::vector<model::SensorSample> samples;
  samples.reserve(messages.size());
  for (const RobotMessage& message : messages) samples.push_back(std::get<model::SensorSample>(message));
  for (std::size_t i = 0; i < samples.size(); ++i)
    EXPECT_EQ(model::time_of(samples[i]), 1.0 + static_cast<double>(i));
  EXPECT_EQ(std::get<model::YawRateSample>(samples[0]).omega_radps, 0.25);
  const auto& position = std::get<model::PositionSample>(samples[1]);
  EXPECT_EQ(position.y_m, 4.0);
  EXPECT_EQ(position.covariance_m2, (std::array<double, 3>{0.5, 0.125, 0.25}));
  const model::PoseCovariance expected{4.0, 1.0, 0.5, 9.0, 0.25, 1.0};
  EXPECT_EQ(std::get<model::PoseSample>(samples[2]).covariance, expected);
  EXPECT_EQ(input.counters().sensors, 4U);
}

TEST(RobotInput, DropsSensorSamplesWithoutACovariance) {
  RobotInput input;
  for (const std::string line : {
           R"({"class":"GNSS","t_s":2,"x_m":3,"y_m":4})",
           R"({"class":"GNSS","t_s":2,"x_m":3,"y_m":4,"covariance":[1,0,0]})",
           R"({"class":"GNSS","t_s":2,"x_m":3,"y_m":4,"covariance":[1,0.5,0,1]})",
           R"({"class":"GNSS","t_s":2,"x_m":3,"y_m":4,"covariance":[1,2,2,1]})",
           R"({"class":"GNSS","t_s":2,"x_m":3,"y_m":4,"covariance":[1,0,0,null]})",
           R"({"class":"ABSOLUTE_POSE","t_s":3,"x_m":1,"y_m":2,"yaw_rad":0.5})",
           R"({"class":"IMU","t_s":1})",
           R"({"class":"ZERO_VELOCITY"})",
       }) {
    push(input, line + "\n");
    EXPECT_TRUE(take_all(input).empty()) << line;
  }
  EXPECT_EQ(input.counters().bad_value, 8U);
}

TEST(RobotInput, AssemblesLinesFromSingleBytes) {
  RobotInput input;
  std::size_t messages = 0;
  for (const char c : std::string(kOdometry) + "\n" + std::string(kOdometry) + "\n") {
    push(input, std::string_view(&c, 1));
    messages += take_all(input).size();
  }
  EXPECT_EQ(messages, 2U);
}

TEST(RobotInput, DropsAndCountsInvalidLines) {
  RobotInput input;
  push(input, "{\"class\":\"ODOMETRY\",\"t_s\":1.5,\"vx_m\n");
  push(input, "[1,2,3]\n");
  push(input, "\"ODOMETRY\"\n");
  push(input, std::string_view("\xff\xfe\x00 garbage\n", 12));
  EXPECT_TRUE(take_all(input).empty());
  EXPECT_EQ(input.counters().torn, 4U);

  push(input, R"({"class":"LASER","t_s":1})"
              "\n"
              R"({"t_s":1})"
              "\n"
              R"({"class":7})"
              "\n");
  EXPECT_TRUE(take_all(input).empty());
  EXPECT_EQ(input.counters().unknown_class, 3U);

  for (const std::string_view value : {"\"0.5\"", "null", "true", "[0.5]"}) {
    push(input, R"({"class":"ODOMETRY","t_s":1,"vx_mps":)" + std::string(value) +
                    R"(,"vy_mps":0,"omega_radps":0})"
                    "\n");
  }
  push(input, R"({"class":"ODOMETRY","t_s":1,"vx_mps":0,"vy_mps":0})"
              "\n");
  push(input, R"({"class":"POSE_PRIOR","t_s":1,"x_m":0,"y_m":0,"z_m":0})"
              "\n");
  push(input, R"({"class":"POSE_PRIOR","t_s":1,"x_m":0,"y_m":0,"z_m":0,"yaw_rad":0,"roll_rad":"x"})"
              "\n");
  EXPECT_TRUE(take_all(input).empty());
  EXPECT_EQ(input.counters().bad_value, 7U);
  EXPECT_THAT(input.last_problem(), testing::HasSubstr("POSE_PRIOR"));

  // NaN, Infinity and numbers beyond a double are not JSON numbers.
  for (const std::string_view value : {"NaN", "-Infinity", "1e999", "nan"}) {
    push(input, R"({"class":"ODOMETRY","t_s":1,"vx_mps":)" + std::string(value) +
                    R"(,"vy_mps":0,"omega_radps":0})"
                    "\n");
  }
  EXPECT_TRUE(take_all(input).empty());
  EXPECT_EQ(input.counters().dropped(), 18U);

  push(input, std::string(kOdometry) + "\n");
  EXPECT_EQ(take_all(input).size(), 1U);
}

TEST(RobotInput, ReadsValidLinesWithoutTheHeap) {
  const std::string covariance =
      "[4,1,null,null,null,0.5, 1,9,null,null,null,0.25, null,null,null,null,null,null,"
      "null,null,null,null,null,null, null,null,null,null,null,null, 0.5,0.25,null,null,null,1]";
  std::string lines;
  while (lines.size() < RobotInput::kReadSize) {
    lines +=
        R"({"class":"ODOMETRY","t_s":1764180750.1234567,"vx_mps":-0.12345678901234567,"vy_mps":1.25e-17,)"
        R"("omega_radps":0.125,"a key that is ignored":{"text":["of any","length \u00e4"]}})"
        "\n" +
        pose_with(covariance) + R"({"class":"GNSS","t_s":2,"x_m":3,"y_m":4,"covariance":[0.5,0,0,0.25]})" +
        "\n";
  }
  // Whole lines, of which the second push completes one.
  lines.resize(lines.rfind('\n', RobotInput::kReadSize - 1) + 1);
  const std::vector<std::uint8_t> bytes(lines.begin(), lines.end());
  const std::size_t half = bytes.size() / 2;
  RobotInput input;
  std::size_t messages = 0;
  const std::size_t before = groma::test::allocations();
  for (int i = 0; i < 2; ++i) {
    for (const auto part : {std::span(bytes).first(half), std::span(bytes).subspan(half)}) {
      input.push(part);
      while (input.next()) ++messages;
    }
  }
  EXPECT_EQ(groma::test::allocations(), before);
  EXPECT_GT(messages, 10U);
  EXPECT_EQ(input.counters().dropped(), 0U);
}

TEST(RobotInput, BoundsItsMemoryForAnyInput) {
  RobotInput input;
  for (int i = 0; i < 1000; ++i) {
    push(input, std::string(10'000, 'x'));
    EXPECT_TRUE(take_all(input).empty());
  }
  push(input, "\n" + std::string(kOdometry) + "\n");
  EXPECT_EQ(take_all(input).size(), 1U);
  EXPECT_EQ(input.counters().torn, 1U);
}

TEST(RobotInput, DiscardsAnIncompleteLineWhenTheLinkBreaks) {
  RobotInput input;
  push(input, kOdometry.substr(0, 30));
  EXPECT_TRUE(take_all(input).empty());
  input.reset();
  push(input, std::string(kOdometry) + "\n");
  EXPECT_EQ(take_all(input).size(), 1U);
  EXPECT_EQ(input.counters().torn, 1U);
}

}  // namespace
}  // namespace groma::daemon
