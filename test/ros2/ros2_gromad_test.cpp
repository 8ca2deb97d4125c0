// gromad with a node of another middleware: Fast DDS, with the settings of rmw_fastrtps_cpp.
#include <gmock/gmock.h>

#include "test/ros2/ros2_fixture.hpp"

namespace groma::daemon {
namespace {

using testing::HasSubstr;

TEST_F(Ros2Test, PublishesWhatThePoseStreamHas) {
  SimulatedSite site(folder_.path(), kSpeed);
  set_clock(site);
  write_surveyed(site);
  Peer peer(7, "default", all_readers());
  Gromad gromad({"--config", ros2_config("{domain_id: 7}")});
  ASSERT_TRUE(run_with(peer, site, gromad, [&] {
    return poses("TRACKING") >= 100 && peer.of("rt/groma/pose").size() >= 100 &&
           !peer.of("rt/groma/links").empty() && !peer.of("rt/groma/anchors").empty();
  })) << gromad.log();

  std::map<std::int64_t, json> lines;  // by their time in us
  for (const json& object : objects_) {
    if (object.at("class") == "POSE")
      lines.emplace(std::llround(1e6 * object.at("t_s").get<double>()), object);
  }
  std::size_t compared = 0;
  for (const PeerMessage& message : peer.of("rt/groma/pose")) {
    const auto pose = decode("geometry_msgs/msg/PoseWithCovarianceStamped", message.cdr);
    const auto line = lines.find(std::llround(1e6 * timestamp_s(pose)));
    if (line == lines.end()) continue;  // the client was not connected yet
    EXPECT_EQ(number(pose, "pose.pose.position.x"), line->second.at("x_m"));
    EXPECT_EQ(number(pose, "pose.pose.orientation.z"), line->second.at("quaternion")[2]);
    EXPECT_EQ(number(pose, "pose.covariance[35]"), line->second.at("covariance")[35]);
    ++compared;
  }
  EXPECT_GE(compared, 90U);

  // Its odometry is velocities: the transforms chain from map by odom to base_link.
  const auto transforms = decode("tf2_msgs/msg/TFMessage", peer.of("rt/tf").back().cdr);
  EXPECT_EQ(text(transforms, "transforms[0].child_frame_id"), "odom");
  EXPECT_EQ(text(transforms, "transforms[1].child_frame_id"), "base_link");
  EXPECT_EQ(text(decode("nav_msgs/msg/Odometry", peer.of("rt/groma/odometry").back().cdr), "header.frame_id"),
            "map");
  const auto markers = decode("visualization_msgs/msg/MarkerArray", peer.of("rt/groma/anchors").back().cdr);
  EXPECT_EQ(number(markers, "markers[1].id"), 100.0);
  const auto links = decode("visualization_msgs/msg/MarkerArray", peer.of("rt/groma/links").back().cdr);
  EXPECT_EQ(ros2::values_at(links, *ros2::FieldPath::parse("markers[0].points[].x")).size(), 12U);
  std::string names;
  for (const PeerMessage& message : peer.of("rt/diagnostics"))
    names += text(decode("diagnostic_msgs/msg/DiagnosticArray", message.cdr), "status[0].name") + '\n';
  EXPECT_THAT(names, HasSubstr("groma: localization\n"));
  EXPECT_THAT(names, HasSubstr("groma: diagnosis\n"));

  // As rmw has it: no warning of a missing type hash.
  EXPECT_TRUE(peer.has_event("participant enclave=/;"));
  EXPECT_TRUE(peer.has_event("writer rt/tf tf2_msgs::msg::dds_::TFMessage_ typehash=" +
                             std::string(dds::type_hash("tf2_msgs/msg/TFMessage")) + ";"));
  EXPECT_FALSE(peer.has_event("incompatible"));
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), 0) << gromad.log();
}

TEST_F(Ros2Test, LocalizesByOdometryOfAPeer) {
  SimulatedSite site(folder_.path(), kSpeed);
  set_clock(site);
  write_surveyed(site);
  Peer peer(8, "jazzy-localhost",
            {writes("/odom", "nav_msgs/msg/Odometry"), reads("/tf", "tf2_msgs/msg/TFMessage"),
             reads("/groma/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")});
  send_by(peer, site);
  Gromad gromad({"--config", ros2_config("{domain_id: 8}", false)});
  ASSERT_TRUE(run_with(peer, site, gromad, [&] {
    return poses("TRACKING") >= 250 && !peer.of("rt/tf").empty();
  })) << gromad.log();
  EXPECT_LT(largest_error_m(site, 100), 0.3);
  // The robot publishes odom to base_link; map to odom is constant, since its odometry is exact here: a
  // quarter turn, and a shift.
  const auto transforms = decode("tf2_msgs/msg/TFMessage", peer.of("rt/tf").back().cdr);
  EXPECT_EQ(ros2::values_at(transforms, *ros2::FieldPath::parse("transforms[].child_frame_id")).size(), 1U);
  EXPECT_NEAR(number(transforms, "transforms[0].transform.translation.x"), 0.0, 0.2);
  EXPECT_NEAR(number(transforms, "transforms[0].transform.translation.y"), 2.0, 0.2);
  EXPECT_NEAR(number(transforms, "transforms[0].transform.rotation.z"), std::sqrt(0.5), 0.03);
}

}  // namespace
}  // namespace groma::daemon
