// The same as site_rate_test.cpp, for a minute each.
#include "test/sim/emulator/fast_site.hpp"

namespace groma::sim {
namespace {

constexpr double kMinute_s = 60.0;

TEST(SiteRateCampaign, ThreeTagsAndTwelveAnchorsMake1650RangesASecondForAMinute) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(fast_site()), kMinute_s, 2), 1'650.0);
}

TEST(SiteRateCampaign, ArmingAheadTheyMake1900RangesASecondForAMinute) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(arming_ahead(fast_site())), kMinute_s, 2), 1'900.0);
}

TEST(SiteRateCampaign, WithAKeyTheyMake1500RangesASecondForAMinute) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(with_key(fast_site())), kMinute_s, 2), 1'500.0);
}

TEST(SiteRateCampaign, WithAKeyAndArmingAheadTheyMake1800RangesASecondForAMinute) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  expect_fast(measure_rate(emulating(arming_ahead(with_key(fast_site()))), kMinute_s, 2), 1'800.0);
}

}  // namespace
}  // namespace groma::sim
