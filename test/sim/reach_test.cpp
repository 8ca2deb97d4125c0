// Commands for anchors without a cable, through a tag that has one: a whole native network.
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <optional>
#include <span>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/node/config.hpp"
#include "test/sim/reach_bench.hpp"
#include "test/support/frames.hpp"

namespace groma::sim {
namespace {

struct Case {
  const char* name;
  int anchors;
  bool in_a_row;
  double loss;
  bool keyed = false;
};
std::ostream& operator<<(std::ostream& out, const Case& c) {
  return out << c.name;
}

class ReachTest : public ::testing::TestWithParam<Case> {};

TEST_P(ReachTest, HelloCountersConfigurationAndIdentifyReachEveryAnchor) {
  const Case& c = GetParam();
  Reach reach({.anchors = c.anchors, .in_a_row = c.in_a_row, .loss = c.loss, .keyed = c.keyed});
  double longest_s = 0.0;
  double sum_s = 0.0;
  int asked = 0;
  for (int i = 0; i < c.anchors; ++i) {
    const std::uint16_t id = nth_anchor(i);
    const auto record = [&](const std::optional<Reach::Answer>& answer) {
      if (!answer) return;
      longest_s = std::max(longest_s, answer->took_s);
      sum_s += answer->took_s;
      ++asked;
    };
    const auto hello = reach.hello(id);
    ASSERT_TRUE(hello) << "anchor " << id;
    EXPECT_EQ(hello->id, id);
    EXPECT_EQ(hello->role, groma_Role_ROLE_ANCHOR);

    const auto counters = reach.ask(id, groma_HostToNode_get_counters_tag);
    record(counters);
    ASSERT_TRUE(counters && counters->rest.size() == 2U) << "anchor " << id;
    EXPECT_GT(counters->rest[1].body.counters.frames_received, 10U);

    const auto read = reach.ask(id, groma_HostToNode_read_config_tag);
    record(read);
    ASSERT_TRUE(read && read->reply.has_config) << "anchor " << id;
    EXPECT_EQ(read->reply.config.id, id);
    EXPECT_EQ(node::config_hash_of(read->reply.config), hello->config_hash);

    groma_Config changed = read->reply.config;
    changed.transmit_antenna_delay_dtu = 16'400 + id;
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.which_body = groma_HostToNode_write_config_tag;
    command.body.write_config = changed;
    const auto written = reach.ask(id, command);
    record(written);
    ASSERT_TRUE(written) << "anchor " << id;
    EXPECT_EQ(written->reply.result, groma_Result_RESULT_OK) << written->reply.text;
    EXPECT_EQ(written->reply.config.transmit_antenna_delay_dtu, changed.transmit_antenna_delay_dtu);

    command = groma_HostToNode_init_zero;
    command.which_body = groma_HostToNode_identify_s_tag;
    command.body.identify_s = 5;
    const auto identified = reach.ask(id, command);
    record(identified);
    ASSERT_TRUE(identified) << "anchor " << id;
    EXPECT_EQ(identified->reply.result, groma_Result_RESULT_OK);
  }
  EXPECT_EQ(reach.frames_not_genuine(), 0U);
  std::printf("[ %s ] answers after %.2f s on average, %.2f s at most\n", c.name, sum_s / asked, longest_s);
}

INSTANTIATE_TEST_SUITE_P(Site, ReachTest,
                         ::testing::Values(Case{"TwoPercent", 6, false, 0.02},
                                           Case{"ThirtyPercent", 4, false, 0.3},
                                           Case{"TwoHopsTwoPercent", 2, true, 0.02},
                                           Case{"TwoHopsThirtyPercent", 2, true, 0.3},
                                           Case{"ThreeHopsTwoPercent", 3, true, 0.02},
                                           Case{"KeyedTwoPercent", 6, false, 0.02, true},
                                           Case{"KeyedTwoHopsThirtyPercent", 2, true, 0.3, true}),
                         ::testing::PrintToStringParamName());

TEST(Reach, AnAbsentNodeIsReportedAndTheRateStays) {
  Reach reach({.anchors = 3});
  const auto answer = reach.ask(999, groma_HostToNode_get_hello_tag);
  ASSERT_TRUE(answer);
  EXPECT_EQ(answer->reply.result, groma_Result_RESULT_UNREACHABLE);
  EXPECT_GE(answer->pending, 1);
  const int before = reach.bench.good_ranges();
  reach.run(1.0);
  EXPECT_GT(reach.bench.good_ranges(), before + 10);
}

TEST(Reach, ARebootOverTheAirHappensOnce) {
  Reach reach({.anchors = 3, .loss = 0.3});
  const auto before = reach.hello(103);
  ASSERT_TRUE(before);
  const auto answer = reach.ask(103, groma_HostToNode_reboot_tag);
  ASSERT_TRUE(answer);
  EXPECT_EQ(answer->reply.result, groma_Result_RESULT_OK);
  reach.run(3.0);
  const auto after = reach.hello(103);
  ASSERT_TRUE(after);
  EXPECT_EQ(after->boot_count, before->boot_count + 1);
}

TEST(Reach, CommandsThatWouldCutANodeOffAreRefusedOverTheAir) {
  Reach reach({.anchors = 3});
  const auto reset = reach.ask(102, groma_HostToNode_factory_reset_tag);
  ASSERT_TRUE(reset);
  EXPECT_EQ(reset->reply.result, groma_Result_RESULT_UNSUPPORTED);
  const auto time = reach.ask(102, groma_HostToNode_time_request_tag);
  ASSERT_TRUE(time);
  EXPECT_EQ(time->reply.result, groma_Result_RESULT_UNSUPPORTED);
  groma_Config config = reach.bench.config_of(102, groma_Role_ROLE_ANCHOR);
  config.network_key.size = 16;
  config.network_key_hash = 1;
  EXPECT_EQ(reach.write(102, config).result, groma_Result_RESULT_INVALID);
  config = reach.bench.config_of(102, groma_Role_ROLE_ANCHOR);
  config.schedule.guard_us = 1;
  EXPECT_EQ(reach.write(102, config).result, groma_Result_RESULT_INVALID);
}

// ---- ranges between anchors -------------------------------------------------------------------------------

TEST(Reach, AnAnchorRangesToTheOthersInABorrowedSlot) {
  Reach reach({.anchors = 4, .loss = 0.02});
  groma_HostToNode command = groma_HostToNode_init_zero;
  command.which_body = groma_HostToNode_survey_tag;
  command.body.survey.exchanges = 60;
  const int before = reach.bench.good_ranges();
  const auto answer = reach.ask(103, command);
  ASSERT_TRUE(answer);
  ASSERT_EQ(answer->reply.result, groma_Result_RESULT_OK) << answer->reply.text;
  ASSERT_EQ(answer->rest[0].which_body, static_cast<pb_size_t>(groma_NodeToHost_survey_report_tag));
  const groma_SurveyReport& report = answer->rest[0].body.survey_report;
  ASSERT_EQ(report.pairs_count, 3U);
  for (const groma_SurveyPair& pair : std::span(report.pairs).first(report.pairs_count)) {
    EXPECT_NE(pair.anchor_id, 103U);
    EXPECT_GT(pair.count, 10U);
    EXPECT_NEAR(pair.mean_m, reach.bench.space.distance_m(103, pair.anchor_id), 0.02) << pair.anchor_id;
    EXPECT_LT(pair.sigma_m, 0.05F);
  }
  std::printf("a survey of %d exchanges took %.2f s\n", static_cast<int>(command.body.survey.exchanges),
              answer->took_s);
  // Then the tag ranges as before, and all its ranges are correct.
  reach.run(2.0);
  const int then = reach.bench.good_ranges();
  reach.run(1.0);
  EXPECT_GT(reach.bench.good_ranges() - then, 100);
  EXPECT_GT(then, before);
  reach.bench.each_range([&](const groma_SlotReport& slot, const groma_Range& range) {
    if (range.status != groma_RangeStatus_RANGE_OK) return;
    const double truth_m =
        reach.bench.space.distance_m(static_cast<std::uint16_t>(slot.tag_id), range.anchor_id);
    EXPECT_NEAR(static_cast<double>(range.range_m), truth_m, 0.1);
  });
  const auto hello = reach.hello(103);
  ASSERT_TRUE(hello);
  EXPECT_EQ(hello->role, groma_Role_ROLE_ANCHOR);
}

// Counts the frames whose source is not their sender: their nonces could be those of another node's frames.
class SourceWitness final : public Witness {
 public:
  explicit SourceWitness(Medium& medium) : medium_(medium) { medium.set_witness(this); }
  void announced(const AirFrame& frame) override {
    const auto parsed = mac::parse(std::span(frame.data).first(frame.length - 2U)).frame;
    ++seen;
    wrong += parsed && parsed->source == medium_.id_of(frame.source) ? 0 : 1;
  }
  int seen = 0;
  int wrong = 0;

 private:
  Medium& medium_;
};

TEST(Reach, EachNodeSendsUnderItsOwnIdDuringASurvey) {
  Reach reach({.anchors = 4, .keyed = true});
  SourceWitness witness(reach.bench.network.medium());
  groma_HostToNode command = groma_HostToNode_init_zero;
  command.which_body = groma_HostToNode_survey_tag;
  command.body.survey.exchanges = 60;
  const auto answer = reach.ask(103, command);
  ASSERT_TRUE(answer);
  ASSERT_EQ(answer->reply.result, groma_Result_RESULT_OK) << answer->reply.text;
  EXPECT_EQ(answer->rest.at(0).body.survey_report.pairs_count, 3U);
  EXPECT_GT(witness.seen, 60);
  EXPECT_EQ(witness.wrong, 0);
  EXPECT_EQ(reach.frames_not_genuine(), 0U);
}

TEST(Reach, TheMasterDoesNotSurvey) {
  Reach reach({.anchors = 3});
  groma_HostToNode command = groma_HostToNode_init_zero;
  command.which_body = groma_HostToNode_survey_tag;
  command.body.survey.exchanges = 10;
  const auto master = reach.ask(101, command);
  ASSERT_TRUE(master);
  EXPECT_EQ(master->reply.result, groma_Result_RESULT_UNSUPPORTED);
  command.body.survey.exchanges = 0;
  const auto none = reach.ask(102, command);
  ASSERT_TRUE(none);
  EXPECT_EQ(none->reply.result, groma_Result_RESULT_INVALID);
}

// ---- a configuration on trial -----------------------------------------------------------------------------

TEST(Reach, AConfigurationThatProvesItselfStays) {
  Reach reach({.anchors = 3, .loss = 0.02});
  groma_Config config = reach.bench.config_of(103, groma_Role_ROLE_ANCHOR);
  config.transmit_antenna_delay_dtu = 16'001;
  ASSERT_EQ(reach.write(103, config).result, groma_Result_RESULT_OK);
  ASSERT_EQ(reach.apply(103, 5), groma_Result_RESULT_OK);
  reach.run(1.0);
  const auto hello = reach.hello(103);
  ASSERT_TRUE(hello);
  EXPECT_EQ(hello->config_hash, node::config_hash_of(config));
  reach.run(8.0);
  EXPECT_EQ(reach.hello(103).value_or(groma_Hello groma_Hello_init_zero).config_hash,
            node::config_hash_of(config));
  reach.cut_power(3);
  reach.run(9.0);
  EXPECT_EQ(reach.hello(103).value_or(groma_Hello groma_Hello_init_zero).config_hash,
            node::config_hash_of(config));
}

TEST(Reach, AConfigurationThatCutsTheNodeOffIsRevertedToThePreviousOne) {
  for (const bool power_cut : {false, true}) {
    Reach reach({.anchors = 3, .loss = 0.02});
    const groma_Config good = reach.bench.config_of(103, groma_Role_ROLE_ANCHOR);
    groma_Config wrong = good;
    wrong.schedule.epoch = 99;
    ASSERT_EQ(reach.write(103, wrong).result, groma_Result_RESULT_OK);
    ASSERT_EQ(reach.apply(103, 4), groma_Result_RESULT_OK);
    reach.run(1.5);
    const auto away = reach.ask(103, groma_HostToNode_get_hello_tag, 2.0);
    EXPECT_TRUE(!away || away->reply.result == groma_Result_RESULT_UNREACHABLE);
    if (power_cut) {  // it restarts with the new one, for a minute
      reach.cut_power(3);
      reach.run(60.0);
    }
    reach.run(6.0);
    const auto hello = reach.hello(103);
    ASSERT_TRUE(hello) << power_cut;
    EXPECT_EQ(hello->config_hash, node::config_hash_of(good));
    // It stays so, also over a power cut.
    reach.run(3.0);
    reach.cut_power(3);
    reach.run(3.0);
    EXPECT_EQ(reach.hello(103).value_or(groma_Hello groma_Hello_init_zero).config_hash,
              node::config_hash_of(good));
  }
}

// Other nodes may still have to get their schedule over the older network.
TEST(Reach, ABackUpOnTrialLeavesTheOlderNetworkAlone) {
  Reach reach({.anchors = 3});
  const groma_Config old = reach.bench.config_of(102, groma_Role_ROLE_ANCHOR);
  groma_Config newer = old;
  ++newer.schedule.epoch;
  ASSERT_EQ(reach.write(102, newer).result, groma_Result_RESULT_OK);
  ASSERT_EQ(reach.apply(102, 10), groma_Result_RESULT_OK);
  reach.run(5.0);
  EXPECT_TRUE(reach.hello(103)) << "over the older network";
  reach.run(10.0);
  const auto hello = reach.hello(102);
  ASSERT_TRUE(hello);
  EXPECT_EQ(hello->config_hash, node::config_hash_of(old));
}

// An anchor that only the master hears: reached through the tag and the master.
TEST(Reach, TwoHopsAwayATrialSucceedsOrFailsAsInDirectReach) {
  for (const bool keyed : {false, true}) {
    constexpr std::uint16_t kFar = 102;
    Reach reach({.anchors = 2, .in_a_row = true, .loss = 0.02, .keyed = keyed});
    groma_Config better = reach.anchor_config(kFar);
    better.transmit_antenna_delay_dtu = 16'001;
    ASSERT_EQ(reach.write(kFar, better).result, groma_Result_RESULT_OK);
    ASSERT_EQ(reach.apply(kFar, 5), groma_Result_RESULT_OK);
    reach.run(1.0);
    const auto accepted = reach.hello(kFar);
    ASSERT_TRUE(accepted);
    EXPECT_EQ(accepted->config_hash, node::config_hash_of(better)) << keyed;
    reach.run(8.0);

    groma_Config wrong = better;
    wrong.schedule.epoch = 99;
    ASSERT_EQ(reach.write(kFar, wrong).result, groma_Result_RESULT_OK);
    ASSERT_EQ(reach.apply(kFar, 4), groma_Result_RESULT_OK);
    reach.run(1.5);
    const auto away = reach.ask(kFar, groma_HostToNode_get_hello_tag, 2.0);
    EXPECT_TRUE(!away || away->reply.result == groma_Result_RESULT_UNREACHABLE);
    reach.run(6.0);
    const auto back = reach.hello(kFar);
    ASSERT_TRUE(back) << keyed;
    EXPECT_EQ(back->config_hash, node::config_hash_of(better)) << keyed;
    // It kept its key, or its frames would have been rejected.
    const auto read = reach.ask(kFar, groma_HostToNode_read_config_tag);
    ASSERT_TRUE(read && read->reply.has_config);
    EXPECT_EQ(read->reply.config.schedule.epoch, better.schedule.epoch);
    EXPECT_EQ(read->reply.config.network_key.size, 0U);
    EXPECT_EQ(reach.frames_not_genuine(), 0U);
  }
}

}  // namespace
}  // namespace groma::sim
