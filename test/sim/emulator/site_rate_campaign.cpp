// The same as site_rate_test.cpp, for a minute each.
#include "test/sim/emulator/fast_site.hpp"

namespace groma::sim {
namespace {

TEST(SiteRateCampaign, ThreeTagsAndTwelveAnchorsMake2280RangesASecondForAMinute) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(fast_site()), 60.0, 1.0, 2));
}

TEST(SiteRateCampaign, WithAKeyTheyMake2240RangesASecondForAMinute) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(fast_keyed_site()), 60.0, 1.0, 2), 2'240.0);
}

TEST(SiteRateCampaign, WithAKeyNothingIsSentLateIfEachInstructionCosts1p5TimesAsMuch) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(fast_keyed_site(), slow_processor()), 60.0, 1.0, 2), 2'240.0);
}

}  // namespace
}  // namespace groma::sim
