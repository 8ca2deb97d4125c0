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

// Only the first RESPONSE of each POLL is late.
TEST(SiteRateCampaign, AtThreeAndAHalfCyclesAnInstructionMoreThanHalfOfTheScheduleIsLeft) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  EmulatorOptions slow;
  slow.timing.instruction = 7 * slow.timing.cycle / 2;
  for (const SiteSettings& settings :
       {fast_site(), arming_ahead(fast_site()), with_key(fast_site()), arming_ahead(with_key(fast_site()))}) {
    const SiteRate rate = measure_rate(emulating(settings, slow), 1.0, 2);
    EXPECT_GT(rate.ranges_per_s, 0.5 * rate.schedule_per_s);
    EXPECT_EQ(rate.recoveries, 0);
  }
}

}  // namespace
}  // namespace groma::sim
