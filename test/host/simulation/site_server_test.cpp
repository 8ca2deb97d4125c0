#include "host/simulation/site_server.hpp"

#include <gtest/gtest.h>

#include <array>
#include <csignal>
#include <filesystem>
#include <memory>
#include <string>

#include "host/daemon/session.hpp"
#include "host/io/error.hpp"
#include "host/link/byte_link.hpp"
#include "test/host/simulation/small_site.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::simulation {
namespace {

SiteServer::Options serving_at(const std::filesystem::path& folder, double speed = 1.0) {
  SiteServer::Options options;
  options.speed = speed;
  options.folder = folder;
  return options;
}

TEST(SiteServer, ServesTagsAndRobotAndLeavesNothingBehind) {
  const test::ScratchFolder scratch;
  const std::filesystem::path folder = scratch / "ports";
  volatile std::sig_atomic_t stop = 0;
  {
    SiteServer server(small_site(), serving_at(folder, 100.0));
    EXPECT_TRUE(std::filesystem::is_symlink(folder / "tag-1"));
    EXPECT_TRUE(std::filesystem::is_character_file(folder / "tag-2"));
    EXPECT_TRUE(std::filesystem::is_socket(folder / "robot.sock"));
    const link::OpenedLink tag = link::open_link(folder / "tag-1", 1'000'000);
    const link::OpenedLink robot = link::open_link(folder / "robot.sock", 0);
    ASSERT_TRUE(tag.link) << tag.error.message;
    ASSERT_TRUE(robot.link) << robot.error.message;

    daemon::Session session;
    const std::size_t node = session.add_node("tag-1", 0);
    std::array<std::uint8_t, 65536> chunk{};
    for (int turn = 1; turn <= 30; ++turn) {
      const double before_s = server.now_s();
      server.run(stop, 0.1 * turn);
      ASSERT_GE(server.now_s(), before_s);
      for (;;) {
        const std::size_t size = tag.link->read(chunk).bytes;
        if (size == 0) break;
        session.node_bytes(node, std::span(chunk).first(size), server.now_s());
      }
      for (;;) {
        const std::size_t size = robot.link->read(chunk).bytes;
        if (size == 0) break;
        session.robot_bytes(std::span(chunk).first(size), server.now_s());
      }
    }
    EXPECT_GT(session.robot_counters().odometry, 100U);
    EXPECT_GT(session.robot_counters().pose_priors, 20U);
    EXPECT_EQ(session.robot_counters().dropped(), 0U);
    EXPECT_GT(session.node(node).decoder().counters().ranges, 200U);
  }
  EXPECT_FALSE(std::filesystem::exists(folder));
}

TEST(SiteServer, ReplacesFilesOfAKilledRunButNotOfARunningOne) {
  const test::ScratchFolder scratch;
  std::filesystem::create_symlink("/dev/pts/9999", scratch / "tag-1");
  const auto first = std::make_unique<SiteServer>(small_site(), serving_at(scratch.path()));
  EXPECT_NE(std::filesystem::read_symlink(scratch / "tag-1"), "/dev/pts/9999");
  EXPECT_THROW(SiteServer(small_site(), serving_at(scratch.path())), io::DeviceError);
  EXPECT_TRUE(std::filesystem::is_socket(scratch / "robot.sock")) << "the first still serves";
}

TEST(SiteServer, StopsWhenTheFlagIsSet) {
  const test::ScratchFolder scratch;
  volatile std::sig_atomic_t stop = 1;
  SiteServer server(small_site(), serving_at(scratch.path()));
  server.run(stop);
  EXPECT_LT(server.now_s(), 0.01);
}

}  // namespace
}  // namespace groma::simulation
