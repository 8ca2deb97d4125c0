// How fast a site of shipped images ranges, at the honest cost of a transfer and an instruction.
#include <gtest/gtest.h>

#include "test/sim/emulator/fast_site.hpp"

namespace groma::sim {
namespace {

TEST(SiteRate, ThreeTagsAndTwelveAnchorsMake1650RangesASecond) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(fast_site()), 0.5), 1'650.0);
}

TEST(SiteRate, ArmingAheadTheyMake1900RangesASecond) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(arming_ahead(fast_site())), 0.5), 1'900.0);
}

TEST(KeyedSiteRate, ThreeTagsAndTwelveAnchorsMake1500RangesASecond) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(with_key(fast_site())), 0.25), 1'500.0);
}

TEST(KeyedSiteRate, ArmingAheadTheyMake1800RangesASecond) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(arming_ahead(with_key(fast_site()))), 0.25), 1'800.0);
}

// No cliff: only ranges whose own deadline was missed are lost.
TEST(SiteRate, AtThreeCyclesAnInstructionMoreThanHalfOfTheScheduleIsLeft) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  for (const SiteSettings& settings : {fast_site(), arming_ahead(fast_site())}) {
    const SiteRate rate = measure_rate(emulating(settings, slow_processor()), 0.25);
    EXPECT_GT(rate.ranges_per_s, 0.5 * rate.schedule_per_s);
    EXPECT_EQ(rate.recoveries, 0);
  }
}

// The tests above can detect late transmits only if a slow processor causes them.
TEST(KeyedSiteRate, MuchIsLateAtTenCyclesAnInstruction) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  EmulatorOptions slow;
  slow.timing.instruction = 10 * slow.timing.cycle;
  SiteBench site(emulating(with_key(fast_site()), slow));
  site.run_until(2.5);
  std::uint32_t late = 0;
  for (const Listener& listener : site.listeners) late += listener.counters.late_transmits;
  EXPECT_GT(late, 100U);
}

}  // namespace
}  // namespace groma::sim
