// The shipped image without a cable: a tag and two anchors in a row, each of which hears only its neighbours.
#include <gtest/gtest.h>

#include <cstdint>
#include <iostream>
#include <utility>

#include "firmware/core/node/config.hpp"
#include "test/sim/emulator/emulated_site.hpp"
#include "test/sim/reach_bench.hpp"

namespace groma::sim {
namespace {

class EmulatedReach : public ::testing::TestWithParam<bool> {};

INSTANTIATE_TEST_SUITE_P(Keys, EmulatedReach, ::testing::Bool(),
                         [](const auto& keyed) { return keyed.param ? "Keyed" : "Unkeyed"; });

TEST_P(EmulatedReach, AnAnchorTwoHopsAwayIsQueriedConfiguredAndRecovers) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  constexpr std::uint16_t kFar = 102;
  Reach reach({.anchors = 2, .in_a_row = true, .keyed = GetParam(), .change = [](SiteSettings site) {
                 return emulating(std::move(site));
               }});
  const auto hello = reach.hello(kFar);
  ASSERT_TRUE(hello);
  EXPECT_EQ(hello->id, kFar);
  EXPECT_GT(hello->stack_high_water_bytes, 0U);
  EXPECT_LT(hello->stack_high_water_bytes, hello->stack_size_bytes);
  const auto counters = reach.ask(kFar, groma_HostToNode_get_counters_tag);
  ASSERT_TRUE(counters && counters->rest.size() == 2U);
  EXPECT_GT(counters->rest[1].body.counters.beacons_received, 10U);
  EXPECT_EQ(counters->rest[1].body.counters.forged_frames, 0U);
  groma_HostToNode identify = groma_HostToNode_init_zero;
  identify.which_body = groma_HostToNode_identify_s_tag;
  identify.body.identify_s = 1;
  const auto blinks = reach.ask(kFar, identify);
  ASSERT_TRUE(blinks);
  EXPECT_EQ(blinks->reply.result, groma_Result_RESULT_OK);

  const groma_Config good = reach.anchor_config(kFar);
  groma_Config wrong = good;
  wrong.schedule.epoch = 99;
  const groma_Reply written = reach.write(kFar, wrong);
  ASSERT_EQ(written.result, groma_Result_RESULT_OK) << written.text;
  EXPECT_EQ(node::config_hash_of(written.config), node::config_hash_of(wrong));
  ASSERT_EQ(reach.apply(kFar, 2), groma_Result_RESULT_OK);
  reach.run(1.2);
  const auto away = reach.ask(kFar, groma_HostToNode_get_hello_tag, 0.5);
  EXPECT_TRUE(!away || away->reply.result == groma_Result_RESULT_UNREACHABLE);
  reach.run(2.0);
  const auto back = reach.hello(kFar);
  ASSERT_TRUE(back);
  EXPECT_EQ(back->config_hash, node::config_hash_of(good));
  EXPECT_EQ(back->boot_count, hello->boot_count);
  EXPECT_LT(back->stack_high_water_bytes, back->stack_size_bytes);
  std::cout << "stack: " << back->stack_high_water_bytes << " of " << back->stack_size_bytes << " bytes\n";
  EXPECT_EQ(reach.frames_not_genuine(), 0U);
}

}  // namespace
}  // namespace groma::sim
