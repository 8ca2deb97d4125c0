#include "host/provision/air_plan.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <string>

#include "firmware/core/node/config.hpp"
#include "host/provision/node_config.hpp"

namespace groma::provision {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

SiteSettings site_of(unsigned tags, unsigned anchors) {
  SiteSettings site;
  for (unsigned i = 0; i < tags; ++i) site.tag_ids.push_back(static_cast<model::NodeId>(1 + i));
  for (unsigned i = 0; i < anchors; ++i) site.anchor_ids.push_back(static_cast<model::NodeId>(100 + i));
  site.master_id = 100;
  if (anchors > 1) site.backup_ids = {101};
  site.method = groma_RangingMethod_METHOD_DS_NEXT_POLL;
  site.response_gap_us = 300;
  return site;
}

AirPlan plan_of(const SiteSettings& site, unsigned baud = 1'000'000) {
  const groma_Config config = config_of(site, groma_Role_ROLE_TAG, site.tag_ids.front());
  EXPECT_STREQ(node::fault_of(config), "");
  return plan_air(config, baud);
}

// IEEE 802.15.4 at 6.8 Mbit/s with 64 MHz pulses, in us.
double air_us(double preamble, double bytes) {
  const double bits = 8.0 * bytes;
  return (preamble + 8.0) * 1.01763 + 21.0 * 1.02564 + (bits + 48.0 * std::ceil(bits / 330.0)) * 0.128205;
}

TEST(AirPlan, DurationsAreTheSumOfFramesAndPauses) {
  for (const unsigned preamble : {64U, 128U, 256U}) {
    for (const unsigned tags : {1U, 10U}) {
      for (const unsigned anchors : {4U, 12U, 16U}) {
        SiteSettings site = site_of(tags, anchors);
        site.preamble_symbols = preamble;
        const AirPlan plan = plan_of(site);
        const double poll_us = air_us(preamble, 20.0 + 2.0 * anchors);
        const double response_us = air_us(preamble, 28.0);
        const double slot_us = 30.0 + poll_us + 350.0 + anchors * (response_us + 300.0);
        // The transmit grid's 8 ns for each frame.
        const double grid_us = 0.02 * (anchors + 2.0);
        EXPECT_NEAR(plan.slot_s * 1e6, slot_us, grid_us);
        const double control_us = air_us(preamble, std::max(68.0, 50.0 + 2.0 * tags));
        const double whole_us = 2.0 * (30.0 + control_us) + 450.0 + 450.0 + tags * slot_us;
        EXPECT_NEAR(plan.superframe_s * 1e6, whole_us, (tags + 1.0) * grid_us);
        EXPECT_NEAR(plan.ranges_per_s, tags * anchors / (whole_us * 1e-6), 1.0);
        EXPECT_NEAR(plan.tag_ranges_per_s * tags, plan.ranges_per_s, 1e-6);
        EXPECT_NEAR(plan.tag_duty, poll_us / whole_us, 1e-5);
        EXPECT_NEAR(plan.anchor_duty, tags * response_us / whole_us, 1e-5);
        EXPECT_NEAR(plan.bound_ranges_per_s * plan.air_use, plan.ranges_per_s,
                    0.1 * plan.ranges_per_s);  // except for the relayed beacons
        EXPECT_LT(plan.ranges_per_s, plan.bound_ranges_per_s);
        EXPECT_NEAR(plan.open_slots_per_s, 0.5e6 / whole_us, 0.01);
      }
    }
  }
}

TEST(AirPlan, TagsThatShareASlotCostNoTime) {
  SiteSettings site = site_of(4, 12);
  const AirPlan apart = plan_of(site);
  site.tag_slots = {0, 1, 0, 1};
  site.slots = 2;
  const AirPlan shared = plan_of(site);
  EXPECT_NEAR(shared.superframe_s, apart.superframe_s - 2.0 * apart.slot_s, 5e-6);
  EXPECT_NEAR(shared.ranges_per_s, 48.0 / shared.superframe_s, 0.1);
}

TEST(AirPlan, APlaceForATrialYieldsNoRange) {
  SiteSettings site = site_of(4, 16);
  const AirPlan enough = plan_of(site);
  EXPECT_NEAR(enough.tag_ranges_per_s * enough.superframe_s, 16.0, 1e-9);
  // One anchor more gets a place in one of 31 POLLs: 1/32, plus the trials of anchors that gave up their
  // place.
  site = site_of(4, 17);
  EXPECT_NEAR(plan_of(site).tag_ranges_per_s * enough.superframe_s, 16.0 - 1.0 / 31.0, 1e-9);
  site.responses = 2;
  const AirPlan few = plan_of(site);
  EXPECT_NEAR(few.tag_ranges_per_s * few.superframe_s, 2.0 - 15.0 / 127.0, 1e-9);
  // With several cells most of the 64 anchors are out of reach; two places go to their trials.
  site = site_of(4, 64);
  site.tag_slots = {0, 1, 0, 1};
  site.slots = 2;
  const AirPlan halls = plan_of(site);
  EXPECT_NEAR(halls.tag_ranges_per_s * halls.superframe_s, 14.0, 1e-9);
  EXPECT_EQ(halls.responses, 16U);
}

TEST(AirPlan, GivesTheLoadOfEachLink) {
  SiteSettings site = site_of(3, 12);
  const AirPlan plan = plan_of(site);
  ASSERT_EQ(plan.links.size(), 3U);
  const double reports_per_s = 1.0 / plan.superframe_s;
  EXPECT_NEAR(plan.links[0].busy, plan.links[0].report_bytes * 10.0 * reports_per_s / 1e6, 1e-9);
  EXPECT_NEAR(plan.links[0].busy * plan.links[0].most_ranges_per_s, plan.tag_ranges_per_s, 1e-6);
  // Payloads of 8 bytes: 64 bits of data, 67 of the frame, 3 of space, and up to 20 % bit stuffing.
  const double frames = std::ceil(plan.links[1].report_bytes / 8.0);
  const double least = frames * (131.0 + 3.0) * 3.0 * reports_per_s / 1e6;
  EXPECT_GT(plan.links[1].busy, least * 0.97);
  EXPECT_LT(plan.links[1].busy, least * 1.22);
  EXPECT_LT(plan.links[2].busy, plan.links[1].busy * plan.links[2].report_bytes / plan.links[1].report_bytes);
  site.can_nominal_bit_per_s = 500'000;
  EXPECT_NEAR(plan_of(site).links[1].busy, 2.0 * plan.links[1].busy, 1e-9);
  EXPECT_NEAR(plan_of(site, 500'000).links[0].busy, 2.0 * plan.links[0].busy, 1e-9);
}

TEST(AirPlan, WarnsOfSettingsThatWillNotWork) {
  SiteSettings site = site_of(3, 12);
  EXPECT_THAT(plan_of(site).warnings, IsEmpty());
  EXPECT_THAT(plan_of(site, 115'200).warnings, ElementsAre(HasSubstr("UART would be busy")));
  site.turn_round_us = 150;
  EXPECT_THAT(plan_of(site).warnings, ElementsAre(HasSubstr("turn_round_us: 150 is less")));
  site = site_of(3, 12);
  site.response_gap_us = 60;
  EXPECT_THAT(plan_of(site).warnings, ElementsAre(HasSubstr("response_gap_us: 60 is less")));
  site = site_of(3, 12);
  site.backup_ids.clear();
  EXPECT_THAT(plan_of(site).warnings, ElementsAre(HasSubstr("the site stops without anchor 100")));
  site = site_of(3, 12);
  site.link = groma_Link_LINK_CAN;
  site.can_nominal_bit_per_s = 500'000;
  EXPECT_THAT(plan_of(site).warnings, ElementsAre(HasSubstr("CAN would be busy")));
}

TEST(AirPlan, ARangeNeedsAllFramesOfItsExchange) {
  EXPECT_DOUBLE_EQ(range_success(groma_RangingMethod_METHOD_DS_NEXT_POLL, 1.0), 1.0);
  EXPECT_NEAR(range_success(groma_RangingMethod_METHOD_DS_NEXT_POLL, 0.7), 0.2401, 1e-9);
  EXPECT_NEAR(range_success(groma_RangingMethod_METHOD_DS_FINAL, 0.7), 0.16807, 1e-9);
}

}  // namespace
}  // namespace groma::provision
