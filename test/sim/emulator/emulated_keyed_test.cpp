// The shipped image in a keyed network: its ECB makes and checks the same codes as the native nodes'
// software.
#include <gtest/gtest.h>

#include "test/sim/emulator/emulated_site.hpp"

namespace groma::sim {
namespace {

TEST(ShippedImageWithAKey, RangesWithNativeNodesAndIsLateForNothing) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  SiteSettings settings{.tags = 1,
                        .anchors = 2,
                        .method = groma_RangingMethod_METHOD_DS_NEXT_POLL,
                        .turn_round_us = 300,
                        .response_gap_us = 100};
  settings.network_key = security::Key{1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};
  // The tag and the second anchor; the master is native.
  SiteBench site(emulating(settings, {}, [](std::uint16_t id) { return id != nth_anchor(0); }));
  site.run_until(2.2);
  const double rate = 2.0 / (static_cast<double>(site.superframe().duration().count()) / 63.8976e9);
  EXPECT_GT(site.good_ranges(1.2), 0.95 * rate);
  site.each_range([&](const groma_SlotReport&, const groma_Range& range) {
    if (range.status != groma_RangeStatus_RANGE_OK) return;
    const double truth = site.space.distance_m(1, static_cast<std::uint16_t>(range.anchor_id));
    EXPECT_NEAR(static_cast<double>(range.range_m), truth, 0.1);
  });
  for (const Listener& listener : site.listeners) {
    EXPECT_EQ(listener.counters.forged_frames, 0U);
    EXPECT_EQ(listener.counters.unsecured_frames, 0U);
    EXPECT_EQ(listener.counters.late_transmits, 0U);
    EXPECT_EQ(listener.counters.late_receives, 0U);
  }
  EXPECT_GT(emulated(site, 0).soc().ecb().blocks(), 1'000U);
  EXPECT_GT(emulated(site, 2).soc().ecb().blocks(), 1'000U);
}

}  // namespace
}  // namespace groma::sim
