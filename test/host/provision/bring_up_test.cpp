// From unconfigured modules to a ranging network, with the shipped image: OpenOCD flashes it into an emulated
// part; nodes run the content of that flash, are configured by the command, and range.
#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstddef>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "firmware/sim/emulator/firmware_image.hpp"
#include "host/link/report_decoder.hpp"
#include "host/provision/configure.hpp"
#include "test/host/provision/emulated_part.hpp"
#include "test/host/provision/emulated_probe.hpp"
#include "test/host/provision/live_site.hpp"
#include "test/host/provision/small_image.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"
#include "test/support/shipped_image.hpp"

namespace groma::provision {
namespace {

using groma::test::run_child;
using groma::test::ScratchFolder;
using nlohmann::json;
using test::EmulatedPart;
using test::EmulatedProbe;
using test::LiveSite;

TEST(BringUp, TheShippedImageIsFlashedConfiguredAndRanges) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  const ScratchFolder scratch;
  const std::string hex = groma::test::shipped_image(".hex");
  scratch.write("probe.cfg", test::probe_configuration(scratch.path()));
  EmulatedPart part;
  part.lock();
  const EmulatedProbe probe(scratch / "p.sock", &part);
  const auto flashed = run_child({GROMA_EXECUTABLE, "flash", "--image", hex, "--adapter",
                                  scratch / "probe.cfg", "--probe", "p", "--recover", "--json"});
  ASSERT_EQ(flashed.exit_code, 0) << flashed.err;
  const json image = json::parse(flashed.out)["image"];

  sim::FirmwareImage contents;
  contents.flash = part.flash();
  EXPECT_EQ(contents.flash, sim::read_firmware_image(hex).flash);
  LiveSite site(&contents);
  std::string plan = "schema: 1\nnetwork_id: 77\nnodes:\n";
  for (const PlannedNode& node : site.plan().nodes) {
    plan +=
        fmt::format("  - {{id: {}, role: {}, port: {}}}\n", node.id, link::role_word(node.role), node.port);
  }
  scratch.write("plan.yaml", plan);
  for (const char* result : {"configured", "unchanged"}) {
    const auto configured =
        run_child({GROMA_EXECUTABLE, "configure", "--plan", scratch / "plan.yaml", "--json"});
    ASSERT_EQ(configured.exit_code, 0) << configured.err;
    const json nodes = json::parse(configured.out)["nodes"];
    ASSERT_EQ(nodes.size(), 4U);
    for (const json& node : nodes) {
      EXPECT_EQ(node["result"], result);
      EXPECT_EQ(node["version"], image["version"]);
      EXPECT_EQ(node["git_hash"], image["git_hash"]);
    }
  }
  std::size_t anchors = 0;
  for (int tries = 0; tries < 10 && anchors < 3; ++tries) {  // the emulator may be slower than the clock
    const auto listened =
        run_child({GROMA_EXECUTABLE, "listen", site.plan().nodes[0].port, "--for", "3", "--json"});
    anchors = json::parse(listened.out)["pairs"].size();
  }
  EXPECT_EQ(anchors, 3U);
}

}  // namespace
}  // namespace groma::provision
