// A site of native nodes under loss of frames, anchors, masters and power, and the effect on its ranges.
#include "test/sim/fault_campaign.hpp"

#include <gtest/gtest.h>

namespace groma::sim {
namespace {

constexpr double kMergeWithin = 10.0;  // superframes

std::vector<FaultPhase> phases(const FaultSite& site, groma_RangingMethod method) {
  return {
      {.name = "power on", .rise = all_of(3, 12), .newcomers_within = 40.0, .watched_s = 1.5},
      no_fault(1.0),
      loss(0.3, 10.0, method),
      beacons_lost(10.0, site.superframe_s()),
      killed("two anchors killed", {105, 108}),
      restarted("one of them restarted", 105),
      brown_out<mac::Response>("brown-out in a RESPONSE", 106, 0.5, 0.005),
      brown_out<mac::Response>("brown-out before a RESPONSE", 107, -0.5, 0.002),
      brown_out<mac::Poll>("brown-out in a POLL", 2, 0.7, 0.005),
      another_network("another network on the channel", 8, 1, 10.0),
      another_network("one with our id, older schedule", 7, 2, 3.0),
      tag_joins("a tag joins", 9),
      killed("a tag leaves", {2}, 3.0, 110.0 * site.superframe_s()),
      tag_joins("another takes its slot", 10),
      brown_out<mac::Beacon>("brown-out of the master in a beacon", 101, 0.6, 0.005),
      killed("master killed", {101}, 10.0, 2.0),
      restarted("master restarted", 101, 10.0),
      cut_off("master alone: two masters", {101}, 2.0),
      meet_again("they meet"),
      cut_off("site cut in two", {101, 1, 103, 105, 106, 107}, 1.2),
      meet_again("its halves meet"),
      no_fault(1.0),
  };
}

// A keyed site whose parts are separated and meet again: each part with its own master, and the old master,
// restarted, with its own session.
class KeyedFaultCampaignTest : public testing::TestWithParam<std::uint64_t> {};

TEST_P(KeyedFaultCampaignTest, PartsThatMeetAgainMerge) {
  FaultSite site(
      {.network_key = security::Key{3, 1, 4, 1, 5, 9, 2, 6, 5, 3, 5, 8, 9, 7, 9, 3}, .seed = GetParam()});
  const auto off = [](FaultSite& of) { of.set_power(101, false); };
  const auto alone = [](FaultSite& of) {
    of.set_power(101, true);
    of.cut_off({101}, 3.0);
  };
  FaultCampaign campaign(site);
  campaign.run({
      {.name = "power on", .rise = all_of(3, 12), .newcomers_within = 160.0, .watched_s = 4.0},
      no_fault(1.0),
      cut_off("master alone: two masters", {101}, 2.0),
      meet_again("they meet", kMergeWithin),
      cut_off("site cut in two", {101, 1, 103, 105, 106, 107}, 1.2),
      meet_again("its halves meet", kMergeWithin),
      {.name = "master killed", .begin = off, .die = {101}, .within = 10.0, .watched_s = 2.0},
      {.name = "and restarted alone", .begin = alone, .watched_s = 3.0},
      {.name = "it meets the others",
       .rise = {101},
       .within = kMergeWithin,
       .newcomers_within = kMergeWithin},
      no_fault(1.0),
  });
  expect_no_harm(site, campaign);
  std::printf("%s", campaign.table().c_str());
}

INSTANTIATE_TEST_SUITE_P(Seeds, KeyedFaultCampaignTest,
                         testing::Range<std::uint64_t>(GROMA_FIRST_SEED, GROMA_LAST_SEED + 1));

class FaultCampaignTest : public testing::TestWithParam<std::tuple<std::uint64_t, groma_RangingMethod>> {};

TEST_P(FaultCampaignTest, FaultsStayWithinTheirBoundsAndNoRangeIsWrong) {
  const auto [seed, method] = GetParam();
  FaultSite site({.method = method, .seed = seed});
  FaultCampaign campaign(site);
  campaign.run(phases(site, method));
  expect_no_harm(site, campaign);
  EXPECT_GT(campaign.good(), 20'000U);
  // The ranges are as noisy as expected: the worst of so many exceeds 3.5 sigma.
  EXPECT_GT(campaign.worst_sigmas(), 3.5);
  expect_counters_account(site, {1, 3, 102, 103, 104, 109});
  for (const std::uint16_t id : std::vector<std::uint16_t>{1, 3, 102, 103})
    EXPECT_GE(site.chip(id).ticks(site.network.now()) >> 40, 1)
        << id << ": its 40-bit counter has not wrapped";
  std::printf("%s", campaign.table().c_str());
}

INSTANTIATE_TEST_SUITE_P(Seeds, FaultCampaignTest,
                         testing::Combine(testing::Range<std::uint64_t>(GROMA_FIRST_SEED,
                                                                        GROMA_LAST_SEED + 1),
                                          testing::Values(groma_RangingMethod_METHOD_DS_NEXT_POLL,
                                                          groma_RangingMethod_METHOD_DS_FINAL)));

}  // namespace
}  // namespace groma::sim
