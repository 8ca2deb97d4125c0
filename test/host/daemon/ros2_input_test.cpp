#include "host/daemon/ros2_input.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <string>
#include <variant>

#include "host/daemon/robot_input.hpp"
#include "host/model/geographic.hpp"
#include "host/ros2/cdr_writer.hpp"
#include "host/ros2/messages.hpp"
#include "test/support/random.hpp"

namespace groma::daemon {
namespace {

using testing::HasSubstr;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr double kTime_s = 1.7e9 + 0.25;

struct Odometry {
  double t_s = kTime_s;
  std::string frame = "odom";
  std::string child = "base_link";
  double vx_mps = 0.5;
  double yaw_rad = 0.4;
  double norm = 1.0;  // of the quaternion
  double x_m = 3.0;
  bool has_twist = true;

  [[nodiscard]] std::string message() const {
    ros2::CdrWriter out;
    ros2::put_header(out, t_s, frame);
    out.put(child);
    ros2::put_pose(
        out, {{x_m, -4.0, 0.1}, {0.0, 0.0, norm * std::sin(0.5 * yaw_rad), norm * std::cos(0.5 * yaw_rad)}});
    ros2::put_covariance(out, ros2::Covariance::Identity());
    for (const double part : {vx_mps, 0.25, 0.0, 0.0, 0.0, -0.125}) out.put(has_twist ? part : 0.0);
    ros2::put_covariance(out, ros2::Covariance::Identity());
    return out.message();
  }
};

std::string pose_message(double variance = 0.25, const char* frame = "map") {
  ros2::CdrWriter out;
  ros2::put_header(out, kTime_s, frame);
  ros2::put_pose(out, {{1.0, 2.0, 0.0}, {0.0, 0.0, std::sin(0.25), std::cos(0.25)}});
  for (int i = 0; i < 36; ++i) out.put(i % 7 == 0 ? variance : 0.0);
  return out.message();
}

std::string imu_message(double omega_radps, double first_variance = 0.01) {
  ros2::CdrWriter out;
  ros2::put_header(out, kTime_s, "imu_link");
  ros2::put_quaternion(out, {0.0, 0.0, 0.0, 1.0});
  for (int i = 0; i < 9; ++i) out.put(0.0);
  ros2::put_vector(out, {0.1, 0.2, omega_radps});
  for (int i = 0; i < 9; ++i) out.put(i == 0 ? first_variance : 0.0);
  ros2::put_vector(out, {0.0, 0.0, 9.81});
  for (int i = 0; i < 9; ++i) out.put(0.0);
  return out.message();
}

std::string fix_message(double latitude_deg, double longitude_deg, int status = 0, int type = 2) {
  ros2::CdrWriter out;
  ros2::put_header(out, kTime_s, "gnss");
  out.put(static_cast<std::int8_t>(status)).put(std::uint16_t{1});
  out.put(latitude_deg).put(longitude_deg).put(300.0);
  for (const double term : {4.0, 0.5, 0.0, 0.5, 9.0, 0.0, 0.0, 0.0, 25.0}) out.put(term);
  out.put(static_cast<std::uint8_t>(type));
  return out.message();
}

class Ros2InputTest : public testing::Test {
 protected:
  static Ros2Settings settings() {
    Ros2Settings out;
    out.datum = model::Datum{50.8, 12.9, 300.0};
    return out;
  }
  // What the daemon reads of the message's line.
  std::optional<RobotMessage> read(Ros2Kind kind, const std::string& cdr) {
    const std::string line = input_.take(kind, cdr);
    if (line.empty()) return std::nullopt;
    robot_.push({reinterpret_cast<const std::uint8_t*>(line.data()), line.size()});
    auto message = robot_.next();
    EXPECT_TRUE(message) << line << robot_.last_problem();
    EXPECT_FALSE(robot_.next());
    return message;
  }
  void expect_refused(Ros2Kind kind, const std::string& cdr, const std::string& why) {
    const std::uint64_t before = input_.counters().refused;
    EXPECT_EQ(input_.take(kind, cdr), "") << why;
    EXPECT_EQ(input_.counters().refused, before + 1) << why;
    EXPECT_THAT(input_.last_problem(), HasSubstr(why));
  }

  Ros2Input input_{settings()};
  RobotInput robot_;
};

TEST_F(Ros2InputTest, OdometryHasVelocitiesAndThePoseInOdom) {
  const auto message = read(Ros2Kind::kOdometry, Odometry{}.message());
  ASSERT_TRUE(message);
  const auto& sample = std::get<model::OdometrySample>(*message);
  EXPECT_EQ(sample.t_s, kTime_s);
  EXPECT_EQ(sample.vx_mps, 0.5);
  EXPECT_EQ(sample.vy_mps, 0.25);
  EXPECT_EQ(sample.omega_radps, -0.125);
  ASSERT_TRUE(robot_.odom_pose());
  EXPECT_EQ(robot_.odom_pose()->t_s, kTime_s);
  EXPECT_EQ(robot_.odom_pose()->pose.position_m, Eigen::Vector3d(3.0, -4.0, 0.1));
  EXPECT_NEAR(robot_.odom_pose()->pose.quaternion.z(), std::sin(0.2), 1e-15);
  EXPECT_FALSE(robot_.odom_pose()->is_integrated);
}

TEST_F(Ros2InputTest, RefusesOdometryThatIsWrong) {
  expect_refused(Ros2Kind::kOdometry, Odometry{.vx_mps = kNaN}.message(),
                 "twist.twist.linear.x is not a finite number");
  expect_refused(Ros2Kind::kOdometry, Odometry{.norm = 0.0}.message(), "is not a unit quaternion");
  expect_refused(Ros2Kind::kOdometry, Odometry{.t_s = 0.0}.message(),
                 "header.stamp is not a time since 1970");
  expect_refused(Ros2Kind::kOdometry, Odometry{.child = "base_footprint"}.message(),
                 "set ros2: base_frame to it");
  expect_refused(Ros2Kind::kOdometry, Odometry{.frame = "world"}.message(), "set ros2: odom_frame to it");
  expect_refused(Ros2Kind::kOdometry, Odometry{.frame = std::string(1 << 20, 'x')}.message(), "it has 1049");
  expect_refused(Ros2Kind::kOdometry, Odometry{.frame = std::string(8000, 'x')}.message(),
                 "header.frame_id is 'xxx");
  EXPECT_LT(input_.last_problem().size(), 500U);
  expect_refused(Ros2Kind::kOdometry, imu_message(0.1), "its bytes are no such message");
  expect_refused(Ros2Kind::kOdometry, "", "its bytes are no such message");
}

TEST_F(Ros2InputTest, OdometryWithoutATwistIsNamed) {
  for (const double x_m : {0.0, 0.2, 0.4})
    EXPECT_TRUE(read(Ros2Kind::kOdometry, Odometry{.x_m = x_m, .has_twist = false}.message()));
  expect_refused(Ros2Kind::kOdometry, Odometry{.x_m = 0.6, .has_twist = false}.message(),
                 "has to fill in the twist");
  EXPECT_TRUE(read(Ros2Kind::kOdometry, Odometry{.x_m = 0.8}.message()));
  EXPECT_TRUE(read(Ros2Kind::kOdometry, Odometry{.x_m = 1.0, .has_twist = false}.message()))
      << "it has stopped";
}

TEST_F(Ros2InputTest, ImuHasAYawRate) {
  const auto message = read(Ros2Kind::kImu, imu_message(0.5));
  ASSERT_TRUE(message);
  EXPECT_EQ(std::get<model::YawRateSample>(std::get<model::SensorSample>(*message)).omega_radps, 0.5);
  expect_refused(Ros2Kind::kImu, imu_message(0.5, -1.0), "no angular velocity");
  expect_refused(Ros2Kind::kImu, imu_message(kNaN), "not a finite number");
}

TEST_F(Ros2InputTest, AFixIsAPlaceInTheMap) {
  const Eigen::Vector3d there = model::geographic({120.0, -60.0, 0.0}, *settings().datum);
  const auto message = read(Ros2Kind::kFix, fix_message(there.y(), there.x()));
  ASSERT_TRUE(message);
  const auto& place = std::get<model::PositionSample>(std::get<model::SensorSample>(*message));
  EXPECT_NEAR(place.x_m, 120.0, 0.01);
  EXPECT_NEAR(place.y_m, -60.0, 0.01);
  EXPECT_EQ(place.covariance_m2[0], 4.0);
  EXPECT_EQ(place.covariance_m2[2], 9.0);
  EXPECT_FALSE(read(Ros2Kind::kFix, fix_message(50.8, 12.9, -1)));
  EXPECT_EQ(input_.counters().without_fix, 1U);
  EXPECT_EQ(input_.counters().refused, 0U);
  expect_refused(Ros2Kind::kFix, fix_message(50.8, 12.9, 0, 0), "a fix needs a covariance");
  expect_refused(Ros2Kind::kFix, fix_message(91.0, 12.9), "beyond its range");
}

TEST_F(Ros2InputTest, APoseIsAbsoluteAndAnInitialPoseRestarts) {
  auto message = read(Ros2Kind::kPose, pose_message());
  ASSERT_TRUE(message);
  const auto& pose = std::get<model::PoseSample>(std::get<model::SensorSample>(*message));
  EXPECT_EQ(pose.x_m, 1.0);
  EXPECT_NEAR(pose.yaw_rad, 0.5, 1e-15);
  EXPECT_EQ(pose.covariance->at(0), 0.25);
  message = read(Ros2Kind::kInitialPose, pose_message());
  ASSERT_TRUE(message);
  EXPECT_TRUE(std::get<InitialPose>(*message).is_now);
  EXPECT_EQ(std::get<InitialPose>(*message).pose.y_m, 2.0);
  expect_refused(Ros2Kind::kPose, pose_message(-1.0), "pose.covariance[0] is not positive");
  expect_refused(Ros2Kind::kInitialPose, pose_message(0.25, "odom"), "publish the pose in the map's frame");
  input_.set_map_frame("odom");
  EXPECT_TRUE(read(Ros2Kind::kInitialPose, pose_message(0.25, "odom")));
}

TEST_F(Ros2InputTest, SurvivesRandomBytes) {
  groma::test::Random random(11);
  const std::array messages{Odometry{}.message(), imu_message(0.5), fix_message(50.8, 12.9), pose_message(),
                            pose_message()};
  for (int i = 0; i < 5000; ++i) {
    const auto kind = random.next() % kRos2Kinds;
    std::string bytes = messages.at(kind);
    for (int change = 0; change < 4; ++change)
      bytes[random.next() % bytes.size()] = static_cast<char>(random.next());
    if (random.next() % 4 == 0) bytes.resize(random.next() % bytes.size());
    const std::string line = input_.take(static_cast<Ros2Kind>(kind), bytes);
    if (line.empty()) continue;
    EXPECT_EQ(line.find('\n'), line.size() - 1);
    robot_.push({reinterpret_cast<const std::uint8_t*>(line.data()), line.size()});
    while (robot_.next()) continue;
    EXPECT_EQ(robot_.counters().torn, 0U) << line;
  }
}

}  // namespace
}  // namespace groma::daemon
