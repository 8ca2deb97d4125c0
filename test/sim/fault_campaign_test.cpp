// A site of native nodes that loses frames, anchors, masters and power, and what comes of its ranges.
#include "test/sim/fault_campaign.hpp"

#include <gtest/gtest.h>

namespace groma::sim {
namespace {

std::vector<FaultPhase> phases(const FaultSite& site, groma_RangingMethod method) {
  return {
      {.name = "power on", .rise = all_of(3, 12), .newcomers_within = 40.0, .watched_s = 1.5},
      nothing_wrong(1.0),
      loss(0.3, 10.0, method),
      beacons_lost(10.0, site.superframe_s()),
      killed("two anchors killed", {105, 108}),
      reborn("one of them reborn", 105),
      brown_out<mac::Response>("brown-out in a RESPONSE", 106, 0.5, 0.005),
      brown_out<mac::Response>("brown-out before a RESPONSE", 107, -0.5, 0.002),
      brown_out<mac::Poll>("brown-out in a POLL", 2, 0.7, 0.005),
      another_network("another network on the channel", 8, 1, 3.0),
      another_network("one with our id, older schedule", 7, 2, 3.0),
      tag_joins("a tag joins", 9),
      killed("a tag leaves", {2}, 3.0, 110.0 * site.superframe_s()),
      tag_joins("another takes its slot", 10),
      brown_out<mac::Beacon>("brown-out of the master in a beacon", 101, 0.6, 0.005),
      killed("master killed", {101}, 10.0, 2.0),
      reborn("master reborn", 101, 10.0),
      cut_off("master alone: two masters", {101}, 2.0),
      meet_again("they meet"),
      cut_off("site cut in two", {101, 1, 103, 105, 106, 107}, 1.2),
      meet_again("its halves meet"),
      nothing_wrong(1.0),
  };
}

// What the nodes counted is what happened to their radios, and each leg of each exchange is a range or a lost
// one. Of nodes that did not restart meanwhile.
void expect_counters_account(FaultSite& site, const std::vector<std::uint16_t>& ids) {
  for (const std::uint16_t id : ids) {
    const groma_Counters told = site.counters(id);
    const groma_Counters& seen = site.air.endings.at(id);
    EXPECT_EQ(told.crc_errors, seen.crc_errors) << id;
    EXPECT_EQ(told.header_errors, seen.header_errors) << id;
    EXPECT_EQ(told.sfd_timeouts, seen.sfd_timeouts) << id;
    EXPECT_EQ(told.frame_timeouts, seen.frame_timeouts) << id;
    EXPECT_GT(told.crc_errors, 0U) << id;
    EXPECT_GT(told.header_errors, 0U) << id;
    EXPECT_GT(told.sfd_timeouts, 0U) << id;
    EXPECT_EQ(told.radio_recoveries, 0U) << id;
    EXPECT_EQ(told.reports_dropped, 0U) << id;
    // What the radio does between the answer and now.
    constexpr double kSince = 40.0;
    EXPECT_NEAR(told.frames_received, seen.frames_received, kSince) << id;
    EXPECT_NEAR(told.preamble_timeouts, seen.preamble_timeouts, kSince) << id;
    if (id >= FaultSite::anchor_id(0)) continue;
    double good = 0.0;
    double lost = 0.0;
    for (const SeenRange& range : site.ranges())
      if (range.tag == id) (range.good ? good : lost) += 1.0;
    EXPECT_NEAR(told.ranges_completed, good, kSince) << id;
    EXPECT_NEAR(told.ranges_lost, lost, kSince) << id;
  }
}

class FaultCampaignTest : public testing::TestWithParam<std::tuple<std::uint64_t, groma_RangingMethod>> {};

TEST_P(FaultCampaignTest, EachFaultCostsNoMoreThanItMustAndNoRangeIsEverWrong) {
  const auto [seed, method] = GetParam();
  FaultSite site({.method = method, .seed = seed});
  FaultCampaign campaign(site);
  campaign.run(phases(site, method));
  EXPECT_TRUE(campaign.sound()) << campaign.table();
  EXPECT_GT(campaign.good(), 20'000U);
  EXPECT_LT(campaign.worst_sigmas(), 6.0);
  // As noisy as it should be: of so many the worst is not near.
  EXPECT_GT(campaign.worst_sigmas(), 3.5);
  expect_counters_account(site, {1, 3, 102, 103, 104, 109});
  for (const std::uint16_t id : site.ids()) {
    EXPECT_EQ(site.chip(id).garbled_transfers(), 0U) << id;
    EXPECT_EQ(site.listener(id).undecodable, 0) << id;
  }
  for (const std::uint16_t id : std::vector<std::uint16_t>{1, 3, 102, 103})
    EXPECT_GE(site.chip(id).ticks(site.network.now()) >> 40, 1) << id << " has not come over its 40 bits";
  std::printf("%s", campaign.table().c_str());
}

INSTANTIATE_TEST_SUITE_P(Seeds, FaultCampaignTest,
                         testing::Combine(testing::Range<std::uint64_t>(GROMA_FIRST_SEED,
                                                                        GROMA_LAST_SEED + 1),
                                          testing::Values(groma_RangingMethod_METHOD_DS_NEXT_POLL,
                                                          groma_RangingMethod_METHOD_DS_FINAL)));

}  // namespace
}  // namespace groma::sim
