// How fast a site of shipped images ranges.
#include <gtest/gtest.h>

#include "test/sim/emulator/fast_site.hpp"

namespace groma::sim {
namespace {

TEST(SiteRate, ThreeTagsAndTwelveAnchorsMake2280RangesASecond) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(fast_site()), 1.0));
}

TEST(SiteRate, NothingIsSentLateIfEachInstructionCosts1p5TimesAsMuch) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(fast_site(), slow_processor()), 0.5));
}

// The schedule gives 2255. A quarter of a second may miss a superframe at either end.
TEST(KeyedSiteRate, ThreeTagsAndTwelveAnchorsMake2100RangesASecond) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(fast_keyed_site()), 0.25), 2'100.0);
}

TEST(KeyedSiteRate, NothingIsSentLateIfEachInstructionCosts1p5TimesAsMuch) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(fast_keyed_site(), slow_processor()), 0.25), 2'100.0);
}

// The tests above can detect late transmits only if a slow processor causes them.
TEST(KeyedSiteRate, MuchIsLateIfEachInstructionCosts5TimesAsMuch) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  EmulatorOptions slow;
  slow.timing.instruction *= 5;
  EXPECT_GT(measure_rate(emulating(fast_keyed_site(), slow), 0.1).late_transmits, 100);
}

}  // namespace
}  // namespace groma::sim
