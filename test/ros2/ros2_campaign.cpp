// gromad and its peer with the settings that ROS 2 has for networks, on two computers, and restarts.
#include <cstdlib>
#include <string>
#include <utility>
#include <vector>

#include "test/ros2/ros2_fixture.hpp"

namespace groma::daemon {
namespace {

class Ros2Networks : public Ros2Test {
 protected:
  // The peer sends the odometry, and reads all that gromad publishes.
  void drive_with(const std::string& profile, std::vector<std::string> prefix = {}) {
    SimulatedSite site(folder_.path(), kSpeed);
    set_clock(site);
    write_surveyed(site);
    std::vector<Peer::Endpoint> endpoints = all_readers();
    endpoints.push_back(writes("/odom", "nav_msgs/msg/Odometry"));
    Peer peer(31, profile, endpoints, std::move(prefix));
    send_by(peer, site);
    Gromad gromad({"--config", ros2_config("{domain_id: 31, graph: iron}", false)});
    ASSERT_TRUE(run_with(peer, site, gromad, [&] {
      return poses("TRACKING") >= 250 && peer.of("rt/groma/pose").size() >= 100 &&
             peer.of("rt/tf").size() >= 100 && peer.of("rt/diagnostics").size() >= 2 &&
             !peer.of("rt/groma/anchors").empty();
    })) << gromad.log();
    EXPECT_LT(largest_error_m(site, 100), 0.3);
  }
};

TEST_F(Ros2Networks, GromadAndAPeerOnAnotherComputerHearEachOther) {
  const groma::test::OtherHost other;
  drive_with("default", other.prefix());
}

struct Settings {
  const char* profile;
  bool is_loopback;  // gromad's too
};

class Ros2Settings : public Ros2Networks, public testing::WithParamInterface<Settings> {
 protected:
  void SetUp() override {
    Ros2Networks::SetUp();
    constexpr const char* kLoopback =
        "<CycloneDDS><Domain Id=\"any\"><General><Interfaces><NetworkInterface name=\"lo\" "
        "multicast=\"false\"/>"
        "</Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto"
        "</ParticipantIndex><MaxAutoParticipantIndex>9</MaxAutoParticipantIndex><Peers><Peer "
        "address=\"127.0.0.1\"/></Peers></Discovery></Domain></CycloneDDS>";
    if (GetParam().is_loopback) ::setenv("CYCLONEDDS_URI", kLoopback, 1);
  }
  void TearDown() override { ::unsetenv("CYCLONEDDS_URI"); }
};

TEST_P(Ros2Settings, GromadAndPeerHearEachOther) {
  drive_with(GetParam().profile);
}

INSTANTIATE_TEST_SUITE_P(All, Ros2Settings,
                         testing::Values(Settings{"default", false}, Settings{"humble-localhost", false},
                                         Settings{"jazzy-localhost", false}, Settings{"loopback", true}),
                         [](const auto& of) {
                           std::string name = of.param.profile;
                           std::erase(name, '-');
                           return name;
                         });

// The peer is killed and started again, before and after gromad.
TEST_F(Ros2Test, FindsAPeerThatStartsAgainManyTimes) {
  constexpr int kRestarts = 50;
  for (int i = 0; i < kRestarts; ++i) {
    SCOPED_TRACE(i);
    std::filesystem::remove(folder_ / "robot.sock");
    objects_.clear();
    client_.reset();
    SimulatedSite site(folder_.path(), kSpeed);
    set_clock(site);
    write_surveyed(site);
    const auto start = [] { return std::make_unique<Peer>(32, "default", all_readers()); };
    auto peer = start();
    Gromad gromad({"--config", ros2_config("{domain_id: 32}")});
    const auto receives = [&] {
      return run_with(*peer, site, gromad, [&] {
        return peer->of("rt/groma/pose").size() >= 20 && !peer->of("rt/groma/anchors").empty();
      });
    };
    ASSERT_TRUE(receives()) << gromad.log();
    peer.reset();
    peer = start();
    ASSERT_TRUE(receives()) << gromad.log();
  }
}

}  // namespace
}  // namespace groma::daemon
