// A site of shipped images under loss of frames, anchors, masters and power, and the effect on its ranges.
#include <gtest/gtest.h>

#include "test/sim/emulator/emulated_site.hpp"
#include "test/sim/fault_campaign.hpp"

namespace groma::sim {
namespace {

constexpr int kTags = 3;
constexpr int kAnchors = 6;

// With a slot for a joining tag.
FaultSiteSettings site_of_images(std::uint64_t seed, groma_RangingMethod method) {
  return emulating(FaultSiteSettings{
      .tags = kTags, .anchors = kAnchors, .backups = 3, .slots = 4, .method = method, .seed = seed});
}

std::vector<FaultPhase> phases(const FaultSite& site, groma_RangingMethod method) {
  return {
      {.name = "power on", .rise = all_of(kTags, kAnchors), .newcomers_within = 60.0, .watched_s = 1.5},
      no_fault(0.5),
      loss(0.3, 5.0, method),
      beacons_lost(10.0, site.superframe_s()),
      killed("an anchor killed", {105}),
      restarted("and restarted", 105),
      brown_out<mac::Response>("brown-out in a RESPONSE", 106, 0.5, 0.005),
      brown_out<mac::Poll>("brown-out in a POLL", 2, 0.7, 0.005),
      another_network("another network on the channel", 8, 1, 1.0),
      tag_joins("a tag joins", 9),
      brown_out<mac::Beacon>("brown-out of the master in a beacon", 101, 0.6, 0.005),
      killed("master killed", {101}, 10.0, 1.0),
      restarted("master restarted", 101, 10.0),
      cut_off("master alone: two masters", {101}, 1.0),
      meet_again("they meet"),
      no_fault(0.5),
  };
}

class EmulatedFaultCampaign : public testing::TestWithParam<std::tuple<std::uint64_t, groma_RangingMethod>> {
};

TEST_P(EmulatedFaultCampaign, FaultsStayWithinTheirBoundsAndNoRangeIsWrong) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  const auto [seed, method] = GetParam();
  FaultSite site(site_of_images(seed, method));
  FaultCampaign campaign(site);
  campaign.run(phases(site, method));
  expect_no_harm(site, campaign);
  EXPECT_GT(campaign.good(), 10'000U);
  EXPECT_GT(campaign.worst_sigmas(), 3.0);  // as noisy as expected
  const std::vector<std::uint16_t> never_off{1, 3, 102, 103, 104};
  expect_counters_account(site, never_off);
  for (const std::uint16_t id : never_off) {
    const groma_Counters& counted = site.listener(id).counters;
    EXPECT_LE(1'000 * counted.late_transmits, counted.frames_sent) << id;
  }
  std::printf("%s", campaign.table().c_str());
}

constexpr std::array kMethods{groma_RangingMethod_METHOD_DS_NEXT_POLL, groma_RangingMethod_METHOD_DS_FINAL};

INSTANTIATE_TEST_SUITE_P(
    Seeds, EmulatedFaultCampaign,
    testing::Combine(testing::Range<std::uint64_t>(GROMA_FIRST_SEED, GROMA_LAST_SEED + 1),
                     testing::ValuesIn(kMethods.begin(), kMethods.begin() + GROMA_METHODS)));

}  // namespace
}  // namespace groma::sim
