#include "host/daemon/pose_message.hpp"

#include <gtest/gtest.h>

#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>
#include <random>
#include <string>

#include <nlohmann/json.hpp>

#include "test/support/allocations.hpp"

namespace groma::daemon {
namespace {

using Json = nlohmann::ordered_json;

Json terms(const Eigen::Matrix<double, 6, 6>& covariance) {
  Json out = Json::array();
  for (Eigen::Index row = 0; row < 6; ++row) {
    for (Eigen::Index column = 0; column < 6; ++column) out.push_back(covariance(row, column));
  }
  return out;
}

// The line by the JSON library.
std::string expected_line(const PoseEstimate& pose, std::string_view frame, std::string_view model) {
  const std::string_view reason = filter::reason_name(pose.reason);
  constexpr std::array<Eigen::Index, 3> kPlanar{0, 1, 5};
  Eigen::Matrix<double, 6, 6> velocity =
      Eigen::Matrix<double, 6, 6>::Constant(std::numeric_limits<double>::quiet_NaN());
  velocity(kPlanar, kPlanar) = pose.velocity_covariance;
  const Json twist{{"vx_mps", pose.velocity.x()},
                   {"vy_mps", pose.velocity.y()},
                   {"omega_radps", pose.velocity.z()},
                   {"covariance", terms(velocity)}};
  const Eigen::Vector4d& q = pose.quaternion;
  Json object = {{"class", "POSE"},
                 {"t_s", pose.t_s},
                 {"frame", frame},
                 {"model", model},
                 {"state", filter::state_name(pose.state)},
                 {"reason", reason.empty() ? Json(nullptr) : Json(reason)},
                 {"x_m", pose.x_m},
                 {"y_m", pose.y_m},
                 {"z_m", pose.z_m},
                 {"roll_rad", pose.roll_rad},
                 {"pitch_rad", pose.pitch_rad},
                 {"yaw_rad", pose.yaw_rad},
                 {"covariance", terms(pose.covariance)},
                 {"quaternion", {q.x(), q.y(), q.z(), q.w()}},
                 {"child_frame", "base_link"},
                 {"twist", twist}};
  if (!pose.floor.empty()) object["floor"] = pose.floor;
  return object.dump(-1, ' ', false, Json::error_handler_t::replace) + "\n";
}

class RandomPoses {
 public:
  PoseEstimate next() {
    PoseEstimate pose;
    for (double* const of :
         {&pose.t_s, &pose.x_m, &pose.y_m, &pose.z_m, &pose.roll_rad, &pose.pitch_rad, &pose.yaw_rad}) {
      *of = number();
    }
    for (double& term : pose.covariance.reshaped()) term = number();
    for (double& term : pose.quaternion) term = number();
    for (double& term : pose.velocity) term = number();
    for (double& term : pose.velocity_covariance.reshaped()) term = number();
    const bool tracks = random_() % 2 == 0;
    pose.state = tracks ? filter::State::kTracking : filter::State::kDegraded;
    pose.reason = tracks ? filter::Reason::kNone : filter::Reason::kOdometryTimes;
    return pose;
  }

 private:
  // Of any size, whole, or special.
  double number() {
    constexpr double kInfinity = std::numeric_limits<double>::infinity();
    switch (random_() % 8) {
      case 0:
        return std::bit_cast<double>(random_());
      case 1:
        return static_cast<double>(static_cast<std::int64_t>(random_()) >> (random_() % 60));
      case 2:
        return std::array{0.0, -0.0, kInfinity, -kInfinity, 1e-4, 1e15, 5e-324, 1e22}.at(random_() % 8);
      case 3:
        return 1.7e9 + 0.001 * static_cast<double>(random_() % 1'000'000'000);
      default:
        return std::ldexp(static_cast<double>(random_() >> 11U), -53 - static_cast<int>(random_() % 40));
    }
  }

  std::mt19937_64 random_{20};
};

TEST(PoseWriter, WritesTheBytesOfTheJsonLibrary) {
  RandomPoses poses;
  PoseWriter writer;
  const std::array<std::string, 4> floors{"", "hall", "level \"2\"\n", "\xff\xc3\xa4"};
  for (std::size_t i = 0; i < 5000; ++i) {
    PoseEstimate pose = poses.next();
    pose.floor = floors.at(i / 3 % floors.size());
    const std::string frame = i % 1000 < 500 ? "map" : "m\xff\\p";
    const std::string line(writer.line(pose, frame, "schmidt"));
    ASSERT_EQ(line, expected_line(pose, frame, "schmidt"));
    ASSERT_EQ(line, pose_line(pose, frame, "schmidt"));
  }
}

// Each finite number is read as the same number, each other as null.
TEST(PoseWriter, LosesNoBitOfANumber) {
  RandomPoses poses;
  PoseWriter writer;
  for (int i = 0; i < 1000; ++i) {
    const PoseEstimate pose = poses.next();
    const Json object = Json::parse(writer.line(pose, "map", "schmidt"));
    for (Eigen::Index term = 0; term < 36; ++term) {
      const double number = pose.covariance(term / 6, term % 6);
      const Json& read = object.at("covariance").at(static_cast<std::size_t>(term));
      ASSERT_EQ(read.is_null(), !std::isfinite(number));
      if (std::isfinite(number)) {
        ASSERT_EQ(std::bit_cast<std::uint64_t>(read.get<double>()), std::bit_cast<std::uint64_t>(number));
      }
    }
  }
}

TEST(PoseWriter, NeedsNoHeapForTheSameNames) {
  RandomPoses poses;
  PoseWriter writer;
  PoseEstimate pose = poses.next();
  pose.floor = "the hall with a long name";
  std::size_t bytes = writer.line(pose, "a frame with a long name", "schmidt").size();
  const std::size_t before = groma::test::allocations();
  for (int i = 0; i < 1000; ++i) {
    const std::string_view floor = pose.floor;
    pose = poses.next();
    pose.floor = floor;
    bytes += writer.line(pose, "a frame with a long name", "schmidt").size();
  }
  EXPECT_EQ(groma::test::allocations(), before);
  EXPECT_GT(bytes, 500'000U);
}

}  // namespace
}  // namespace groma::daemon
