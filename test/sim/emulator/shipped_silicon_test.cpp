// The shipped image on silicon with each of its quirks (silicon.hpp).
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>

#include "firmware/sim/simulation_error.hpp"
#include "test/sim/emulator/emulated_site.hpp"

namespace groma::sim {
namespace {

class ShippedSilicon : public testing::Test {
 protected:
  void SetUp() override { GROMA_NEEDS_SHIPPED_IMAGE(); }
};

struct Outcome {
  std::string error;      // a misuse of the hardware, which ended the run
  int good_ranges = 0;    // in a second
  int damaged_bytes = 0;  // on the tag's line to its host
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

// The image sleeps during its SPI transfers.
TEST_F(ShippedSilicon, CannotUseItsRadioBecauseItSleepsAtTheStartOfTransfers) {
  EXPECT_GT(outcome_of({}, small_site()).good_ranges, 100);
  EXPECT_EQ(outcome_of({.silicon = {.spim_start = true}}, small_site()).good_ranges, 0);
}

// It starts the next piece of a message and the next block of a MIC in interrupts, and may have slept before.
TEST_F(ShippedSilicon, DamagesMessagesBecauseItSleepsAtTheirStart) {
  EXPECT_EQ(outcome_of({}, small_site()).damaged_bytes, 0);
  EXPECT_GT(outcome_of({.silicon = {.uarte_start = true}}, small_site()).damaged_bytes, 0);
}

TEST_F(ShippedSilicon, LosesRangesBecauseItSleepsAtTheStartOfBlocks) {
  const int all = outcome_of({}, keyed_site()).good_ranges;
  EXPECT_GT(all, 100);
  EXPECT_LT(outcome_of({.silicon = {.ecb_start = true}}, keyed_site()).good_ranges, all * 9 / 10);
}

}  // namespace
}  // namespace groma::sim
