// Tests of the board's own code, with the shipped image in the emulator.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstring>
#include <span>
#include <vector>

#include "firmware/core/node/image_identity.hpp"
#include "test/sim/emulator/emulated_site.hpp"
#include "test/support/elf_file.hpp"

namespace groma::sim {
namespace {

using Register = CortexM4::Register;

groma_HostToNode command_of(std::uint32_t request_id, pb_size_t which) {
  groma_HostToNode command = groma_HostToNode_init_zero;
  command.request_id = request_id;
  command.which_body = which;
  return command;
}

class Board : public testing::Test {
 protected:
  void SetUp() override {
    GROMA_NEEDS_SHIPPED_IMAGE();
    space_.put(1, {});
    NodeSpec spec;
    spec.chip.id = 1;
    network_.add(make_emulated_node(spec, shipped(), network_.medium()));
  }

  EmulatedNode& node() { return dynamic_cast<EmulatedNode&>(network_.node(0)); }
  [[nodiscard]] std::uint64_t resets() { return node().usage(network_.now()).resets; }
  void run_until(double t_s) {
    network_.run_until(from_seconds(t_s));
    std::vector<TimedByte> bytes;
    network_.take(0, bytes);
    listener.take(bytes);
  }
  void send(const groma_HostToNode& command) { ASSERT_TRUE(network_.send(0, frame_of(command))); }
  // Continues at `pc`, with interrupts unmasked.
  void jump(std::uint32_t pc) {
    node().cpu().set_register(Register::kPrimask, 0);
    node().cpu().set_register(Register::kPc, pc);
  }
  void put_word(std::uint32_t address, std::uint32_t word) {
    for (std::uint32_t i = 0; i < 4; ++i) {
      node().ram()[address - kRamAddress + i] = static_cast<std::uint8_t>(word >> (8 * i));
    }
  }
  // Samples of one LED, 10 ms apart.
  std::vector<bool> watch(std::size_t light, double from_s, double until_s) {
    std::vector<bool> lit;
    for (double t_s = from_s; t_s < until_s; t_s += 0.01) {
      run_until(t_s);
      lit.push_back(node().soc().lit(light));
    }
    return lit;
  }

  Listener listener;

 private:
  FreeSpace space_;
  Network network_{space_, {}, 1};
};

// ---- the link ---------------------------------------------------------------------------------------------

TEST_F(Board, AnswersABurstOfCommandsWhileRanging) {
  SiteBench site(emulating({.tags = 1, .anchors = 3}, {}, [](std::uint16_t id) { return id == nth_tag(0); }));
  site.run_until(1.0);
  constexpr std::uint32_t kCommands = 60;
  std::vector<std::uint8_t> burst;
  for (std::uint32_t i = 0; i < kCommands; ++i) {
    const auto frame = frame_of(command_of(i + 1, groma_HostToNode_identify_s_tag));
    burst.insert(burst.end(), frame.begin(), frame.end());
  }
  ASSERT_TRUE(site.network.send(0, burst));
  site.run_until(2.5);
  const auto& replies = site.listeners[0].replies;
  ASSERT_EQ(replies.size(), kCommands);
  for (std::uint32_t i = 0; i < kCommands; ++i) EXPECT_EQ(replies[i].request_id, i + 1);
  EXPECT_EQ(emulated(site, 0).soc().uarte().lost_bytes(), 0U);
  EXPECT_EQ(site.listeners[0].counters.link_frames_bad, 0U);
  EXPECT_EQ(site.listeners[0].counters.reports_dropped, 0U);
}

TEST_F(Board, DropsWholeFramesIfTheLineIsFull) {
  // With a faster processor and bus, a single tag with raw timestamps reports more than the line can carry.
  EmulatorOptions fast;
  fast.timing.instruction = fast.timing.cycle * 5 / 4;
  fast.spi_overhead = kUnitsPerMicrosecond / 2;
  SiteBench site(emulating({.tags = 1,
                            .anchors = 12,
                            .method = groma_RangingMethod_METHOD_DS_NEXT_POLL,
                            .turn_round_us = 300,
                            .response_gap_us = 155,
                            .arm_ahead = true},
                           fast, [](std::uint16_t id) { return id == nth_tag(0); }));
  site.run_until(3.0);
  const Listener& heard = site.listeners[0];
  ASSERT_FALSE(heard.reports.empty());
  const std::uint32_t lost = heard.reports.back().body.sequence - heard.reports.front().body.sequence + 1 -
                             static_cast<std::uint32_t>(heard.reports.size());
  // Received frames are whole, and dropped ones are counted, as of the last counters at most a second ago.
  EXPECT_EQ(heard.undecodable, 0);
  EXPECT_EQ(heard.frames().bytes_discarded, 0U);
  EXPECT_GT(lost, 0U);
  EXPECT_GT(heard.counters.reports_dropped, 0U);
  EXPECT_LE(heard.counters.reports_dropped, lost);
}

// ---- faults -----------------------------------------------------------------------------------------------

TEST_F(Board, ReportsTheCallerAfterAStackOverflow) {
  run_until(1.5);
  const std::uint32_t caller = test::ElfFile(test::shipped_image(".elf")).symbol("groma_text_begin") + 0x100;
  put_word(kRamAddress + 8, caller | 1U);
  node().cpu().set_register(Register::kSp, kRamAddress + 8);
  jump(0x0030'0000);
  run_until(3.0);
  ASSERT_EQ(listener.hellos.size(), 2U);
  const groma_Hello& hello = listener.hellos[1];
  EXPECT_EQ(hello.reset_reason, groma_ResetReason_RESET_FAULT);
  constexpr std::uint32_t kStkerr = 1U << 12;
  EXPECT_NE(hello.last_fault.cfsr & kStkerr, 0U);
  EXPECT_EQ(hello.last_fault.pc, caller);
}

TEST_F(Board, ReportsAFaultOnce) {
  run_until(1.5);
  jump(0x0030'0000);
  run_until(3.0);
  ASSERT_EQ(listener.hellos.size(), 2U);
  EXPECT_TRUE(listener.hellos[1].has_last_fault);
  send(command_of(1, groma_HostToNode_reboot_tag));
  run_until(4.5);
  ASSERT_EQ(listener.hellos.size(), 3U);
  EXPECT_EQ(listener.replies.size(), 1U);
  EXPECT_EQ(listener.hellos[2].reset_reason, groma_ResetReason_RESET_SOFTWARE);
  EXPECT_FALSE(listener.hellos[2].has_last_fault);
}

TEST_F(Board, IgnoresAFaultRecordWithAWrongCrc) {
  run_until(1.5);
  jump(0x0030'0000);
  const auto kept = test::ElfFile(test::shipped_image(".elf")).section(".noinit");
  // The record is written before the reset, and read after it.
  for (double t_s = 1.5; t_s < 2.9 && resets() == 0; t_s += 1e-5) run_until(t_s);
  node().ram()[kept.address - kRamAddress + 8] ^= 1;
  run_until(3.0);
  ASSERT_EQ(listener.hellos.size(), 2U);
  EXPECT_EQ(listener.hellos[1].reset_reason, groma_ResetReason_RESET_SOFTWARE);
  EXPECT_FALSE(listener.hellos[1].has_last_fault);
}

TEST_F(Board, IsResetByTheWatchdogFromALoopWithInterruptsMasked) {
  run_until(1.5);
  // A branch to itself, in flash that the image does not use.
  constexpr std::uint32_t kLoop = 0x7'0000;
  node().flash()[kLoop] = 0xFE;
  node().flash()[kLoop + 1] = 0xE7;
  node().cpu().flash_changed(kLoop, 2);
  jump(kLoop);
  node().cpu().set_register(Register::kPrimask, 1);
  run_until(11.0);
  ASSERT_EQ(listener.hellos.size(), 2U);
  EXPECT_EQ(listener.hellos[1].reset_reason, groma_ResetReason_RESET_WATCHDOG);
  // With interrupts masked the watchdog's handler could not record the position.
  EXPECT_FALSE(listener.hellos[1].has_last_fault);
}

// ---- identity, LEDs, timing, stack ------------------------------------------------------------------------

TEST_F(Board, ReportsTheIdentityOfItsImage) {
  using node::ImageIdentity;
  const auto begin = shipped().flash.begin();
  const auto end = begin + ImageIdentity::kSearched_bytes;
  const auto found = std::search(begin, end, ImageIdentity::kMark.begin(), ImageIdentity::kMark.end());
  ASSERT_NE(found, end);
  ImageIdentity identity("", 0, "");
  std::memcpy(&identity, &*found, sizeof(identity));
  run_until(1.0);
  ASSERT_EQ(listener.hellos.size(), 1U);
  EXPECT_STREQ(listener.hellos[0].version, identity.version.data());
  EXPECT_THAT(identity.version[0], testing::AllOf(testing::Ge('0'), testing::Le('9')));
  EXPECT_EQ(listener.hellos[0].git_hash, identity.git_hash);
  EXPECT_EQ(listener.hellos[0].role, groma_Role_ROLE_UNCONFIGURED);
}

TEST_F(Board, ShowsItsStateByItsLeds) {
  constexpr std::size_t kBlue = 3;
  const auto changes = [](const std::vector<bool>& lit) {
    int count = 0;
    for (std::size_t i = 1; i < lit.size(); ++i) count += lit[i] != lit[i - 1] ? 1 : 0;
    return count;
  };
  // Not configured: blue, half a second on, half a second off.
  EXPECT_NEAR(changes(watch(kBlue, 1.0, 5.0)), 8, 1);
  EXPECT_EQ(changes(watch(0, 5.0, 6.0)), 0);
  groma_HostToNode identify = command_of(1, groma_HostToNode_identify_s_tag);
  identify.body.identify_s = 2;
  send(identify);
  run_until(6.1);
  double from_s = 6.2;
  for (const std::size_t light : {0U, 1U, 2U, 3U}) {
    EXPECT_NEAR(changes(watch(light, from_s, from_s + 0.4)), 4, 1) << light;
    from_s += 0.4;
  }
  EXPECT_EQ(changes(watch(0, 8.5, 9.5)), 0);
}

// The emulator's 1.25 cycles per instruction are an estimate; with a real board's flash it may be more.
TEST_F(Board, KeepsItsSlotsAtTwoCyclesPerInstruction) {
  EmulatorOptions slow;
  slow.timing.instruction = 2 * slow.timing.cycle;
  SiteBench site(emulating({.tags = 3, .anchors = 6}, slow));
  site.run_until(1.2);
  std::vector<groma_Counters> joined;
  for (std::size_t i = 0; i < 3; ++i) joined.push_back(site.listeners[i].counters);
  site.run_until(2.3);
  for (std::size_t i = 0; i < 3; ++i) {
    const groma_Counters& counters = site.listeners[i].counters;
    EXPECT_EQ(counters.late_transmits, 0U) << "tag " << i;
    // A receive window that begins while a tag joins the network may be late.
    EXPECT_LE(joined[i].late_receives, 2U) << "tag " << i;
    EXPECT_EQ(counters.late_receives, joined[i].late_receives) << "tag " << i;
    EXPECT_GT(counters.ranges_completed, joined[i].ranges_completed) << "tag " << i;
  }
  const double superframe_s = sim::seconds_of(site.superframe());
  EXPECT_GT(site.good_ranges(1.3), 0.94 * 3 * 6 / superframe_s);
}

TEST_F(Board, UsesAtMostHalfOfItsStack) {
  SiteBench site(emulating({.tags = 1, .anchors = 3}));
  site.run_until(1.0);
  for (std::size_t i = 0; i < site.network.size(); ++i) {
    groma_HostToNode write = command_of(1, groma_HostToNode_write_config_tag);
    const bool tag = i == 0;
    const auto id = tag ? nth_tag(0) : nth_anchor(static_cast<int>(i) - 1);
    write.body.write_config = site.config_of(id, tag ? groma_Role_ROLE_TAG : groma_Role_ROLE_ANCHOR);
    write.body.write_config.report_raw_stamps = false;
    ASSERT_TRUE(site.network.send(i, frame_of(write)));
    ASSERT_TRUE(site.network.send(i, frame_of(command_of(2, groma_HostToNode_read_config_tag))));
  }
  site.run_until(2.0);
  for (std::size_t i = 0; i < site.network.size(); ++i) {
    ASSERT_TRUE(site.network.send(i, frame_of(command_of(3, groma_HostToNode_apply_config_tag))));
    ASSERT_TRUE(site.network.send(i, frame_of(command_of(4, groma_HostToNode_get_hello_tag))));
  }
  site.run_until(4.0);
  for (const Listener& each : site.listeners) {
    EXPECT_EQ(each.replies.size(), 4U);
    const groma_Hello& hello = each.hellos.back();
    EXPECT_GT(hello.stack_high_water_bytes, 1'000U);
    EXPECT_LE(hello.stack_high_water_bytes, hello.stack_size_bytes / 2);
    RecordProperty("stack_high_water_bytes", static_cast<int>(hello.stack_high_water_bytes));
  }
}

}  // namespace
}  // namespace groma::sim
