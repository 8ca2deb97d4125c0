#include "host/provision/site_plan.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>

#include "firmware/core/node/config.hpp"
#include "host/io/error.hpp"
#include "host/link/report_decoder.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::provision {
namespace {

using ::testing::HasSubstr;

constexpr const char* kWhole = R"(schema: 1
network_id: 18258
schedule: {epoch: 7, master_id: 12, method: next-poll, preamble: 64, turn_round_us: 400, response_gap_us: 250, guard_us: 40}
radio: {transmit_antenna_delay_dtu: 16440, receive_antenna_delay_dtu: 16450, transmit_power: 0x1F1F1F1F}
link: {type: can-fd, baud: 115200, can_interface: can0, nominal_bit_per_s: 500000, data_bit_per_s: 4000000}
report_raw_stamps: true
nodes:
  - {id: 12, role: anchor, port: /dev/serial/by-id/x, probe: "000760012345"}
  - {id: 3, role: tag, port: ports/tag-3, transmit_antenna_delay_dtu: 16436}
  - {id: 10, role: anchor}
correct_temperature: true
correct_power_bias: true
)";

class SitePlanTest : public ::testing::Test {
 protected:
  SitePlan read(const std::string& text) {
    scratch_.write("plan.yaml", text);
    return read_site_plan(scratch_ / "plan.yaml");
  }
  // The message of the ConfigError that this text causes, or "none".
  std::string fault_of(const std::string& text) {
    try {
      (void)read(text);
    } catch (const io::ConfigError& error) {
      return error.what();
    }
    return "none";
  }
  // kWhole with one piece changed.
  std::string fault_with(const std::string& from, const std::string& to) {
    std::string text = kWhole;
    const std::size_t at = text.find(from);
    EXPECT_NE(at, std::string::npos) << from;
    return fault_of(text.replace(at, from.size(), to));
  }

  groma::test::ScratchFolder scratch_;
};

TEST_F(SitePlanTest, EachKeyReachesTheConfiguration) {
  const SitePlan plan = read(kWhole);
  EXPECT_EQ(plan.baud, 115'200U);
  ASSERT_EQ(plan.nodes.size(), 3U);
  const PlannedNode& anchor = plan.nodes[0];
  EXPECT_EQ(anchor.id, 12);
  EXPECT_EQ(anchor.port, "/dev/serial/by-id/x");
  EXPECT_EQ(anchor.probe, "000760012345");
  EXPECT_EQ(anchor.can_link, "canfd:can0/12");
  const groma_Config& config = anchor.config;
  EXPECT_EQ(config.role, groma_Role_ROLE_ANCHOR);
  EXPECT_EQ(config.id, 12U);
  EXPECT_EQ(config.network_id, 18'258U);
  EXPECT_EQ(config.preamble, groma_Preamble_PREAMBLE_64);
  EXPECT_EQ(config.transmit_antenna_delay_dtu, 16'440U);
  EXPECT_EQ(config.receive_antenna_delay_dtu, 16'450U);
  EXPECT_EQ(config.transmit_power, 0x1F1F1F1FU);
  EXPECT_TRUE(config.report_raw_stamps);
  EXPECT_TRUE(config.correct_temperature);
  EXPECT_TRUE(config.correct_power_bias);
  EXPECT_EQ(config.link, groma_Link_LINK_CAN_FD);
  EXPECT_EQ(config.can_nominal_bit_per_s, 500'000U);
  EXPECT_EQ(config.can_data_bit_per_s, 4'000'000U);
  const groma_Schedule& schedule = config.schedule;
  EXPECT_EQ(schedule.epoch, 7U);
  EXPECT_EQ(schedule.master_id, 12U);
  EXPECT_EQ(schedule.method, groma_RangingMethod_METHOD_DS_NEXT_POLL);
  EXPECT_EQ(schedule.turn_round_us, 400U);
  EXPECT_EQ(schedule.response_gap_us, 250U);
  EXPECT_EQ(schedule.guard_us, 40U);
  ASSERT_EQ(schedule.tag_ids_count, 1);
  ASSERT_EQ(schedule.anchor_ids_count, 2);
  EXPECT_EQ(schedule.anchor_ids[0], 10);  // ascending, independent of the file's order
  EXPECT_EQ(schedule.anchor_ids[1], 12);

  const PlannedNode* tag = plan.find(3);
  ASSERT_NE(tag, nullptr);
  EXPECT_EQ(tag->port, (scratch_ / "ports/tag-3").string());
  EXPECT_EQ(tag->config.role, groma_Role_ROLE_TAG);
  EXPECT_EQ(tag->config.transmit_antenna_delay_dtu, 16'436U);
  EXPECT_EQ(tag->config.receive_antenna_delay_dtu, 16'450U);
  EXPECT_EQ(node::schedule_hash_of(tag->config), node::schedule_hash_of(config));
  EXPECT_EQ(plan.find(4), nullptr);
}

TEST_F(SitePlanTest, AMinimalPlanUsesTheDefaults) {
  const SitePlan plan = read(
      "schema: 1\nnetwork_id: 5\nnodes: [{id: 9, role: anchor}, {id: 4, role: anchor}, {id: 1, role: "
      "tag}]\n");
  EXPECT_EQ(plan.baud, 1'000'000U);
  const groma_Config& config = plan.nodes[0].config;
  EXPECT_EQ(config.schedule.master_id, 4U);  // the lowest anchor
  EXPECT_EQ(config.schedule.epoch, 1U);
  EXPECT_EQ(config.preamble, groma_Preamble_PREAMBLE_128);
  EXPECT_EQ(config.link, groma_Link_LINK_UART);
  EXPECT_EQ(config.transmit_power, 0U);
  EXPECT_EQ(plan.nodes[0].port, "");
  EXPECT_EQ(plan.nodes[0].can_link, "");
  EXPECT_EQ(config.schedule.method, groma_RangingMethod_METHOD_DS_NEXT_POLL);
  EXPECT_EQ(config.schedule.turn_round_us, 350U);
  EXPECT_EQ(config.schedule.response_gap_us, 300U);
  EXPECT_FALSE(config.schedule.arm_ahead);
  // The site survives the loss of its master.
  ASSERT_EQ(config.schedule.backup_ids_count, 1);
  EXPECT_EQ(config.schedule.backup_ids[0], 9);
  EXPECT_EQ(config.network_key.size, 0);
}

TEST_F(SitePlanTest, TheDefaultGapDependsOnKeyAndArmAhead) {
  const std::string nodes = "schema: 1\nnetwork_id: 5\nnodes: [{id: 9, role: anchor}, {id: 1, role: tag}]\n";
  const SitePlan ahead = read(nodes + "schedule: {arm_ahead: true}\n");
  EXPECT_TRUE(ahead.nodes[0].config.schedule.arm_ahead);
  EXPECT_EQ(ahead.nodes[0].config.schedule.response_gap_us, 220U);
  EXPECT_NE(node::schedule_hash_of(ahead.nodes[0].config),
            node::schedule_hash_of(read(nodes + "schedule: {response_gap_us: 220}\n").nodes[0].config));
  SiteSettings keyed;
  keyed.network_key.emplace();
  EXPECT_EQ(config_of(keyed, groma_Role_ROLE_TAG, 1).schedule.response_gap_us, 320U);
}

constexpr const char* kCells = R"(schema: 1
network_id: 5
schedule: {backup_ids: [13, 11], responses: 3}
nodes:
  - {id: 2, role: tag, slot: 1}
  - {id: 1, role: tag, slot: 0}
  - {id: 3, role: tag, slot: 1}
  - {id: 10, role: anchor}
  - {id: 11, role: anchor}
  - {id: 12, role: anchor}
  - {id: 13, role: anchor}
)";

TEST_F(SitePlanTest, TagsOutOfEachOthersReachMayShareASlot) {
  const SitePlan plan = read(kCells);
  const groma_Schedule& schedule = plan.nodes[0].config.schedule;
  EXPECT_EQ(schedule.slots, 2U);
  EXPECT_EQ(schedule.responses, 3U);
  ASSERT_EQ(schedule.tag_slots_count, 3);
  EXPECT_EQ(schedule.tag_slots[0], 0);
  EXPECT_EQ(schedule.tag_slots[1], 1);
  EXPECT_EQ(schedule.tag_slots[2], 1);
  ASSERT_EQ(schedule.backup_ids_count, 2);
  EXPECT_EQ(schedule.backup_ids[0], 13);  // by rank, in the file's order
  EXPECT_EQ(schedule.backup_ids[1], 11);
}

TEST_F(SitePlanTest, FaultsOfRanksAndSlotsAreReported) {
  const auto fault = [&](const std::string& from, const std::string& to) {
    std::string text = kCells;
    const std::size_t at = text.find(from);
    EXPECT_NE(at, std::string::npos) << from;
    return fault_of(text.replace(at, from.size(), to));
  };
  EXPECT_THAT(fault("[13, 11]", "[13, 14]"), HasSubstr("backup_ids[1] is 14; name one of the anchors"));
  EXPECT_THAT(fault("[13, 11]", "[13, 13]"), HasSubstr("13 has its rank already"));
  EXPECT_THAT(fault("[13, 11]", "[10]"), HasSubstr("10 has its rank already"));
  EXPECT_THAT(fault("slot: 0", "slot: 16"), HasSubstr("slot is 16; it has to be 0 to 15"));
  EXPECT_THAT(fault(", slot: 0", ""), HasSubstr("names slots, but none for tag 1"));
  EXPECT_THAT(fault("id: 12, role: anchor", "id: 12, role: anchor, slot: 1"), HasSubstr("slot is a tag's"));
  EXPECT_THAT(fault("responses: 3", "responses: 17"), HasSubstr("responses is 17; it has to be 1 to 16"));
}

TEST_F(SitePlanTest, TheNetworkKeyComesFromItsOwnFileAndIsNotShown) {
  const std::string text =
      "schema: 1\nnetwork_id: 5\nnetwork_key_file: key\nnodes: [{id: 9, role: anchor}, {id: 1, role: tag}]\n";
  scratch_.write("key", "000102030405060708090A0b0c0d0eff\n");
  std::filesystem::permissions(scratch_ / "key", std::filesystem::perms{0600});
  const groma_Config config = read(text).nodes[0].config;
  ASSERT_EQ(config.network_key.size, 16);
  EXPECT_EQ(config.network_key.bytes[1], 1);
  EXPECT_EQ(config.network_key.bytes[10], 10);
  EXPECT_EQ(config.network_key.bytes[15], 0xFF);
  for (const char* bad : {"", "secret", "000102030405060708090A0b0c0d0e", "000102030405060708090A0b0c0d0exy",
                          "000102030405060708090A0b0c0d0eff00"}) {
    scratch_.write("key", bad);
    const std::string fault = fault_of(text);
    EXPECT_THAT(fault, HasSubstr("plan.yaml:3:19: network_key_file names"));
    EXPECT_THAT(fault, HasSubstr("which holds no key; write 32 hexadecimal digits"));
    EXPECT_THAT(fault, ::testing::Not(HasSubstr("0102")));
  }
}

TEST_F(SitePlanTest, RefusesAKeyThatOthersMayReadOrWrite) {
  const std::string text =
      "schema: 1\nnetwork_id: 5\nnetwork_key_file: key\nnodes: [{id: 9, role: anchor}, {id: 1, role: tag}]\n";
  scratch_.write("key", "000102030405060708090A0b0c0d0eff\n");
  for (const unsigned mode : {0640U, 0620U, 0604U, 0602U, 0666U}) {
    SCOPED_TRACE(mode);
    std::filesystem::permissions(scratch_ / "key", std::filesystem::perms{mode});
    try {
      static_cast<void>(read(text));
      ADD_FAILURE() << "no error";
    } catch (const io::PermissionError& error) {
      EXPECT_THAT(error.what(), HasSubstr("key: others may read or change this key; 'chmod 600 "));
    }
  }
  std::filesystem::permissions(scratch_ / "key", std::filesystem::perms{0400});
  EXPECT_EQ(read(text).nodes.at(0).config.network_key.size, 16);
}

TEST_F(SitePlanTest, ANodeWithoutACableNamesTheNodeThatPassesOn) {
  const std::string text =
      "schema: 1\nnetwork_id: 1\nnodes:\n"
      "  - {id: 1, role: tag, port: /dev/ttyACM0}\n"
      "  - {id: 10, role: anchor, via: 1}\n";
  const SitePlan plan = read(text);
  EXPECT_EQ(plan.nodes[1].via, 1);
  EXPECT_EQ(plan.nodes[1].via_port, plan.nodes[0].port);
  EXPECT_EQ(plan.nodes[1].port, "");
  EXPECT_THAT(fault_of(text + "  - {id: 11, role: anchor, via: 10}\n"),
              HasSubstr("via 10 is not a node with a port"));
  EXPECT_THAT(fault_of(text + "  - {id: 11, role: anchor, via: 2}\n"),
              HasSubstr("is not a node with a port"));
  EXPECT_THAT(fault_of(text + "  - {id: 11, role: anchor, via: 1, port: x}\n"),
              HasSubstr("cannot be combined with 'port:'"));
}

TEST_F(SitePlanTest, EachFaultIsReportedWithPlaceAndRemedy) {
  EXPECT_THAT(fault_with("epoch: 7", "epok: 7"), HasSubstr("plan.yaml:3:12: unknown key 'epok'"));
  EXPECT_THAT(fault_with("schema: 1", "schema: 2"), HasSubstr(":1:9: schema is not 1"));
  EXPECT_THAT(fault_with("18258", "65535"), HasSubstr(":2:13: network_id is 65535; it has to be 0 to 65534"));
  EXPECT_THAT(fault_with("master_id: 12", "master_id: 3"),
              HasSubstr("schedule.master_id is 3; name one of the anchors"));
  EXPECT_THAT(fault_with("guard_us: 40", "guard_us: 1"), HasSubstr("guard_us is 1; it has to be 2 to 1000"));
  EXPECT_THAT(fault_with("preamble: 64", "preamble: 65"), HasSubstr("it has to be one of 64, 128, 256"));
  EXPECT_THAT(fault_with("0x1F1F1F1F", "0x1F1F1F1F1"), HasSubstr("is not a register value of 32 bits"));
  EXPECT_THAT(fault_with("0x1F1F1F1F", "loud"), HasSubstr("is not a register value of 32 bits"));
  EXPECT_THAT(fault_with("id: 3, role", "id: 12, role"), HasSubstr(":9:10: nodes[1].id 12 is taken"));
  EXPECT_THAT(fault_with("id: 3, role: tag", "id: 3, role: robot"),
              HasSubstr("it has to be one of tag, anchor"));
  EXPECT_THAT(fault_with("ports/tag-3", "/dev/serial/by-id/x"), HasSubstr("nodes[1].port is given twice"));
  EXPECT_THAT(fault_with("id: 3, role: tag", "id: 3, role: anchor"), HasSubstr("nodes has no tag"));
  EXPECT_THAT(fault_with("type: can-fd", "type: uart"), HasSubstr("requires 'type: can' or 'type: can-fd'"));
  EXPECT_THAT(fault_with("type: can-fd", "type: can"), HasSubstr("requires 'type: can-fd'"));
  EXPECT_THAT(fault_with("can_interface: can0, ", ""), HasSubstr("lacks the key can_interface"));
  EXPECT_THAT(fault_with("\"000760012345\"", "\"\""), HasSubstr("'groma flash --list'"));
}

TEST_F(SitePlanTest, MoreNodesThanAScheduleHoldsAreRefused) {
  std::string text = "schema: 1\nnetwork_id: 5\nnodes:\n  - {id: 100, role: tag}\n";
  for (int id = 1; id <= 64; ++id) text += "  - {id: " + std::to_string(id) + ", role: anchor}\n";
  EXPECT_EQ(read(text).nodes.size(), 65U);
  EXPECT_THAT(fault_of(text + "  - {id: 65, role: anchor}\n"),
              HasSubstr(":69:5: nodes[65] is one anchor too many"));
}

TEST(Differences, EachFieldIsCompared) {
  const SitePlan plan = [] {
    const groma::test::ScratchFolder scratch;
    scratch.write("plan.yaml", kWhole);
    return read_site_plan(scratch / "plan.yaml");
  }();
  const groma_Config config = plan.nodes[0].config;
  EXPECT_EQ(differences(config, config), "");
  const auto expect_diff = [&](auto change, const std::string& name) {
    groma_Config other = config;
    change(other);
    EXPECT_THAT(differences(other, config), HasSubstr(name));
  };
  expect_diff([](auto& c) { c.role = groma_Role_ROLE_TAG; }, "role: 2, not 1");
  expect_diff([](auto& c) { c.id = 1; }, "id: 1, not 12");
  expect_diff([](auto& c) { c.network_id = 1; }, "network_id: 1, not 18258");
  expect_diff([](auto& c) { c.preamble = groma_Preamble_PREAMBLE_256; }, "preamble: 2, not 1");
  expect_diff([](auto& c) { c.transmit_antenna_delay_dtu = 1; }, "transmit_antenna_delay_dtu: 1, not 16440");
  expect_diff([](auto& c) { c.receive_antenna_delay_dtu = 1; }, "receive_antenna_delay_dtu: 1, not 16450");
  expect_diff([](auto& c) { c.transmit_power = 1; }, "transmit_power");
  expect_diff([](auto& c) { c.report_raw_stamps = false; }, "report_raw_stamps: false, not true");
  expect_diff([](auto& c) { c.correct_temperature = false; }, "correct_temperature: false, not true");
  expect_diff([](auto& c) { c.correct_power_bias = false; }, "correct_power_bias: false, not true");
  expect_diff([](auto& c) { c.link = groma_Link_LINK_UART; }, "link: 0, not 2");
  expect_diff([](auto& c) { c.can_nominal_bit_per_s = 1; }, "can_nominal_bit_per_s: 1, not 500000");
  expect_diff([](auto& c) { c.can_data_bit_per_s = 1; }, "can_data_bit_per_s: 1, not 4000000");
  expect_diff([](auto& c) { c.has_schedule = false; }, "has schedule: false, not true");
  expect_diff([](auto& c) { c.schedule.epoch = 1; }, "schedule.epoch: 1, not 7");
  expect_diff([](auto& c) { c.schedule.master_id = 10; }, "schedule.master_id: 10, not 12");
  expect_diff([](auto& c) { c.schedule.tag_ids[0] = 9; }, "schedule.tag_ids: [9], not [3]");
  expect_diff([](auto& c) { c.schedule.anchor_ids_count = 1; }, "schedule.anchor_ids: [10], not [10, 12]");
  expect_diff([](auto& c) { c.schedule.method = groma_RangingMethod_METHOD_DS_FINAL; }, "schedule.method");
  expect_diff([](auto& c) { c.schedule.turn_round_us = 1; }, "schedule.turn_round_us: 1, not 400");
  expect_diff([](auto& c) { c.schedule.response_gap_us = 1; }, "schedule.response_gap_us: 1, not 250");
  expect_diff([](auto& c) { c.schedule.guard_us = 1; }, "schedule.guard_us: 1, not 40");
}

}  // namespace
}  // namespace groma::provision
