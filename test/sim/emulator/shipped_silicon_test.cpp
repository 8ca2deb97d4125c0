// The shipped image on silicon with each of its quirks (silicon.hpp).
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdint>
#include <string>
#include <utility>

#include "firmware/sim/simulation_error.hpp"
#include "test/sim/emulator/emulated_site.hpp"

namespace groma::sim {
namespace {

class ShippedSilicon : public testing::Test {
 protected:
  void SetUp() override { GROMA_NEEDS_SHIPPED_IMAGE(); }
};

struct Outcome {
  std::string error;                 // a misuse of the hardware, which ended the run
  int good_ranges = 0;               // in a second
  int damaged_bytes = 0;             // on the tag's line to its host
  std::uint64_t spoiled_blocks = 0;  // of the tag's ECB
};

// A tag that runs the image, in a network of native anchors.
Outcome outcome_of(const EmulatorOptions& options, const SiteSettings& settings) {
  SiteBench site(emulating(settings, options, [](std::uint16_t id) { return id == nth_tag(0); }));
  Outcome out;
  try {
    site.run_until(2.0);
  } catch (const SimulationError& error) {
    out.error = error.what();
  }
  out.good_ranges = site.good_ranges(1.0);
  out.damaged_bytes = static_cast<int>(site.listeners[0].frames().bytes_discarded);
  out.spoiled_blocks = emulated(site, 0).soc().ecb().spoiled_blocks();
  return out;
}

SiteSettings small_site() {
  return {.tags = 1, .anchors = 3};
}

SiteSettings keyed_site() {
  SiteSettings settings = small_site();
  settings.network_key = security::Key{1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};
  return settings;
}

// ---- anomaly 109 ------------------------------------------------------------------------------------------

// It sleeps again soon after an interrupt that starts the next piece of a message.
EmulatorOptions fast_processor(const SiliconQuirks& silicon = {}) {
  EmulatorOptions options;
  options.timing.instruction /= 64;
  options.silicon = silicon;
  return options;
}

TEST_F(ShippedSilicon, StaysAwakeDuringSpiTransfers) {
  const Outcome out = outcome_of({}, small_site());
  EXPECT_EQ(out.error, "");
  EXPECT_GT(out.good_ranges, 100);
  EXPECT_EQ(out.good_ranges, outcome_of({.silicon = {.spim_start = false}}, small_site()).good_ranges);
}

TEST_F(ShippedSilicon, StaysAwakeAtTheStartOfMessages) {
  const Outcome out = outcome_of(fast_processor(), small_site());
  EXPECT_EQ(out.error, "");
  EXPECT_GT(out.good_ranges, 100);
  EXPECT_EQ(out.damaged_bytes, 0);
}

TEST_F(ShippedSilicon, StaysAwakeWhileBlocksAreEncrypted) {
  const Outcome out = outcome_of(fast_processor(), keyed_site());
  EXPECT_EQ(out.error, "");
  EXPECT_GT(out.good_ranges, 100);
  EXPECT_EQ(out.spoiled_blocks, 0U);
}

// ---- anomaly 220 ------------------------------------------------------------------------------------------

TEST_F(ShippedSilicon, WritesNoMemoryJustAfterItsWakeUps) {
  const Outcome out = outcome_of({}, small_site());
  EXPECT_EQ(out.error, "");
  EXPECT_GT(out.good_ranges, 100);
}

// ---- SCK --------------------------------------------------------------------------------------------------

TEST_F(ShippedSilicon, ConnectsTheInputBufferOfBothSpiClocks) {
  SiteSettings settings = small_site();
  // The tag looks for a controller; none answers, so it reports over its UART.
  settings.configure = [](groma_Config& config) {
    if (config.role == groma_Role_ROLE_TAG) config.link = groma_Link_LINK_CAN;
  };
  const Outcome out = outcome_of({}, settings);
  EXPECT_EQ(out.error, "");
  EXPECT_GT(out.good_ranges, 100);
}

// ---- anomaly 132 ------------------------------------------------------------------------------------------

// The error of a node whose reset button is pressed.
std::string error_after_reset(const EmulatorOptions& options) {
  FreeSpace space;
  space.put(1, {});
  Network network(space, {}, 1);
  NodeSpec spec;
  spec.chip.id = 1;
  auto owned = make_emulated_node(spec, shipped(), network.medium(), options);
  EmulatedNode& node = *owned;
  network.add(std::move(owned));
  network.run_until(from_seconds(0.5));
  node.press_reset(network.now());
  try {
    network.run_until(from_seconds(1.0));
  } catch (const SimulationError& error) {
    return error.what();
  }
  return {};
}

// However soon its memory is initialized and its main crystal runs.
TEST_F(ShippedSilicon, WaitsAfterAResetBeforeItStartsItsSlowClock) {
  EXPECT_EQ(error_after_reset({}), "");
  EXPECT_EQ(error_after_reset(fast_processor({.hfxo_start = 100 * kUnitsPerMicrosecond})), "");
}

}  // namespace
}  // namespace groma::sim
