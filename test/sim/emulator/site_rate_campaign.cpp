// The same as site_rate_test.cpp, for a minute.
#include "test/sim/emulator/fast_site.hpp"

namespace groma::sim {
namespace {

TEST(SiteRateCampaign, ThreeTagsAndTwelveAnchorsMake2280RangesASecondForAMinute) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(fast_site()), 60.0, 1.0, 2));
}

}  // namespace
}  // namespace groma::sim
