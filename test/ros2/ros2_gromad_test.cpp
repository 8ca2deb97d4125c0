// gromad with a node of another middleware: Fast DDS, with the settings of rmw_fastrtps_cpp.
#include <gmock/gmock.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iterator>

#include "host/mcap/writer.hpp"
#include "test/npm/node.hpp"
#include "test/ros2/ros2_fixture.hpp"
#include "test/support/child_process.hpp"

namespace groma::daemon {
namespace {

using testing::HasSubstr;

// The hash covers names, order and types of all fields: it is that of ROS 2 only if our definitions are.
TEST(TypeHash, IsThatOfTheDefinition) {
  const groma::test::TemporaryFolder folder;
  for (const char* type :
       {"diagnostic_msgs/msg/DiagnosticArray", "geometry_msgs/msg/PoseWithCovarianceStamped",
        "nav_msgs/msg/Odometry", "rmw_dds_common/msg/ParticipantEntitiesInfo", "sensor_msgs/msg/Imu",
        "sensor_msgs/msg/NavSatFix", "tf2_msgs/msg/TFMessage", "visualization_msgs/msg/MarkerArray"}) {
    const std::string definition = folder.write("definition", ros2::schema_of(type)).string();
    const groma::test::ChildResult result = groma::test::run_child(
        {"/bin/sh", "-c",
         "python3 " GROMA_SOURCE_DIR "/test/ros2/type_hash.py " + std::string(type) + " < " + definition});
    EXPECT_EQ(result.exit_code, 0) << result.err;
    EXPECT_EQ(result.out, std::string(dds::type_hash(type)) + '\n') << type;
  }
}

TEST_F(Ros2Test, PublishesWhatThePoseStreamHas) {
  SimulatedSite site(folder_.path(), kSpeed);
  set_clock(site);
  write_surveyed(site);
  Peer peer(7, "default", all_readers());
  Gromad gromad({"--config", ros2_config("{domain_id: 7}")});
  // The middleware connects each topic on its own: the last may be seconds behind the first.
  const auto is_silent = [&](const Peer::Endpoint& topic) { return peer.of(topic[1]).empty(); };
  const std::vector<Peer::Endpoint> topics = all_readers();
  const auto statuses = [&] {
    std::string names;
    for (const PeerMessage& message : peer.of("rt/diagnostics"))
      names += text(decode("diagnostic_msgs/msg/DiagnosticArray", message.cdr), "status[0].name") + '\n';
    return names;
  };
  ASSERT_TRUE(run_with(peer, site, gromad, [&] {
    return poses("TRACKING") >= 100 && peer.of("rt/groma/pose").size() >= 100 &&
           std::none_of(topics.begin(), topics.end(), is_silent) &&
           statuses().find("groma: localization\n") != std::string::npos &&
           statuses().find("groma: diagnosis\n") != std::string::npos;
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
  EXPECT_THAT(statuses(), HasSubstr("groma: localization\n"));

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
            {writes("/odom", "nav_msgs/msg/Odometry"), writes("/imu", "sensor_msgs/msg/Imu", "best-effort"),
             reads("/tf", "tf2_msgs/msg/TFMessage")});
  // The wheels' yaw rate is wrong: only with the IMU's is the heading right.
  send_by(peer, site, 1.3);
  Gromad gromad({"--config", ros2_config("{domain_id: 8, imu_topic: /imu}", false)});
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

TEST_F(Ros2Test, StartsAgainAtAnInitialPose) {
  SimulatedSite site(folder_.path(), kSpeed);
  set_clock(site);
  write_surveyed(site);
  Peer peer(9, "default", {writes("/initialpose", "geometry_msgs/msg/PoseWithCovarianceStamped")});
  Gromad gromad({"--config", ros2_config("{domain_id: 9}")});
  ASSERT_TRUE(run_with(peer, site, gromad, [&] {
    return poses("TRACKING") >= 50 && peer.has_event("reader rt/initialpose");
  })) << gromad.log();
  const auto send = [&](const char* frame) {
    const auto truth = SimulatedSite::truth(site.site_time_s() + SimulatedSite::kRobotOrigin_s);
    ros2::CdrWriter out;
    ros2::put_header(out, unix_time_s() + 5.0, frame);  // of a computer whose clock differs
    ros2::put_pose(out, {{truth.x_m + 5.0, truth.y_m, 0.0},
                         {0.0, 0.0, std::sin(0.5 * truth.yaw_rad), std::cos(0.5 * truth.yaw_rad)}});
    // So sure that the first ranges don't pull it back before a pose is published.
    ros2::put_covariance(out, 0.01 * ros2::Covariance::Identity());
    peer.write("rt/initialpose", out.message());
  };
  // Until writer and reader have found each other, messages are lost.
  auto next = std::chrono::steady_clock::now();
  ASSERT_TRUE(run_with(peer, site, gromad, [&] {
    if (std::chrono::steady_clock::now() > next) {
      send("odom");
      next += std::chrono::milliseconds(200);
    }
    return gromad.log().find("publish the pose in the map's frame") != std::string::npos;
  })) << gromad.log();
  const std::size_t before = objects_.size();
  send("map");
  const auto moved = [&] {
    for (std::size_t i = before; i < objects_.size(); ++i) {
      const json& object = objects_[i];
      if (object.at("class") != "POSE") continue;
      const auto truth = SimulatedSite::truth(object.at("t_s").get<double>() - site.robot_clock_s);
      // It drives on while the message is on its way.
      if (std::hypot(object.at("x_m").get<double>() - truth.x_m, object.at("y_m").get<double>() - truth.y_m) >
          1.0)
        return true;
    }
    return false;
  };
  ASSERT_TRUE(run_with(peer, site, gromad, moved)) << "at the wrong place, as it was asked\n" << gromad.log();
}

// As when NTP sets the computer's clock: the timestamps of all messages step.
TEST_F(Ros2Test, AClockStepMovesNoPose) {
  SimulatedSite site(folder_.path(), kSpeed);
  set_clock(site);
  write_surveyed(site);
  Peer peer(14, "default", {writes("/odom", "nav_msgs/msg/Odometry")});
  send_by(peer, site);
  Gromad gromad({"--config", ros2_config("{domain_id: 14}", false)});
  ASSERT_TRUE(run_with(peer, site, gromad, [&] { return poses("TRACKING") >= 100; })) << gromad.log();
  for (const double step_s : {1.0, -1.0, 3600.0, -3600.0}) {
    SCOPED_TRACE(step_s);
    const std::size_t before = objects_.size();
    site.robot_clock_s += step_s;
    ASSERT_TRUE(run_with(peer, site, gromad, [&] {
      return objects_.size() >= before + 150 && objects_.back().at("class") == "POSE" &&
             objects_.back().at("state") == "TRACKING";
    })) << gromad.log();
    // On the circle, at the time that the pose has: of the old clock, then of the new one.
    bool is_new = false;
    std::size_t changes = 0;
    for (std::size_t i = before; i < objects_.size(); ++i) {
      const json& pose = objects_[i];
      if (pose.at("class") != "POSE") continue;
      const double site_s = pose.at("t_s").get<double>() - site.robot_clock_s;
      const bool fits_new = std::abs(site_s - SimulatedSite::kRobotOrigin_s - site.site_time_s()) < 10.0;
      const bool fits = std::abs(step_s) > 20.0 ? fits_new : is_new || fits_new;
      if (fits != is_new) ++changes;
      is_new = fits;
      if (std::abs(step_s) < 20.0) continue;
      const auto truth = SimulatedSite::truth(fits ? site_s : site_s + step_s);
      EXPECT_LT(
          std::hypot(pose.at("x_m").get<double>() - truth.x_m, pose.at("y_m").get<double>() - truth.y_m),
          0.3);
    }
    EXPECT_LE(changes, 1U);
  }
  EXPECT_EQ(gromad.log().find("starting again"), std::string::npos) << gromad.log();
}

// Samples that a broken or hostile node sends are refused, and poses go on.
TEST_F(Ros2Test, RefusesHostileSamples) {
  SimulatedSite site(folder_.path(), kSpeed);
  set_clock(site);
  write_surveyed(site);
  Peer peer(10, "default", {writes("/odom", "nav_msgs/msg/Odometry")});
  Peer other(10, "default", {writes("/odom", "std_msgs/msg/String")});
  send_by(peer, site);
  Gromad gromad({"--config", ros2_config("{domain_id: 10}", false)});
  ASSERT_TRUE(run_with(peer, site, gromad, [&] { return poses("TRACKING") >= 100; })) << gromad.log();
  const double now_s = unix_time_s();
  const double nan = std::nan("");
  peer.write("rt/odom", odometry_message({now_s, nan, 0.0, 0.0, 0.0, 0.0}));
  peer.write("rt/odom", odometry_message({now_s, 0.0, 0.0, nan, 0.0, 0.0}));
  peer.write("rt/odom", odometry_message({now_s, 1e300, 0.0, 0.0, 0.0, 0.0}));
  peer.write("rt/odom",
             odometry_message({now_s, 0.0, 0.0, 0.0, 0.0, 0.0}, std::string(100'000, 'x').c_str()));
  peer.write("rt/odom", odometry_message({now_s, 0.0, 0.0, 0.0, 0.0, 0.0}).substr(0, 300));
  peer.write("rt/odom", std::string("\0\1\0\0", 4) + std::string(200, '\xff'));
  other.write("rt/odom", std::string("\0\1\0\0\4\0\0\0abc\0", 12));
  const std::size_t before = poses("TRACKING");
  ASSERT_TRUE(run_with(peer, site, gromad, [&] {
    return poses("TRACKING") >= before + 200 &&
           gromad.log().find("messages not used so far") != std::string::npos;
  })) << gromad.log();
  EXPECT_LT(largest_error_m(site, 100), 0.3);
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), 0) << gromad.log();
}

// ros_discovery_info, from which `ros2 node list` and `ros2 topic info` have the node of each endpoint.
TEST_F(Ros2Test, IsInTheGraph) {
  for (const auto& [graph, gid] : {std::pair{"iron", 16}, {"humble", 24}}) {
    std::filesystem::remove(folder_ / "robot.sock");
    SimulatedSite site(folder_.path(), kSpeed);
    set_clock(site);
    write_surveyed(site);
    client_.reset();
    const std::string type = "rmw_dds_common/msg/ParticipantEntitiesInfo";
    Peer peer(11, "default",
              {{"read", "ros_discovery_info", dds::dds_type_name(type), "reliable", "latched", "100"}});
    Gromad gromad({"--config", ros2_config(fmt::format("{{domain_id: 11, graph: {}}}", graph))});
    ASSERT_TRUE(run_with(peer, site, gromad, [&] { return !peer.of("ros_discovery_info").empty(); }))
        << gromad.log();
    const std::string cdr = peer.of("ros_discovery_info").back().cdr;
    std::string definition = ros2::schema_of(type);
    const std::size_t at = definition.find("uint8[16] data");
    definition.replace(at, 14, fmt::format("uint8[{}] data", gid));
    const ros2::MessageDefinition reader(type, definition);
    const auto info = reader.read(cdr);
    ASSERT_TRUE(info);
    EXPECT_EQ(text(*info, "node_entities_info_seq[0].node_namespace"), "/groma");
    EXPECT_EQ(text(*info, "node_entities_info_seq[0].node_name"), "localizer");
    const auto count = [&](const char* path) {
      return ros2::values_at(*info, *ros2::FieldPath::parse(path)).size();
    };
    EXPECT_EQ(count("node_entities_info_seq[0].writer_gid_seq[].data"), 6U);
    EXPECT_EQ(count("node_entities_info_seq[0].reader_gid_seq[].data"), 1U);
  }
}

// A peer that is killed and started again, before and after gromad.
TEST_F(Ros2Test, FindsAPeerThatStartsAgain) {
  SimulatedSite site(folder_.path(), kSpeed);
  set_clock(site);
  write_surveyed(site);
  const auto start = [] { return std::make_unique<Peer>(12, "default", all_readers()); };
  auto peer = start();
  Gromad gromad({"--config", ros2_config("{domain_id: 12}")});
  constexpr int kRestarts = 2;
  for (int i = 0; i < kRestarts; ++i) {
    ASSERT_TRUE(run_with(
        *peer, site, gromad,
        [&] { return peer->of("rt/groma/pose").size() >= 20 && !peer->of("rt/groma/anchors").empty(); }))
        << i << '\n'
        << gromad.log();
    peer.reset();
    peer = start();
  }
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), 0) << gromad.log();
}

// What was recorded is what went over the wire: the pose stream byte for byte, the messages field by field as
// the viewers' packages read them.
TEST_F(Ros2Test, ACaptureRepeatsWhatThePeerReceived) {
  SimulatedSite site(folder_.path(), kSpeed);
  set_clock(site);
  write_surveyed(site);
  std::vector<Peer::Endpoint> endpoints = all_readers();
  endpoints[0] = reads("/groma/pose", "geometry_msgs/msg/PoseWithCovarianceStamped");
  endpoints.push_back(writes("/odom", "nav_msgs/msg/Odometry"));
  Peer peer(13, "default", endpoints);
  send_by(peer, site);
  Gromad gromad({"--config", ros2_config("{domain_id: 13}\nlog: drive.glog", false)});
  ASSERT_TRUE(run_with(peer, site, gromad, [&] {
    return poses("TRACKING") >= 100 && peer.of("rt/tf").size() >= 100 &&
           !peer.of("rt/groma/anchors").empty() && peer.of("rt/diagnostics").size() >= 6;
  })) << gromad.log();
  gromad.terminate();
  EXPECT_EQ(gromad.exit_code(), 0) << gromad.log();
  peer.read();

  const auto run = [&](std::vector<std::string> arguments) {
    arguments.insert(arguments.begin(), GROMA_PATH);
    const groma::test::ChildResult result = groma::test::run_child(arguments);
    EXPECT_EQ(result.exit_code, 0) << result.err;
    return result.out;
  };
  const std::string capture = (folder_ / "drive.glog").string();
  run({"replay", capture, "--stream", (folder_ / "poses").string()});
  std::ifstream stream(folder_ / "poses");
  const std::string repeated{std::istreambuf_iterator<char>(stream), {}};
  const std::string received = poses_received();
  EXPECT_GT(received.size(), 10'000U);
  EXPECT_NE(repeated.find(received), std::string::npos);

  // The peer's messages as a recording of their own.
  mcap::Writer writer("ros2", "a peer");
  const std::map<std::string, std::string> types{
      {"/groma/pose", "geometry_msgs/msg/PoseWithCovarianceStamped"},
      {"/groma/odometry", "nav_msgs/msg/Odometry"},
      {"/groma/anchors", "visualization_msgs/msg/MarkerArray"},
      {"/tf", "tf2_msgs/msg/TFMessage"},
      {"/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"}};
  for (const auto& [topic, type] : types) {
    const std::string schema = ros2::schema_of(type);
    const std::uint16_t channel = writer.add_channel(topic, "cdr", {type, "ros2msg", schema});
    for (const PeerMessage& message : peer.of("rt" + topic))
      writer.write(channel, static_cast<std::uint64_t>(message.arrived_ns), message.cdr);
  }
  folder_.write("wire.mcap", writer.finish());
  run({"convert", capture, "--ros2", "-o", (folder_ / "bag.mcap").string()});
  const auto read = [&](const char* file) {
    const groma::test::ChildResult result = groma::test::run_child(
        {groma::test::node(), groma::test::kNpmFolder / "read_mcap.mjs", (folder_ / file).string()});
    EXPECT_EQ(result.exit_code, 0) << result.err;
    std::map<std::string, std::vector<json>> out;
    const json content = json::parse(result.out);
    for (const json& message : content.at("messages"))
      out[message.at("topic")].push_back(message.at("value"));
    return out;
  };
  const auto wire = read("wire.mcap");
  const auto bag = read("bag.mcap");
  for (const auto& [topic, type] : types) {
    SCOPED_TRACE(topic);
    ASSERT_TRUE(wire.contains(topic));
    ASSERT_TRUE(bag.contains(topic));
    std::vector<json> expected = wire.at(topic);
    // What concerns this computer's devices is not in a recording.
    std::erase_if(expected, [](const json& message) {
      return message.contains("status") && message.at("status")[0].at("name") != "groma: localization";
    });
    ASSERT_FALSE(expected.empty());
    // The peer has all messages from its first one on.
    const std::vector<json>& all = bag.at(topic);
    const auto first = std::find(all.begin(), all.end(), expected.front());
    ASSERT_NE(first, all.end());
    ASSERT_LE(expected.size(), static_cast<std::size_t>(all.end() - first));
    EXPECT_GE(expected.size() + 2, static_cast<std::size_t>(all.end() - first)) << "sent while gromad ended";
    for (std::size_t i = 0; i < expected.size(); ++i)
      EXPECT_EQ(expected[i], first[static_cast<std::ptrdiff_t>(i)]);
  }
}

// A second node by Cyclone DDS: keys of one middleware are not understood by the other (docs/how-to/ros2.md).
class SecureRos2 : public Ros2Test {
 protected:
  void SetUp() override {
    Ros2Test::SetUp();
    if (IsSkipped()) return;
    const groma::test::ChildResult keys =
        groma::test::run_child({std::string(GROMA_SOURCE_DIR) + "/examples/ros2/make-enclaves",
                                folder_ / "keys", "33", "groma", "navigation"});
    ASSERT_EQ(keys.exit_code, 0) << keys.err;
    ::setenv("CYCLONEDDS_URI", "file://" GROMA_SOURCE_DIR "/examples/ros2/security.xml", 1);
  }
  void TearDown() override { ::unsetenv("CYCLONEDDS_URI"); }

  void take_keys_of(const char* name) const {
    ::setenv("GROMA_ENCLAVE", (folder_ / "keys" / name).c_str(), 1);
  }
};

TEST_F(SecureRos2, SendsThePoseToNodesWithKeysAlone) {
  SimulatedSite site(folder_.path(), kSpeed);
  set_clock(site);
  write_surveyed(site);
  Peer other(33, "default", all_readers());
  take_keys_of("groma");
  Gromad gromad({"--config", ros2_config("{domain_id: 33}")});
  take_keys_of("navigation");
  std::atomic<int> heard = 0;
  const dds::Node navigation(
      {.domain_id = 33,
       .name_space = "/",
       .name = "navigation",
       .outputs = {},
       .inputs = {{"/groma/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", {.is_reliable = false}}},
       .on_message = [&](std::size_t /*input*/, std::string_view /*cdr*/) { ++heard; },
       .on_wake = [] {}});
  ASSERT_TRUE(run_with(other, site, gromad, [&] { return heard >= 400; })) << gromad.log();
  EXPECT_TRUE(other.of("rt/groma/pose").empty());
  EXPECT_TRUE(other.of("rt/tf").empty());
}

TEST_F(SecureRos2, DoesNotStartWithoutItsKeys) {
  const SimulatedSite site(folder_.path(), kSpeed);
  write_surveyed(site);
  take_keys_of("nobody");
  Gromad gromad({"--config", ros2_config("{domain_id: 33}")});
  EXPECT_EQ(gromad.exit_code(), 69) << gromad.log();
  EXPECT_THAT(gromad.log(), HasSubstr("there is no participant"));
}

}  // namespace
}  // namespace groma::daemon
