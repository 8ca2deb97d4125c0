// How fast a site of shipped images ranges.
#include <gtest/gtest.h>

#include "test/sim/emulator/fast_site.hpp"

namespace groma::sim {
namespace {

TEST(SiteRate, ThreeTagsAndTwelveAnchorsMake2280RangesASecond) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(fast_site()), 1.0));
}

TEST(SiteRate, NothingIsSentLateWhereEachInstructionCosts1p5TimesAsMuch) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  EmulatorOptions slow;
  slow.timing.instruction = slow.timing.instruction * 3 / 2;
  expect_fast(measure_rate(emulating(fast_site(), slow), 0.5));
}

}  // namespace
}  // namespace groma::sim
