// groma flash, configure, identify, nodes and listen as processes: exit codes, killed and repeated. With
// OpenOCD, emulated parts behind emulated probes, and simulated nodes on real pseudo-terminals.
#include <fcntl.h>
#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <limits>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include <nlohmann/json.hpp>

#include "firmware/core/node/config.hpp"
#include "firmware/core/node/image_identity.hpp"
#include "host/link/byte_link.hpp"
#include "host/link/report_decoder.hpp"
#include "host/provision/configure.hpp"
#include "test/host/provision/emulated_part.hpp"
#include "test/host/provision/emulated_probe.hpp"
#include "test/host/provision/live_site.hpp"
#include "test/host/provision/small_image.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::provision {
namespace {

using groma::test::ChildResult;
using groma::test::run_child;
using groma::test::ScratchFolder;
using nlohmann::json;
using test::EmulatedPart;
using test::EmulatedProbe;
using test::LiveSite;
using ::testing::HasSubstr;

constexpr unsigned kBaud = 1'000'000;

ChildResult groma_run(std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), GROMA_EXECUTABLE);
  return run_child(arguments);
}

// Starts groma and kills it by SIGKILL once the condition holds. True: it was still running.
bool kill_when(std::vector<std::string> arguments, const std::function<bool()>& condition) {
  arguments.insert(arguments.begin(), GROMA_EXECUTABLE);
  std::vector<char*> argv;
  argv.reserve(arguments.size() + 1);
  for (std::string& argument : arguments) argv.push_back(argument.data());
  argv.push_back(nullptr);
  const pid_t child = ::fork();
  if (child == 0) {
    const int nowhere = ::open("/dev/null", O_WRONLY);
    ::dup2(nowhere, STDOUT_FILENO);
    ::dup2(nowhere, STDERR_FILENO);
    ::execv(argv[0], argv.data());
    ::_exit(127);
  }
  int status = 0;
  while (!condition()) {
    if (::waitpid(child, &status, WNOHANG) == child) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(1));
  }
  ::kill(child, SIGKILL);
  ::waitpid(child, &status, 0);
  return WIFSIGNALED(status);
}

// Four simulated nodes, an emulated part and probe for each, a plan of all, and an image.
class CommandTest : public ::testing::Test {
 protected:
  static constexpr std::array<const char*, 4> kProbes{"p1", "p10", "p11", "p12"};

  void SetUp() override {
    scratch_.write("node.hex", test::hex_of(image_) + test::kHexEnd);
    scratch_.write("probe.cfg", test::probe_configuration(scratch_.path()));
    std::string plan = "schema: 1\nnetwork_id: 77\nnodes:\n";
    nodes_ = site_.plan().nodes;
    for (std::size_t i = 0; i < nodes_.size(); ++i) {
      plan += fmt::format("  - {{id: {}, role: {}, port: {}, probe: {}}}\n", nodes_[i].id,
                          link::role_word(nodes_[i].role), nodes_[i].port, kProbes.at(i));
      parts_.push_back(std::make_unique<EmulatedPart>());
      probes_.push_back(std::make_unique<EmulatedProbe>(scratch_ / fmt::format("{}.sock", kProbes.at(i)),
                                                        parts_.back().get()));
    }
    scratch_.write("plan.yaml", plan);
  }
  [[nodiscard]] std::string path(const char* name) const { return scratch_ / name; }
  [[nodiscard]] std::vector<std::string> flash_all() const {
    return {"flash",           "--image", path("node.hex"),  "--adapter",
            path("probe.cfg"), "--plan",  path("plan.yaml"), "--json"};
  }
  [[nodiscard]] std::vector<std::string> configure_all() const {
    return {"configure", "--plan", path("plan.yaml"), "--json"};
  }
  void expect_all_done() {
    for (std::size_t i = 0; i < parts_.size(); ++i) {
      EXPECT_TRUE(std::equal(image_.begin(), image_.end(), parts_[i]->flash().begin())) << i;
      const NodeOutcome outcome = configure_node(nodes_[i], kBaud);
      EXPECT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
      EXPECT_FALSE(outcome.changed) << i;
    }
  }

  ScratchFolder scratch_;
  std::vector<std::uint8_t> image_ = test::small_image(4096 + 512);
  LiveSite site_;
  std::vector<PlannedNode> nodes_;
  std::vector<std::unique_ptr<EmulatedPart>> parts_;
  std::vector<std::unique_ptr<EmulatedProbe>> probes_;
};

TEST_F(CommandTest, FlashWithAPlanGoesThroughAllNodes) {
  const ChildResult result = groma_run(flash_all());
  EXPECT_EQ(result.exit_code, 0) << result.err;
  const json out = json::parse(result.out);
  EXPECT_EQ(out["image"]["version"], "simulated");
  ASSERT_EQ(out["nodes"].size(), 4U);
  for (const json& node : out["nodes"]) {
    EXPECT_EQ(node["flash"]["result"], "flashed");
    EXPECT_EQ(node["configure"]["result"], "configured");
  }
  expect_all_done();

  const ChildResult again = groma_run(flash_all());
  EXPECT_EQ(again.exit_code, 0) << again.err;
  for (const json said = json::parse(again.out); const json& node : said.at("nodes")) {
    EXPECT_EQ(node["flash"]["result"], "unchanged");
    EXPECT_EQ(node["configure"]["result"], "unchanged");
  }
}

TEST_F(CommandTest, FlashKilledAtEachNodeContinuesWhereItStopped) {
  for (std::size_t i = 0; i < parts_.size(); ++i) {
    const int half = static_cast<int>(image_.size() / 4 / 2);
    parts_[i]->hold_at(half);
    EXPECT_TRUE(kill_when(flash_all(), [&] { return parts_[i]->words_written() >= half; })) << i;
    parts_[i]->hold_at(std::numeric_limits<int>::max());
    EXPECT_FALSE(std::equal(image_.begin(), image_.end(), parts_[i]->flash().begin())) << i;
    for (std::size_t done = 0; done < i; ++done) {
      EXPECT_TRUE(std::equal(image_.begin(), image_.end(), parts_[done]->flash().begin())) << done;
    }
  }
  const ChildResult rest = groma_run(flash_all());
  EXPECT_EQ(rest.exit_code, 0) << rest.err;
  const json out = json::parse(rest.out);
  EXPECT_EQ(out["nodes"][0]["flash"]["result"], "unchanged");
  EXPECT_EQ(out["nodes"][3]["flash"]["result"], "flashed");
  expect_all_done();
}

TEST_F(CommandTest, AFailedNodeDoesNotStopTheOthers) {
  parts_[1]->lock();
  const ChildResult result = groma_run(flash_all());
  EXPECT_EQ(result.exit_code, 69);
  EXPECT_THAT(result.err, HasSubstr("groma: node 10: the part is locked (APPROTECT)"));
  const json out = json::parse(result.out);
  EXPECT_EQ(out["nodes"][1]["flash"]["fault"], "locked");
  EXPECT_TRUE(out["nodes"][1]["configure"].is_null());
  EXPECT_EQ(out["nodes"][3]["configure"]["result"], "configured");

  std::vector<std::string> recover = flash_all();
  recover.insert(recover.end(), {"--node", "10", "--recover"});
  const ChildResult recovered = groma_run(recover);
  EXPECT_EQ(recovered.exit_code, 0) << recovered.err;
  EXPECT_TRUE(json::parse(recovered.out)["nodes"][0]["flash"]["unlocked"]);
  expect_all_done();
}

TEST_F(CommandTest, APortOfAnotherNodeThanTheProbesIsReported) {
  scratch_.write("node.hex", test::hex_of(test::small_image(4608, "other", 7)) + test::kHexEnd);
  std::vector<std::string> arguments = flash_all();
  arguments.insert(arguments.end(), {"--node", "10"});
  const ChildResult result = groma_run(arguments);
  EXPECT_EQ(result.exit_code, 78);
  EXPECT_THAT(result.err,
              HasSubstr("runs simulated (00000000), not other (00000007) that was flashed; check that this "
                        "port and the debug probe are those of one node"));
  EXPECT_EQ(json::parse(result.out)["nodes"][0]["configure"]["fault"], "other-build");
}

TEST_F(CommandTest, ConfigureKilledAtAnyTimeContinuesWhereItStopped) {
  int killed = 0;
  for (int after_ms = 5; after_ms < 200; after_ms += 15) {
    const auto begin = std::chrono::steady_clock::now();
    killed += kill_when(configure_all(), [&] {
      return std::chrono::steady_clock::now() - begin > std::chrono::milliseconds(after_ms);
    });
  }
  EXPECT_GE(killed, 2);
  const ChildResult rest = groma_run(configure_all());
  EXPECT_EQ(rest.exit_code, 0) << rest.err;
  const ChildResult again = groma_run(configure_all());
  EXPECT_EQ(again.exit_code, 0) << again.err;
  for (const json said = json::parse(again.out); const json& node : said.at("nodes")) {
    EXPECT_EQ(node["result"], "unchanged");
  }
}

TEST_F(CommandTest, ConfigureReportsEachFailureAndContinues) {
  scratch_.write("plan.yaml",
                 fmt::format("schema: 1\nnetwork_id: 77\nnodes:\n  - {{id: 1, role: tag, port: none}}\n"
                             "  - {{id: 10, role: anchor}}\n  - {{id: 11, role: anchor, port: {}}}\n",
                             nodes_[2].port));
  const ChildResult result = groma_run({"configure", "--plan", path("plan.yaml")});
  EXPECT_EQ(result.exit_code, 69);
  EXPECT_THAT(result.err, HasSubstr("groma: node 1: " + path("none") + ": no such device"));
  EXPECT_THAT(result.err, HasSubstr("groma: node 10: the plan names no port for it"));
  EXPECT_THAT(result.out, HasSubstr("11    anchor"));
  EXPECT_THAT(result.out, HasSubstr("configured"));
  EXPECT_EQ(groma_run({"configure", "--plan", path("plan.yaml"), "--node", "10"}).exit_code, 78);
  EXPECT_EQ(groma_run({"configure", "--plan", path("plan.yaml"), "--node", "10", "--link", nodes_[1].port})
                .exit_code,
            0);
}

TEST_F(CommandTest, IdentifyNamesTheBlinkingNode) {
  const ChildResult fresh = groma_run({"identify", nodes_[1].port, "--for", "1"});
  EXPECT_EQ(fresh.exit_code, 0) << fresh.err;
  EXPECT_EQ(fresh.out, nodes_[1].port + ": an unconfigured node blinks for 1 s\n");
  ASSERT_EQ(groma_run({"configure", "--plan", path("plan.yaml"), "--node", "10"}).exit_code, 0);
  const ChildResult configured =
      groma_run({"identify", "--plan", path("plan.yaml"), "--node", "10", "--json"});
  EXPECT_EQ(configured.exit_code, 0) << configured.err;
  EXPECT_EQ(json::parse(configured.out)["id"], 10);
  EXPECT_EQ(json::parse(configured.out)["role"], "anchor");
}

TEST_F(CommandTest, NodesWithoutACableAreReachedThroughATag) {
  ASSERT_EQ(groma_run(configure_all()).exit_code, 0);
  scratch_.write("hung.yaml", fmt::format("schema: 1\nnetwork_id: 77\nnodes:\n"
                                          "  - {{id: 1, role: tag, port: {}}}\n"
                                          "  - {{id: 10, role: anchor, via: 1}}\n"
                                          "  - {{id: 11, role: anchor, via: 1, transmit_power: 0x1F1F1F1F}}\n"
                                          "  - {{id: 12, role: anchor}}\n",
                                          nodes_[0].port));
  const ChildResult configured =
      groma_run({"configure", "--plan", path("hung.yaml"), "--via", nodes_[0].port, "--json"});
  EXPECT_EQ(configured.exit_code, 0) << configured.err;
  const json nodes = json::parse(configured.out)["nodes"];
  EXPECT_EQ(nodes[0]["over_air"], false);
  EXPECT_EQ(nodes[0]["result"], "unchanged");
  EXPECT_EQ(nodes[2]["over_air"], true);
  EXPECT_EQ(nodes[2]["result"], "configured");
  EXPECT_EQ(nodes[3]["result"], "unchanged");

  const ChildResult blinking = groma_run({"identify", nodes_[0].port, "--node", "12", "--for", "1"});
  EXPECT_EQ(blinking.exit_code, 0) << blinking.err;
  EXPECT_EQ(blinking.out, nodes_[0].port + ": anchor 12 of network 77 blinks for 1 s, over the air\n");

  const ChildResult asked = groma_run({"nodes", "--plan", path("hung.yaml"), "--node", "1,10,11", "--json"});
  EXPECT_EQ(asked.exit_code, 0) << asked.err;
  const json answered = json::parse(asked.out)["nodes"];
  ASSERT_EQ(answered.size(), 3U);
  EXPECT_EQ(answered[2]["id"], 11);
  EXPECT_EQ(answered[2]["role"], "anchor");
  EXPECT_GT(answered[2]["counters"]["beacons_received"], 0);
  const ChildResult missing = groma_run({"nodes", nodes_[0].port, "--node", "77"});
  EXPECT_EQ(missing.exit_code, 69);
  EXPECT_THAT(missing.err, ::testing::HasSubstr("no answer from node 77 over the air"));
}

TEST_F(CommandTest, ListenShowsTheRangesOfAConfiguredSite) {
  const ChildResult before = groma_run({"listen", nodes_[0].port, "--for", "1.5"});
  EXPECT_EQ(before.exit_code, 3);
  EXPECT_THAT(before.err, HasSubstr("no range received"));
  ASSERT_EQ(groma_run(configure_all()).exit_code, 0);
  const ChildResult after = groma_run({"listen", nodes_[0].port, "--for", "2.5", "--json"});
  EXPECT_EQ(after.exit_code, 0) << after.err;
  const json out = json::parse(after.out);
  EXPECT_EQ(out["sync"], "locked");
  EXPECT_EQ(out["master"], 10);
  ASSERT_EQ(out["pairs"].size(), 3U);
  const double distance_m = std::hypot(3.0, 4.0 - 5.0);  // live_site.hpp: tag 1 to anchor 10
  EXPECT_NEAR(out["pairs"][0]["mean_m"].get<double>(), distance_m, 0.1);
  EXPECT_GT(out["pairs"][0]["ranges"].get<int>(), 20);

  const ChildResult rows = groma_run({"listen", nodes_[0].port, "--for", "0.5", "--rows"});
  EXPECT_THAT(rows.out,
              ::testing::StartsWith("t_s,tag_id,anchor_id,range_m,first_path_power_dbm,receive_power_dbm,"
                                    "clock_offset_ppm,noise,line_of_sight,corrections,network_time_dtu\n1"));
}

TEST_F(CommandTest, ATagTakesHintsAndLeavesOnCommand) {
  ASSERT_EQ(groma_run(configure_all()).exit_code, 0);
  const std::string tag = nodes_[0].port;
  const std::string anchor = nodes_[1].port;
  const auto listen = [&](const char* for_s) { return groma_run({"listen", tag, "--for", for_s, "--json"}); };
  const json before = json::parse(listen("2.5").out);
  EXPECT_EQ(before["slot"], 0);
  EXPECT_EQ(before["candidates"], 3);
  EXPECT_EQ(before["answering"], 3);
  EXPECT_GT(before["temperature_c"].get<double>(), -40.0);
  EXPECT_LT(before["temperature_c"].get<double>(), 85.0);
  EXPECT_NEAR(before["supply_v"].get<double>(), 3.3, 0.5);
  EXPECT_GE(before["pairs"][0]["sight"].get<double>(), 0.9);

  // An unknown anchor becomes a candidate. The command works at the tag's port, and over the air through an
  // anchor.
  const ChildResult hinted = groma_run({"nodes", tag, "--node", "1", "--prefer", "99=120,12=0", "--json"});
  EXPECT_EQ(hinted.exit_code, 0) << hinted.err;
  const json answered = json::parse(hinted.out)["nodes"];
  ASSERT_EQ(answered.size(), 1U);
  EXPECT_EQ(answered[0]["told"], "prefer");
  EXPECT_EQ(answered[0]["id"], 1);
  EXPECT_GT(answered[0]["counters"]["ranges_completed"], 0);
  EXPECT_EQ(json::parse(listen("1.5").out)["candidates"], 4);
  const ChildResult none = groma_run({"nodes", anchor, "--node", "1", "--prefer", "none"});
  EXPECT_EQ(none.exit_code, 0) << none.err;

  const ChildResult refused = groma_run({"nodes", tag, "--leave", "11"});
  EXPECT_EQ(refused.exit_code, 78);
  EXPECT_THAT(refused.err, HasSubstr("only a tag has a slot to leave"));
  const ChildResult left = groma_run({"nodes", anchor, "--leave", "1", "--json"});
  EXPECT_EQ(left.exit_code, 0) << left.err;
  EXPECT_EQ(json::parse(left.out)["nodes"][0]["told"], "leave");
  const ChildResult after = listen("1.5");
  EXPECT_EQ(after.exit_code, 3) << after.out;
  EXPECT_TRUE(json::parse(after.out)["slot"].is_null());
  EXPECT_EQ(json::parse(after.out)["ranges"], 0);
}

TEST_F(CommandTest, APortInUseEndsWith69) {
  const link::OpenedLink other = link::open_link(nodes_[0].port, kBaud);
  ASSERT_TRUE(other.link);
  const ChildResult result = groma_run({"identify", nodes_[0].port});
  EXPECT_EQ(result.exit_code, 69);
  EXPECT_THAT(result.err, HasSubstr("in use by another program; 'fuser -v"));
}

TEST_F(CommandTest, MisuseEndsWith2) {
  const std::string plan = path("plan.yaml");
  EXPECT_EQ(groma_run({"configure"}).exit_code, 2);
  EXPECT_EQ(groma_run({"configure", "--plan", plan, "--node", "4"}).exit_code, 2);
  EXPECT_EQ(groma_run({"configure", "--plan", plan, "--link", "x"}).exit_code, 2);
  EXPECT_EQ(groma_run({"identify"}).exit_code, 2);
  EXPECT_EQ(groma_run({"identify", "x", "--plan", plan}).exit_code, 2);
  EXPECT_EQ(groma_run({"identify", "--plan", plan}).exit_code, 2);
  EXPECT_EQ(groma_run({"identify", "x", "--for", "4000"}).exit_code, 2);
  EXPECT_EQ(groma_run({"nodes", "x", "--leave", "1,2"}).exit_code, 2);
  EXPECT_EQ(groma_run({"nodes", "x", "--leave", "1", "--prefer", "10=1"}).exit_code, 2);
  EXPECT_EQ(groma_run({"nodes", "x", "--prefer", "10=1"}).exit_code, 2);
  for (const char* hints : {"10", "10=", "10=256", "10=-1", "=1", "10=1x", "10=1,,"}) {
    EXPECT_EQ(groma_run({"nodes", "x", "--node", "1", "--prefer", hints}).exit_code, 2) << hints;
  }
  EXPECT_EQ(groma_run({"flash", "--image", path("node.hex"), "--adapter", "parport"}).exit_code, 2);
  EXPECT_EQ(groma_run({"flash", "--node", "1"}).exit_code, 2);
  EXPECT_EQ(groma_run({"flash", "--all", "--plan", plan}).exit_code, 2);
  EXPECT_EQ(groma_run({"flash", "--plan", plan, "--probe", "p1"}).exit_code, 2);
}

TEST_F(CommandTest, FlashNamesWhatIsMissing) {
  const std::string image = path("node.hex");
  const ChildResult no_image = groma_run({"flash", "--image", path("none.hex")});
  EXPECT_EQ(no_image.exit_code, 65);
  EXPECT_THAT(no_image.err, HasSubstr("none.hex: no such image; build it: cmake --preset dwm1001"));
  const ChildResult no_openocd = groma_run({"flash", "--image", image, "--openocd", path("openocd")});
  EXPECT_EQ(no_openocd.exit_code, 69);
  EXPECT_THAT(no_openocd.err, HasSubstr("not installed; 'sudo apt-get install openocd'"));
  scratch_.write("few.yaml",
                 "schema: 1\nnetwork_id: 1\nnodes: [{id: 1, role: tag}, {id: 2, role: anchor}]\n");
  const ChildResult no_probe = groma_run({"flash", "--image", image, "--plan", path("few.yaml")});
  EXPECT_EQ(no_probe.exit_code, 78);
  EXPECT_THAT(no_probe.err, HasSubstr("few.yaml: names no probe for node 1; add 'probe:' to it"));
}

TEST_F(CommandTest, FlashWithoutAPlanDoesNotConfigure) {
  const ChildResult result =
      groma_run({"flash", "--image", path("node.hex"), "--adapter", path("probe.cfg"), "--probe", "p11"});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  EXPECT_THAT(result.out, HasSubstr("p11    flashed  simulated"));
  EXPECT_EQ(parts_[2]->pages_erased(), 2);
  EXPECT_EQ(parts_[1]->pages_erased(), 0);
}

TEST_F(CommandTest, FlashRefusesTheImageOfAnotherBoardBeforeAnythingIsErased) {
  scratch_.write("other.hex",
                 test::hex_of(test::small_image(4608, "simulated", 0, "nrf52832_dw1000")) + test::kHexEnd);
  std::vector<std::string> arguments{"flash",   "--image", path("other.hex"), "--adapter", path("probe.cfg"),
                                     "--probe", "p11",     "--json"};
  const ChildResult refused = groma_run(arguments);
  EXPECT_EQ(refused.exit_code, 65);
  EXPECT_THAT(refused.err,
              HasSubstr("other.hex: is an image of the board nrf52832_dw1000, whose pins are not "
                        "those of dwm1001; give the image of dwm1001"));
  EXPECT_EQ(parts_[2]->pages_erased(), 0);
  EXPECT_EQ(groma_run({"flash", "--image", path("other.hex"), "--adapter", path("probe.cfg"), "--plan",
                       path("plan.yaml")})
                .exit_code,
            65);
  for (const auto& part : parts_) EXPECT_EQ(part->pages_erased(), 0);

  arguments.insert(arguments.end(), {"--board", "nrf52832_dw1000"});
  const ChildResult flashed = groma_run(arguments);
  EXPECT_EQ(flashed.exit_code, 0) << flashed.err;
  EXPECT_EQ(json::parse(flashed.out)["image"]["board"], "nrf52832_dw1000");
  EXPECT_EQ(parts_[2]->pages_erased(), 2);
}

TEST_F(CommandTest, FlashWarnsOfAnImageThatNamesNoBoard) {
  std::vector<std::uint8_t> old = image_;
  old[0x100 + offsetof(node::ImageIdentity, board_mark)] ^= 1U;
  scratch_.write("old.hex", test::hex_of(old) + test::kHexEnd);
  const ChildResult result = groma_run(
      {"flash", "--image", path("old.hex"), "--adapter", path("probe.cfg"), "--probe", "p11", "--json"});
  EXPECT_EQ(result.exit_code, 3) << result.err;
  EXPECT_THAT(result.err,
              HasSubstr("old.hex: the image names no board; make sure that it is of the board dwm1001"));
  EXPECT_TRUE(json::parse(result.out)["image"]["board"].is_null());
  EXPECT_EQ(parts_[2]->pages_erased(), 2);
}

TEST(FlashCommand, PrintsItsUdevRules) {
  const ChildResult result = groma_run({"flash", "--udev-rules"});
  EXPECT_EQ(result.exit_code, 0);
  EXPECT_EQ(result.out, groma::test::read_text(GROMA_UDEV_RULES));
}

TEST(FlashCommand, ListsProbesAsJson) {
  const ChildResult result = groma_run({"flash", "--list", "--json"});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  EXPECT_TRUE(json::parse(result.out)["probes"].is_array());
}

}  // namespace
}  // namespace groma::provision
