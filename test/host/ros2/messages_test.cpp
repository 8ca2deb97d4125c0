#include "host/ros2/messages.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#include <Eigen/Geometry>

#include "host/ros2/message.hpp"
#include "host/ros2/schemas.hpp"

namespace groma::ros2 {
namespace {

struct Written {
  std::string topic;
  std::string type;
  double t_s = 0.0;
  MessageValue value;
};

class LocalizationMessagesTest : public testing::Test {
 protected:
  std::vector<Written> put(const Localization& at) {
    std::vector<Written> out;
    messages_.put(at, [&](std::string_view topic, std::string_view type, double t_s, std::string_view cdr) {
      auto value = definition_of(type).read(cdr);
      ASSERT_TRUE(value) << type;
      out.push_back({std::string(topic), std::string(type), t_s, std::move(*value)});
    });
    return out;
  }
  const MessageDefinition& definition_of(std::string_view type) {
    const auto found = definitions_.try_emplace(std::string(type), type, schema_of(type)).first;
    return found->second;
  }
  // The number at a path; NaN: there is none.
  static double number(const MessageValue& message, const char* path) {
    const auto values = values_at(message, *FieldPath::parse(path));
    if (values.size() != 1) return std::numeric_limits<double>::quiet_NaN();
    if (const auto* whole = std::get_if<std::int64_t>(&values[0]->content))
      return static_cast<double>(*whole);
    return std::get<double>(values[0]->content);
  }
  static std::string text(const MessageValue& message, const char* path) {
    return std::get<std::string>(values_at(message, *FieldPath::parse(path)).at(0)->content);
  }
  static Eigen::Isometry3d transform(const MessageValue& message, const std::string& path) {
    const auto at = [&](const char* field) { return number(message, (path + field).c_str()); };
    Eigen::Isometry3d out = Eigen::Isometry3d::Identity();
    out.linear() =
        Eigen::Quaterniond(at("rotation.w"), at("rotation.x"), at("rotation.y"), at("rotation.z")).matrix();
    out.translation() << at("translation.x"), at("translation.y"), at("translation.z");
    return out;
  }
  static const MessageValue& of(const std::vector<Written>& all, std::string_view topic) {
    for (const Written& each : all) {
      if (each.topic == topic) return each.value;
    }
    throw std::runtime_error("no message of " + std::string(topic));
  }

  static Localization localization(double t_s) {
    Localization at;
    at.t_s = t_s;
    const Eigen::Quaterniond turned(Eigen::AngleAxisd(0.7, Eigen::Vector3d(0.1, -0.2, 1.0).normalized()));
    at.pose = {{1.0, 2.0, 0.25}, turned.coeffs()};
    at.covariance = 0.01 * Covariance::Identity();
    at.covariance(0, 5) = at.covariance(5, 0) = 0.002;
    at.covariance(2, 2) = 0.0;
    at.velocity = {0.5, 0.1, 0.2};
    at.velocity_covariance = 0.04 * Eigen::Matrix3d::Identity();
    const Eigen::Quaterniond odom(Eigen::AngleAxisd(-1.1, Eigen::Vector3d::UnitZ()));
    at.odom = model::OdomPose{t_s, {{4.0, -3.0, 0.0}, odom.coeffs()}, true};
    at.state = filter::State::kTracking;
    return at;
  }

  LocalizationMessages messages_{{}, true};

 private:
  std::map<std::string, MessageDefinition> definitions_;
};

TEST_F(LocalizationMessagesTest, HasPoseOdometryTransformsAndDiagnostics) {
  const std::vector<Written> all = put(localization(12.5));
  ASSERT_EQ(all.size(), 4U);
  const MessageValue& pose = of(all, "/groma/pose");
  EXPECT_EQ(number(pose, "header.stamp.sec"), 12.0);
  EXPECT_EQ(number(pose, "header.stamp.nanosec"), 5e8);
  EXPECT_EQ(text(pose, "header.frame_id"), "map");
  EXPECT_EQ(number(pose, "pose.pose.position.z"), 0.25);
  EXPECT_EQ(number(pose, "pose.covariance[5]"), 0.002);
  EXPECT_EQ(number(pose, "pose.covariance[14]"), kLeastVariance);
  const MessageValue& odometry = of(all, "/groma/odometry");
  EXPECT_EQ(text(odometry, "child_frame_id"), "base_link");
  EXPECT_EQ(number(odometry, "twist.twist.linear.x"), 0.5);
  EXPECT_EQ(number(odometry, "twist.twist.angular.z"), 0.2);
  EXPECT_EQ(number(odometry, "twist.covariance[0]"), 0.04);
  EXPECT_EQ(number(odometry, "twist.covariance[14]"), kUnknownVariance);
  EXPECT_EQ(text(of(all, "/diagnostics"), "status[0].message"), "TRACKING");
  EXPECT_EQ(text(of(all, "/diagnostics"), "status[0].values[0].value"), "0.1000");
}

TEST_F(LocalizationMessagesTest, TransformsChainToThePose) {
  const Localization at = localization(1.0);
  const std::vector<Written> all = put(at);
  const MessageValue& transforms = of(all, "/tf");
  EXPECT_EQ(text(transforms, "transforms[0].header.frame_id"), "map");
  EXPECT_EQ(text(transforms, "transforms[0].child_frame_id"), "odom");
  EXPECT_NEAR(number(transforms, "transforms[0].header.stamp.nanosec"), 1e8, 1.0) << "ahead";
  EXPECT_EQ(text(transforms, "transforms[1].header.frame_id"), "odom");
  EXPECT_EQ(text(transforms, "transforms[1].child_frame_id"), "base_link");
  EXPECT_EQ(number(transforms, "transforms[1].header.stamp.nanosec"), 0.0);
  const Eigen::Isometry3d chained =
      transform(transforms, "transforms[0].transform.") * transform(transforms, "transforms[1].transform.");
  Eigen::Isometry3d expected = Eigen::Isometry3d::Identity();
  expected.linear() = Eigen::Quaterniond(at.pose.quaternion).matrix();
  expected.translation() = at.pose.position_m;
  EXPECT_LT((chained.matrix() - expected.matrix()).cwiseAbs().maxCoeff(), 1e-12);
}

TEST_F(LocalizationMessagesTest, TheRobotsOwnOdomToBaseIsNotRepeated) {
  Localization at = localization(1.0);
  at.odom->is_integrated = false;
  EXPECT_EQ(
      std::get<MessageValues>(values_at(of(put(at), "/tf"), *FieldPath::parse("transforms")).at(0)->content)
          .size(),
      1U);
  at.odom.reset();
  for (const Written& each : put(at)) EXPECT_NE(each.topic, "/tf");
}

TEST_F(LocalizationMessagesTest, PublishesNoTransformsIfSwitchedOff) {
  messages_ = LocalizationMessages({}, false);
  for (const Written& each : put(localization(1.0))) EXPECT_NE(each.topic, "/tf");
}

TEST_F(LocalizationMessagesTest, UnknownVelocityHasNoNaN) {
  Localization at = localization(1.0);
  at.velocity.x() = std::numeric_limits<double>::quiet_NaN();
  const std::vector<Written> all = put(at);
  EXPECT_EQ(number(of(all, "/groma/odometry"), "twist.twist.linear.x"), 0.0);
  EXPECT_EQ(number(of(all, "/groma/odometry"), "twist.covariance[0]"), kUnknownVariance);
}

TEST_F(LocalizationMessagesTest, DiagnosticsComeOnceASecondAndAtAChange) {
  const auto diagnostics = [&](double t_s, filter::State state) {
    Localization at = localization(t_s);
    at.state = state;
    at.reason = state == filter::State::kTracking ? filter::Reason::kNone : filter::Reason::kMapMismatch;
    for (const Written& each : put(at)) {
      if (each.topic == "/diagnostics") return text(each.value, "status[0].message");
    }
    return std::string();
  };
  EXPECT_EQ(diagnostics(100.0, filter::State::kTracking), "TRACKING");
  EXPECT_EQ(diagnostics(100.5, filter::State::kTracking), "");
  EXPECT_EQ(diagnostics(100.6, filter::State::kDegraded), "DEGRADED: map-mismatch");
  EXPECT_EQ(diagnostics(101.5, filter::State::kDegraded), "");
  EXPECT_EQ(diagnostics(101.6, filter::State::kDegraded), "DEGRADED: map-mismatch");
  EXPECT_EQ(diagnostics(20.0, filter::State::kDegraded), "DEGRADED: map-mismatch")
      << "the clock was set back";
  EXPECT_EQ(diagnostics(20.5, filter::State::kDegraded), "");
}

TEST_F(LocalizationMessagesTest, LeavesOutTimesThatAMessageCannotHold) {
  EXPECT_TRUE(put(localization(-1.0)).empty());
  EXPECT_TRUE(put(localization(3e9)).empty());
}

TEST(AnchorMarkers, HaveAnchorsWithAPositionAndRemoveEarlierOnes) {
  model::Calibration calibration;
  calibration.frame = "hall";
  calibration.anchors.resize(2);
  calibration.anchors[0].id = 4;
  calibration.anchors[0].position_m = {1.0, 2.0, 3.0};
  calibration.anchors[0].covariance = Eigen::MatrixXd::Identity(model::anchor_size(0), model::anchor_size(0));
  calibration.anchors[0].verdict = model::AnchorVerdict::kOk;
  calibration.anchors[1].id = 5;
  calibration.anchors[1].position_m.setConstant(std::numeric_limits<double>::quiet_NaN());
  constexpr const char* kType = "visualization_msgs/msg/MarkerArray";
  const MessageDefinition definition(kType, schema_of(kType));
  const auto value = definition.read(anchor_markers(calibration));
  ASSERT_TRUE(value);
  const auto field = [&](const char* path) { return values_at(*value, *FieldPath::parse(path)); };
  EXPECT_EQ(field("markers[].id").size(), 3U);
  EXPECT_EQ(std::get<std::int64_t>(field("markers[0].action").at(0)->content), 3);
  EXPECT_EQ(std::get<std::string>(field("markers[1].header.frame_id").at(0)->content), "hall");
  EXPECT_EQ(std::get<double>(field("markers[1].pose.position.z").at(0)->content), 3.0);
  EXPECT_EQ(std::get<std::string>(field("markers[2].text").at(0)->content), "4 ok");
}

}  // namespace
}  // namespace groma::ros2
