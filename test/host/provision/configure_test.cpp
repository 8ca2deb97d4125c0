// Nodes are configured over real pseudo-terminals: simulated nodes that run the firmware, and scripted
// nodes for behaviour that the firmware does not show.
#include "host/provision/configure.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <poll.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <functional>
#include <memory>
#include <random>
#include <set>
#include <span>
#include <string>
#include <thread>
#include <tuple>
#include <utility>
#include <vector>

#include "firmware/core/node/config.hpp"
#include "firmware/core/node/messages.hpp"
#include "host/link/report_decoder.hpp"
#include "proto/crc32.hpp"
#include "test/host/provision/live_site.hpp"
#include "test/host/provision/scripted_node.hpp"

namespace groma::provision {
namespace {

using test::hello_of;
using test::LiveSite;
using test::reply_of;
using test::ScriptedNode;
using ::testing::HasSubstr;

constexpr unsigned kBaud = 1'000'000;

ConfigureOptions recording(std::vector<std::string>& steps) {
  ConfigureOptions options;
  options.progress = [&](const char* step) { steps.emplace_back(step); };
  return options;
}

// ---- simulated nodes --------------------------------------------------------------------------------------

struct HeardAnchors : link::NodeSink {
  void on_range(const model::RangeSample& range) override { ids.insert(range.anchor_id); }
  std::set<model::NodeId> ids;
};

TEST(ConfigureNode, UnconfiguredNodesBecomeASiteThatRanges) {
  LiveSite site;
  const SitePlan plan = site.plan();
  for (const PlannedNode& node : plan.nodes) {
    const NodeOutcome outcome = configure_node(node, kBaud);
    ASSERT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
    EXPECT_TRUE(outcome.changed);
    EXPECT_EQ(outcome.hello->id, node.id);
    EXPECT_EQ(outcome.hello->config_hash, node::config_hash_of(node.config));
  }
  HeardAnchors heard;
  link::ReportDecoder decoder(kBaud);
  const link::OpenedLink tag = link::open_link(plan.nodes[0].port, kBaud);
  ASSERT_TRUE(tag.link) << tag.error.message;
  for (int i = 0; i < 500 && heard.ids.size() < 3; ++i) {
    pollfd entry{tag.link->poll_fd(), POLLIN, 0};
    (void)::poll(&entry, 1, 20);
    std::array<std::uint8_t, 4096> chunk{};
    const link::ReadResult read = tag.link->read(chunk);
    decoder.take(std::span(chunk).first(read.bytes), 0.02 * i, heard);
  }
  EXPECT_THAT(heard.ids, ::testing::ElementsAre(10, 11, 12));
}

TEST(ConfigureNode, AConfiguredNodeIsNotWritten) {
  LiveSite site;
  const PlannedNode node = site.plan().nodes[0];
  ASSERT_EQ(configure_node(node, kBaud).fault, NodeFault::kNone);
  std::vector<std::string> steps;
  const NodeOutcome again = configure_node(node, kBaud, recording(steps));
  EXPECT_EQ(again.fault, NodeFault::kNone) << again.message;
  EXPECT_FALSE(again.changed);
  EXPECT_THAT(steps, ::testing::ElementsAre("asks", "reads"));
}

TEST(ConfigureNode, AnyOtherFieldIsAChange) {
  LiveSite site;
  PlannedNode node = site.plan().nodes[0];
  ASSERT_EQ(configure_node(node, kBaud).fault, NodeFault::kNone);
  node.config.transmit_power = 0x1F1F1F1F;  // not part of the schedule's hash
  const NodeOutcome outcome = configure_node(node, kBaud);
  EXPECT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
  EXPECT_TRUE(outcome.changed);
  EXPECT_EQ(outcome.hello->config_hash, node::config_hash_of(node.config));
}

// A link that fails after some commands; the last one still arrives at the node, or does not.
class DyingLink : public link::ByteLink {
 public:
  DyingLink(std::unique_ptr<link::ByteLink> link, int commands, bool last_arrives)
      : link_(std::move(link)), left_(commands), last_arrives_(last_arrives) {}
  [[nodiscard]] int poll_fd() const noexcept override { return link_->poll_fd(); }
  [[nodiscard]] link::ReadResult read(std::span<std::uint8_t> out) override {
    return left_ < 0 ? link::ReadResult{0, true} : link_->read(out);
  }
  [[nodiscard]] std::size_t write(std::span<const std::uint8_t> bytes) override {
    return left_-- > 0 || last_arrives_ ? link_->write(bytes) : bytes.size();
  }

 private:
  std::unique_ptr<link::ByteLink> link_;
  int left_;
  bool last_arrives_;
};

class InterruptedAfter : public ::testing::TestWithParam<std::tuple<int, bool>> {};

TEST_P(InterruptedAfter, ItContinuesWhereItStopped) {
  const int commands = std::get<0>(GetParam());
  const bool last_arrives = std::get<1>(GetParam());
  LiveSite site;
  const PlannedNode node = site.plan().nodes[1];
  ConfigureOptions dying;
  dying.open = [&](const std::string& path, unsigned baud) {
    link::OpenedLink opened = link::open_link(path, baud);
    if (opened.link)
      opened.link = std::make_unique<DyingLink>(std::move(opened.link), commands, last_arrives);
    return opened;
  };
  const NodeOutcome cut = configure_node(node, kBaud, dying);
  EXPECT_EQ(cut.fault, NodeFault::kNoAnswer);
  EXPECT_THAT(cut.message, HasSubstr("node 10: " + node.port + ": the port went away"));
  std::this_thread::sleep_for(std::chrono::milliseconds(300));  // lets the node finish its work

  const NodeOutcome resumed = configure_node(node, kBaud);
  EXPECT_EQ(resumed.fault, NodeFault::kNone) << resumed.message;
  EXPECT_EQ(resumed.hello->config_hash, node::config_hash_of(node.config));
  const NodeOutcome again = configure_node(node, kBaud);
  EXPECT_EQ(again.fault, NodeFault::kNone) << again.message;
  EXPECT_FALSE(again.changed);
}

// Hello, read, write, apply, hello.
INSTANTIATE_TEST_SUITE_P(ConfigureNode, InterruptedAfter,
                         ::testing::Combine(::testing::Range(0, 5), ::testing::Bool()));

TEST(ConfigureNode, NoiseOnTheLineOnlyDelays) {
  std::minstd_rand random(7);
  LiveSite site;
  site.set_line([&](std::vector<std::uint8_t>& bytes) {
    std::vector<std::uint8_t> through;
    for (const std::uint8_t byte : bytes) {
      const auto draw = random() % 2000;
      if (draw == 0) continue;                                                       // lost
      through.push_back(draw < 3 ? static_cast<std::uint8_t>(byte ^ 0x10U) : byte);  // flipped
      if (draw == 3) through.push_back(0x55);                                        // spurious
    }
    bytes = through;
  });
  for (const PlannedNode& node : site.plan().nodes) {
    const NodeOutcome outcome = configure_node(node, kBaud);
    ASSERT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
    EXPECT_EQ(outcome.hello->config_hash, node::config_hash_of(node.config));
  }
}

TEST(ConfigureNode, ANodeOfAnotherIdIsOverwrittenOnlyOnRequest) {
  LiveSite site;
  const SitePlan plan = site.plan();
  ASSERT_EQ(configure_node(plan.nodes[2], kBaud).fault, NodeFault::kNone);
  PlannedNode swapped = plan.nodes[1];
  swapped.port = plan.nodes[2].port;
  const NodeOutcome refused = configure_node(swapped, kBaud);
  EXPECT_EQ(refused.fault, NodeFault::kWrongNode);
  EXPECT_THAT(refused.message,
              HasSubstr("node 10: " + swapped.port + ": is configured as anchor 11 of network 77"));
  EXPECT_THAT(refused.message, HasSubstr("--reassign"));
  EXPECT_FALSE(configure_node(plan.nodes[2], kBaud).changed);

  ConfigureOptions reassigning;
  reassigning.reassign = true;
  const NodeOutcome outcome = configure_node(swapped, kBaud, reassigning);
  EXPECT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
  EXPECT_EQ(outcome.hello->id, 10U);
}

TEST(ConfigureNode, ARefusalIsReportedWithTheNodesText) {
  LiveSite site;
  PlannedNode node = site.plan().nodes[0];
  node.config.schedule.guard_us = 1;
  const NodeOutcome outcome = configure_node(node, kBaud);
  EXPECT_EQ(outcome.fault, NodeFault::kRefused);
  EXPECT_THAT(outcome.message, HasSubstr("refuses to write_config: schedule.guard_us: 2 to 1000"));
}

TEST(ConfigureNode, ANodeUnpluggedMeanwhileIsReported) {
  LiveSite site;
  const PlannedNode node = site.plan().nodes[0];
  ConfigureOptions options;
  options.progress = [&](const char* step) {
    if (std::string(step) == "writes") site.unplug();
  };
  const NodeOutcome outcome = configure_node(node, kBaud, options);
  EXPECT_EQ(outcome.fault, NodeFault::kNoAnswer);
  EXPECT_THAT(outcome.message, HasSubstr("the port went away; plug it in again"));
}

TEST(IdentifyNode, TheNodeIdentifiesItself) {
  LiveSite site;
  const SitePlan plan = site.plan();
  const NodeOutcome outcome = identify_node(plan.nodes[0].port, kBaud, 2);
  EXPECT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
  ASSERT_TRUE(outcome.hello);
  EXPECT_EQ(outcome.hello->role, groma_Role_ROLE_UNCONFIGURED);
  const NodeOutcome refused = identify_node(plan.nodes[0].port, kBaud, 4000);
  EXPECT_EQ(refused.fault, NodeFault::kRefused);
  EXPECT_THAT(refused.message, HasSubstr("identify_s: 0 to 3600"));
}

// ---- over the air -----------------------------------------------------------------------------------------

// The site was configured by cable once; then only the tag keeps its cable.
class OverTheAir : public ::testing::Test {
 protected:
  void SetUp() override {
    for (const PlannedNode& node : by_cable.nodes) {
      const NodeOutcome outcome = configure_node(node, kBaud);
      ASSERT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
    }
    plan = by_cable;
    for (std::size_t i = 1; i < plan.nodes.size(); ++i) {
      plan.nodes[i].port.clear();
      plan.nodes[i].via = 1;
      plan.nodes[i].via_port = plan.nodes[0].port;
    }
    // Lets the anchors find their master.
    std::this_thread::sleep_for(std::chrono::milliseconds(500));
  }
  [[nodiscard]] std::vector<const PlannedNode*> all() const {
    std::vector<const PlannedNode*> nodes;
    for (const PlannedNode& node : plan.nodes) nodes.push_back(&node);
    return nodes;
  }
  // Asks each node by its cable.
  void expect_in_force() const {
    for (std::size_t i = 0; i < plan.nodes.size(); ++i) {
      const NodeReport report = ask_node(by_cable.nodes[i].port, kBaud);
      ASSERT_TRUE(report.outcome.hello) << report.outcome.message;
      EXPECT_EQ(report.outcome.hello->config_hash, node::config_hash_of(plan.nodes[i].config));
    }
  }

  LiveSite site;
  SitePlan by_cable = site.plan();
  SitePlan plan;
};

TEST_F(OverTheAir, ANodeIsWrittenReadBackAndApplied) {
  plan.nodes[3].config.transmit_antenna_delay_dtu = 16'321;
  std::vector<std::string> steps;
  const NodeOutcome outcome = configure_node(plan.nodes[3], kBaud, recording(steps));
  ASSERT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
  EXPECT_TRUE(outcome.changed);
  EXPECT_EQ(outcome.port, plan.nodes[0].port);
  EXPECT_THAT(steps, ::testing::ElementsAre("asks", "reads", "writes", "applies"));
  const NodeOutcome again = configure_node(plan.nodes[3], kBaud);
  EXPECT_EQ(again.fault, NodeFault::kNone) << again.message;
  EXPECT_FALSE(again.changed);
  expect_in_force();
}

TEST_F(OverTheAir, AWholeSiteChangesItsSchedule) {
  for (PlannedNode& node : plan.nodes) {
    node.config.schedule.epoch = 8;
    node.config.schedule.response_gap_us += 20;
  }
  const auto outcomes = configure_nodes(all(), kBaud);
  for (const NodeOutcome& outcome : outcomes) {
    EXPECT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
    EXPECT_TRUE(outcome.changed);
  }
  expect_in_force();
  for (const NodeOutcome& outcome : configure_nodes(all(), kBaud)) {
    EXPECT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
    EXPECT_FALSE(outcome.changed);
  }
}

TEST_F(OverTheAir, AnotherTimingOfTheSameEpochSaysWhatTheSiteHasToDo) {
  for (const NodeOutcome& outcome : configure_nodes(all(), kBaud)) EXPECT_EQ(outcome.advice, "");
  for (PlannedNode& node : plan.nodes) node.config.schedule.response_gap_us += 20;
  for (const NodeOutcome& outcome : configure_nodes(all(), kBaud)) {
    EXPECT_THAT(outcome.advice, HasSubstr("response_gap_us: 300, guard_us: 30; the plan says 350, 320, 30"));
    EXPECT_THAT(outcome.advice, HasSubstr("increase schedule.epoch above"));
  }
}

TEST_F(OverTheAir, AScheduleChangeWaitsForTheNodeThatPassesItOn) {
  plan.nodes[2].config.schedule.epoch = 8;
  const NodeOutcome outcome = configure_node(plan.nodes[2], kBaud);
  EXPECT_EQ(outcome.fault, NodeFault::kHeldBack);
  EXPECT_THAT(outcome.message, HasSubstr("node 11: " + plan.nodes[0].port + ": is written, but keeps"));
}

TEST_F(OverTheAir, AfterAnInterruptionItContinuesWhereItStopped) {
  plan.nodes[1].config.transmit_power = 0x1F1F1F1F;
  for (const int commands : {1, 3}) {
    ConfigureOptions dying;
    dying.open = [&](const std::string& path, unsigned baud) {
      link::OpenedLink opened = link::open_link(path, baud);
      if (opened.link) opened.link = std::make_unique<DyingLink>(std::move(opened.link), commands, true);
      return opened;
    };
    EXPECT_EQ(configure_node(plan.nodes[1], kBaud, dying).fault, NodeFault::kNoAnswer);
  }
  const NodeOutcome resumed = configure_node(plan.nodes[1], kBaud);
  EXPECT_EQ(resumed.fault, NodeFault::kNone) << resumed.message;
  expect_in_force();
}

TEST_F(OverTheAir, IdentifyAndCountersWork) {
  const NodeOutcome blinking = identify_node(plan.nodes[0].port, kBaud, 2, link::open_link, 12);
  EXPECT_EQ(blinking.fault, NodeFault::kNone) << blinking.message;
  ASSERT_TRUE(blinking.hello);
  EXPECT_EQ(blinking.hello->id, 12U);
  const NodeReport report = ask_node(plan.nodes[0].port, kBaud, 12);
  ASSERT_TRUE(report.counters) << report.outcome.message;
  EXPECT_EQ(report.outcome.hello->id, 12U);
  EXPECT_GT(report.counters->beacons_received, 0U);
  ASSERT_TRUE(report.slack);
  EXPECT_GE(report.slack->slots_count, 2U) << "beacon and shared slot";
  for (const groma_SlotSlack& slot : std::span(report.slack->slots).first(report.slack->slots_count)) {
    EXPECT_GT(slot.least_us, 20) << slot.kind;
    EXPECT_EQ(slot.counts_count, 8U);
  }
}

TEST_F(OverTheAir, AnAnchorSurveysTheOthers) {
  const SurveyOutcome surveyed = survey_from(plan.nodes[0].port, kBaud, 11, 40);
  EXPECT_EQ(surveyed.outcome.fault, NodeFault::kNone) << surveyed.outcome.message;
  std::set<model::NodeId> others;
  for (const SurveyedPair& pair : surveyed.pairs) {
    EXPECT_EQ(pair.from, 11U);
    EXPECT_NEAR(pair.range_m, 4.03, 0.3);  // as in LiveSite; the chips' own antenna delays
    EXPECT_GT(pair.count, 10U);
    others.insert(pair.to);
  }
  EXPECT_THAT(others, ::testing::ElementsAre(10, 12));
  const NodeOutcome of_master = survey_from(plan.nodes[0].port, kBaud, 10, 40).outcome;
  EXPECT_EQ(of_master.fault, NodeFault::kRefused);
  EXPECT_THAT(of_master.message, ::testing::HasSubstr("; name anchors other than the master; "));
}

TEST_F(OverTheAir, ANodeThatDoesNotAnswerIsNamed) {
  PlannedNode missing = plan.nodes[3];
  missing.id = 99;
  const NodeOutcome outcome = configure_node(missing, kBaud);
  EXPECT_EQ(outcome.fault, NodeFault::kNoAnswer);
  EXPECT_THAT(outcome.message,
              HasSubstr("node 99: " + plan.nodes[0].port + ": no answer from node 99 over the air"));
}

TEST_F(OverTheAir, AWiredNodeWithoutSynchronizationIsReported) {
  PlannedNode lone = by_cable.nodes[0];
  lone.config.schedule.epoch = 77;
  ASSERT_EQ(configure_node(lone, kBaud).fault, NodeFault::kNone);
  const NodeOutcome outcome = identify_node(plan.nodes[0].port, kBaud, 2, link::open_link, 12);
  EXPECT_EQ(outcome.fault, NodeFault::kNoAnswer);
  EXPECT_THAT(outcome.message, HasSubstr("the wired node is not synchronized with its network"));
}

// ---- scripted nodes ---------------------------------------------------------------------------------------

groma_Config some_config() {
  SiteSettings site;
  site.network_id = 77;
  site.tag_ids = {1};
  site.anchor_ids = {10};
  site.master_id = 10;
  return config_of(site, groma_Role_ROLE_TAG, 1);
}

PlannedNode node_at(const std::string& port) {
  PlannedNode node;
  node.id = 1;
  node.role = groma_Role_ROLE_TAG;
  node.config = some_config();
  node.port = port;
  return node;
}

groma_Hello hello_in_force() {
  groma_Hello hello = groma_Hello_init_zero;
  node::fill_hello(hello, {.version = "9.9", .git_hash = 1}, some_config(), node::ResetReason::kPowerOn,
                   std::nullopt, {}, "");
  return hello;
}

groma_NodeToHost with_config(groma_NodeToHost reply, const groma_Config& config) {
  reply.body.reply.has_config = true;
  reply.body.reply.config = config;
  return reply;
}

// Answers correctly, except that `change` may modify each message.
ScriptedNode::Answer correct_except(std::function<void(groma_NodeToHost&, const groma_HostToNode&)> change) {
  return [change = std::move(change)](const groma_HostToNode& command) {
    std::vector<groma_NodeToHost> answer{with_config(reply_of(command), some_config())};
    if (command.which_body == groma_HostToNode_read_config_tag) {
      answer[0].body.reply.config = groma_Config groma_Config_init_zero;
    }
    if (command.which_body == groma_HostToNode_get_hello_tag ||
        command.which_body == groma_HostToNode_apply_config_tag) {
      answer.push_back(hello_of(hello_in_force()));
    }
    for (groma_NodeToHost& message : answer) change(message, command);
    return answer;
  };
}

std::vector<groma_NodeToHost> nothing(const groma_HostToNode& /*command*/) {
  return {};
}

NodeOutcome configure_scripted(ScriptedNode::Answer answer, std::vector<std::uint8_t> chatter = {}) {
  ScriptedNode node(std::move(answer), std::move(chatter));
  return configure_node(node_at(node.path()), kBaud);
}

TEST(ConfigureNode, TheScriptedNodeIsConfiguredUnlessChanged) {
  EXPECT_EQ(configure_scripted(correct_except([](auto&, const auto&) {})).fault, NodeFault::kNone);
}

TEST(ConfigureNode, FirmwareOfAnotherProtocolIsNotWritten) {
  const NodeOutcome outcome = configure_scripted(correct_except([](auto& message, const auto& command) {
    EXPECT_EQ(command.which_body, groma_HostToNode_get_hello_tag);
    if (message.which_body == groma_NodeToHost_hello_tag) message.body.hello.protocol_version = 2;
  }));
  EXPECT_EQ(outcome.fault, NodeFault::kOtherProtocol);
  EXPECT_THAT(outcome.message,
              HasSubstr("its firmware 9.9 speaks protocol 2, this program 1; flash the image"));
}

TEST(ConfigureNode, ADifferentReadBackIsReportedByField) {
  const NodeOutcome outcome = configure_scripted(correct_except([](auto& message, const auto& command) {
    if (command.which_body == groma_HostToNode_write_config_tag)
      message.body.reply.config.schedule.guard_us = 31;
  }));
  EXPECT_EQ(outcome.fault, NodeFault::kStorage);
  EXPECT_THAT(outcome.message, HasSubstr("reads back something else (schedule.guard_us: 31, not 30)"));
}

TEST(ConfigureNode, AFailedStorageIsReported) {
  const NodeOutcome outcome = configure_scripted([](const groma_HostToNode& command) {
    if (command.which_body == groma_HostToNode_write_config_tag) {
      return std::vector{reply_of(command, groma_Result_RESULT_STORAGE, "not stored: write it again")};
    }
    return correct_except([](auto&, const auto&) {})(command);
  });
  EXPECT_EQ(outcome.fault, NodeFault::kStorage);
  EXPECT_THAT(outcome.message, HasSubstr("write_config failed (not stored: write it again)"));
}

TEST(ConfigureNode, ARadioThatDoesNotComeUpIsReported) {
  const NodeOutcome outcome = configure_scripted(correct_except([](auto& message, const auto&) {
    if (message.which_body == groma_NodeToHost_hello_tag) {
      node::copy_text(message.body.hello.radio_error, "DW1000: no PLL lock");
    }
  }));
  EXPECT_EQ(outcome.fault, NodeFault::kRadio);
  EXPECT_THAT(outcome.message, HasSubstr("its DW1000 did not come up (DW1000: no PLL lock)"));
}

TEST(ConfigureNode, ACanControllerThatDoesNotComeUpIsReported) {
  const NodeOutcome outcome = configure_scripted(correct_except([](auto& message, const auto&) {
    if (message.which_body == groma_NodeToHost_hello_tag) {
      node::copy_text(message.body.hello.link_error, "no MCP2518FD");
    }
  }));
  EXPECT_EQ(outcome.fault, NodeFault::kLink);
  EXPECT_THAT(outcome.message,
              HasSubstr("its CAN controller did not come up (no MCP2518FD); check its wiring"));
}

TEST(ConfigureNode, AHelloWithAnotherScheduleIsReported) {
  const NodeOutcome outcome = configure_scripted(correct_except([](auto& message, const auto&) {
    if (message.which_body == groma_NodeToHost_hello_tag) {
      message.body.hello.schedule_hash = 0x1234;
      message.body.hello.config_hash = 0x5678;
    }
  }));
  EXPECT_EQ(outcome.fault, NodeFault::kNotInForce);
  EXPECT_THAT(outcome.message, HasSubstr("schedule 00001234, not "));
}

TEST(ConfigureNode, LostRepliesAreRequestedAgain) {
  int commands = 0;
  const NodeOutcome outcome = configure_scripted([&](const groma_HostToNode& command) {
    auto answer = correct_except([](auto&, const auto&) {})(command);
    if (++commands % 2 == 1) answer.clear();
    return answer;
  });
  EXPECT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
}

TEST(ConfigureNode, AReplyToAnotherCommandIsIgnored) {
  const NodeOutcome outcome = configure_scripted(correct_except([](auto& message, const auto&) {
    if (message.which_body == groma_NodeToHost_reply_tag) message.body.reply.request_id ^= 1U;
  }));
  EXPECT_EQ(outcome.fault, NodeFault::kNoAnswer);
  EXPECT_THAT(outcome.message, HasSubstr("reports come, but no answer"));
}

TEST(ConfigureNode, AMissingAnswerIsReportedByItsKind) {
  const NodeOutcome silent = configure_scripted(nothing);
  EXPECT_EQ(silent.fault, NodeFault::kNoAnswer);
  EXPECT_THAT(silent.message,
              HasSubstr("no answer, not a byte; check that the node has power and is flashed"));

  const NodeOutcome garbage = configure_scripted(nothing, {'b', 'o', 'o', 't', '\r', '\n', 0});
  EXPECT_EQ(garbage.fault, NodeFault::kNoAnswer);
  EXPECT_THAT(garbage.message, HasSubstr("bytes that are not frames; check the bit rate"));

  std::vector<std::uint8_t> body{wire::kFrameVersion + 1, 1, 2, 3};
  const std::uint32_t crc = wire::crc32(body);
  for (int i = 0; i < 4; ++i) body.push_back(static_cast<std::uint8_t>(crc >> (8 * i)));
  ASSERT_EQ(std::count(body.begin(), body.end(), 0), 0);  // so that one COBS block suffices
  body.insert(body.begin(), {0, static_cast<std::uint8_t>(body.size() + 1)});
  body.push_back(0);
  const NodeOutcome other = configure_scripted(nothing, body);
  EXPECT_THAT(other.message, HasSubstr("frames of another version; flash the image of this release"));
}

TEST(ConfigureNode, APortThatCannotBeOpenedIsReported) {
  const NodeOutcome missing = configure_node(node_at("/dev/no-such-port"), kBaud);
  EXPECT_EQ(missing.fault, NodeFault::kNoPort);
  EXPECT_THAT(missing.message,
              ::testing::StartsWith("node 1: /dev/no-such-port: no such device; plug it in"));

  const NodeOutcome unnamed = configure_node(node_at(""), kBaud);
  EXPECT_EQ(unnamed.fault, NodeFault::kNotInPlan);
  EXPECT_THAT(unnamed.message, HasSubstr("node 1: the plan names no port for it"));

  const simulation::PtyPort port;
  const link::OpenedLink other = link::open_link(port.path(), kBaud);
  ASSERT_TRUE(other.link);
  const NodeOutcome busy = configure_node(node_at(port.path()), kBaud);
  EXPECT_EQ(busy.fault, NodeFault::kBusy);
  EXPECT_THAT(busy.message, HasSubstr("in use by another program"));

  EXPECT_EQ(configure_node(node_at("/dev/null"), kBaud).fault, NodeFault::kUnsuitable);
}

// ---- nodes that report over CAN ---------------------------------------------------------------------------

TEST(ConfigureNode, ANodeOnTheBusMustAnswerThere) {
  ScriptedNode uart(correct_except([](auto&, const auto&) {}));
  ScriptedNode bus(correct_except([](auto&, const auto&) {}));
  PlannedNode node = node_at(uart.path());
  node.can_link = bus.path();
  const NodeOutcome outcome = configure_node(node, kBaud);
  EXPECT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
  EXPECT_EQ(outcome.port, uart.path());
  EXPECT_EQ(bus.commands(), 1);
}

TEST(ConfigureNode, ANodeThatDoesNotAnswerOnTheBusIsReported) {
  ScriptedNode uart(correct_except([](auto&, const auto&) {}));
  ScriptedNode bus([](const groma_HostToNode&) { return std::vector<groma_NodeToHost>{}; });
  PlannedNode node = node_at(uart.path());
  node.can_link = bus.path();
  const NodeOutcome outcome = configure_node(node, kBaud);
  EXPECT_EQ(outcome.fault, NodeFault::kLink);
  EXPECT_THAT(outcome.message, HasSubstr("does not answer at " + bus.path() + "; check the bus"));
}

TEST(ConfigureNode, AComputerWithoutTheBusConfiguresToo) {
  ScriptedNode uart(correct_except([](auto&, const auto&) {}));
  PlannedNode node = node_at(uart.path());
  node.can_link = "/dev/no-such-bus";
  EXPECT_EQ(configure_node(node, kBaud).fault, NodeFault::kNone);
}

TEST(ConfigureNode, ANodeWithoutItsSerialPortIsReachedOverTheBus) {
  ScriptedNode bus(correct_except([](auto&, const auto&) {}));
  PlannedNode node = node_at("/dev/no-such-port");
  node.can_link = bus.path();
  const NodeOutcome outcome = configure_node(node, kBaud);
  EXPECT_EQ(outcome.fault, NodeFault::kNone) << outcome.message;
  EXPECT_EQ(outcome.port, bus.path());
}

TEST(ConfigureNode, ASilentBusSuggestsAnUnconfiguredNode) {
  ScriptedNode bus([](const groma_HostToNode&) { return std::vector<groma_NodeToHost>{}; });
  PlannedNode node = node_at("");
  node.can_link = bus.path();
  const NodeOutcome outcome = configure_node(node, kBaud);
  EXPECT_EQ(outcome.fault, NodeFault::kNoAnswer);
  EXPECT_THAT(outcome.message, HasSubstr("a node that was never configured is reached by its UART alone"));
}

}  // namespace
}  // namespace groma::provision
