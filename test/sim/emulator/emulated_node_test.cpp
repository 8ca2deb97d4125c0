// The shipped image on emulated nodes, end to end.
#include "firmware/sim/emulator/emulated_node.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <iostream>
#include <map>
#include <tuple>

#include "test/sim/emulator/emulated_site.hpp"

namespace groma::sim {
namespace {

using Register = CortexM4::Register;

constexpr MediumSettings kNoise{
    .timestamp_noise_s = 1e-10, .carrier_noise_ppm = 0.05, .loss_probability = 0.02};

class ShippedImage : public ::testing::Test {
 protected:
  void SetUp() override { GROMA_NEEDS_SHIPPED_IMAGE(); }
};

// One node without a configuration, in empty space.
struct LoneNode {
  explicit LoneNode(const EmulatorOptions& options = {}, std::vector<std::uint8_t> stored_config = {},
                    const ChipQuirks& quirks = {}) {
    space.put(1, {});
    NodeSpec spec;
    spec.chip.id = 1;
    spec.chip.quirks = quirks;
    spec.chip.clock.offset_ppm = 13.0;
    spec.stored_config = std::move(stored_config);
    network.add(make_emulated_node(spec, shipped(), network.medium(), options));
  }
  EmulatedNode& node() { return dynamic_cast<EmulatedNode&>(network.node(0)); }
  void run_until(double t_s) {
    network.run_until(from_seconds(t_s));
    std::vector<TimedByte> bytes;
    network.take(0, bytes);
    listener.take(bytes);
  }
  void send(std::uint32_t request_id, pb_size_t which) {
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.request_id = request_id;
    command.which_body = which;
    ASSERT_TRUE(network.send(0, frame_of(command)));
  }

  FreeSpace space;
  Network network{space, {}, 1};
  Listener listener;
};

TEST_F(ShippedImage, BootsAndSendsHello) {
  LoneNode site;
  site.run_until(1.5);
  ASSERT_EQ(site.listener.hellos.size(), 1U);
  const groma_Hello& hello = site.listener.hellos[0];
  EXPECT_STRNE(hello.version, "");
  EXPECT_STREQ(hello.radio_error, "");
  EXPECT_EQ(hello.reset_reason, groma_ResetReason_RESET_POWER_ON);
  EXPECT_FALSE(hello.has_last_fault);
  EXPECT_GT(hello.stack_high_water_bytes, 100U);
  EXPECT_LT(hello.stack_high_water_bytes, hello.stack_size_bytes);
  EXPECT_EQ(site.listener.undecodable, 0);
  EXPECT_EQ(site.node().usage(site.network.now()).resets, 0U);
  EXPECT_LT(site.node().usage(site.network.now()).cpu_load, 0.5);
}

TEST_F(ShippedImage, WakesARadioThatSleeps) {
  LoneNode site({}, {}, {.asleep = true});
  site.run_until(1.5);
  ASSERT_EQ(site.listener.hellos.size(), 1U);
  EXPECT_STREQ(site.listener.hellos[0].radio_error, "");
  EXPECT_THAT(site.listener.logs, ::testing::ElementsAre("radio: woken from sleep"));
}

TEST_F(ShippedImage, AnswersItsHost) {
  LoneNode site;
  site.run_until(1.0);
  site.send(5, groma_HostToNode_get_hello_tag);
  site.run_until(1.1);
  ASSERT_EQ(site.listener.replies.size(), 1U);
  EXPECT_EQ(site.listener.replies[0].request_id, 5U);
  EXPECT_EQ(site.listener.hellos.size(), 2U);
  site.send(6, groma_HostToNode_reboot_tag);
  site.run_until(2.0);
  ASSERT_EQ(site.listener.hellos.size(), 3U);
  EXPECT_EQ(site.listener.hellos[2].reset_reason, groma_ResetReason_RESET_SOFTWARE);
  EXPECT_EQ(site.listener.hellos[1].boot_count, 1U);
  EXPECT_EQ(site.listener.hellos[2].boot_count, 2U);
  EXPECT_EQ(site.node().uart_in().next_byte(), kNever);
  EXPECT_EQ(site.node().soc().uarte().lost_bytes(), 0U);
}

// The largest configuration, with its ids in no order, or that of a usual site.
groma_Config anchors_config(bool large) {
  groma_Config config = groma_Config_init_zero;
  config.role = groma_Role_ROLE_ANCHOR;
  config.id = 60'002;
  config.network_id = 65'000;
  config.has_schedule = true;
  groma_Schedule& schedule = config.schedule;
  schedule.epoch = 70'000;
  schedule.master_id = 60'001;
  schedule.turn_round_us = 5'000;
  schedule.response_gap_us = 2'000;
  schedule.guard_us = 1'000;
  schedule.responses = 12;
  const int tags = large ? 16 : 3;
  for (int i = 0; i < tags; ++i) {
    schedule.tag_ids[schedule.tag_ids_count++] = static_cast<std::uint16_t>(large ? 50'016 - i : 50'001 + i);
    if (large) schedule.tag_slots[schedule.tag_slots_count++] = static_cast<std::uint8_t>(15 - i);
  }
  for (int i = 0; i < (large ? 64 : 12); ++i)
    schedule.anchor_ids[schedule.anchor_ids_count++] = static_cast<std::uint16_t>(60'001 + i);
  for (int i = 0; i < (large ? 7 : 2); ++i)
    schedule.backup_ids[schedule.backup_ids_count++] = static_cast<std::uint16_t>(60'002 + i);
  config.network_key.size = 16;
  return config;
}

TEST_F(ShippedImage, ReportsItsConfigurationQuickly) {
  for (const bool large : {false, true}) {
    const groma_Config config = anchors_config(large);
    std::vector<std::uint8_t> blob(node::kMaxConfigBytes);
    blob.resize(node::encode_config(config, blob));
    LoneNode site({}, blob);
    site.run_until(1.5);
    const auto instructions_of = [&](pb_size_t which) {
      const double begin_s = to_seconds(site.network.now());
      const auto before = site.node().usage(site.network.now()).instructions;
      if (which != 0) site.send(9, which);
      site.run_until(begin_s + 0.02);
      return site.node().usage(site.network.now()).instructions - before;
    };
    const auto idle = instructions_of(0);
    const auto busy = instructions_of(groma_HostToNode_read_config_tag);
    ASSERT_EQ(site.listener.replies.size(), 1U);
    ASSERT_TRUE(site.listener.replies[0].has_config);
    EXPECT_EQ(node::config_hash_of(site.listener.replies[0].config), node::config_hash_of(config));
    EXPECT_EQ(site.listener.replies[0].config.network_key.size, 0U);
    std::cout << "a configuration of " << blob.size() << " bytes: " << busy - idle << " instructions\n";
    EXPECT_LT(busy - idle, large ? 100'000U : 60'000U);
  }
}

TEST_F(ShippedImage, CountsCommandsThatCameTooFast) {
  LoneNode site;
  site.run_until(1.0);
  constexpr std::size_t kCommands = 200;
  std::size_t sent_bytes = 0;
  for (std::uint32_t i = 0; i < kCommands; ++i) {
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.request_id = 1'000 + i;
    command.which_body = groma_HostToNode_get_hello_tag;
    const auto frame = frame_of(command);
    sent_bytes += frame.size();
    ASSERT_TRUE(site.network.send(0, frame));
  }
  site.run_until(1.5);
  const std::size_t answered = site.listener.replies.size();
  const std::size_t each = sent_bytes / kCommands;
  EXPECT_GT(answered, kCommands / 10);
  EXPECT_LT(answered, kCommands);
  // The last lost bytes may have held a frame's end; the rest of that frame would then be taken for the start
  // of the next one.
  ASSERT_TRUE(site.network.send(0, std::vector<std::uint8_t>{0}));
  site.send(1, groma_HostToNode_get_counters_tag);
  site.run_until(1.6);
  ASSERT_EQ(site.listener.replies.size(), answered + 1);
  const groma_Counters& counters = site.listener.counters;
  std::cout << answered << " of " << kCommands << " answered, " << counters.link_bytes_lost << " of "
            << sent_bytes << " bytes lost, " << counters.link_frames_bad << " frames bad\n";
  // An unanswered command was lost whole, or torn at the edge of a lost chunk of 64 bytes.
  EXPECT_GT(counters.link_frames_bad, 0U);
  EXPECT_GE(answered * each + counters.link_bytes_lost + (64 + 2 * each) * counters.link_frames_bad,
            sent_bytes);
  EXPECT_LE(answered * each + counters.link_bytes_lost, sent_bytes + each);

  // One at a time, nothing is lost.
  const std::uint32_t lost = counters.link_bytes_lost;
  double t_s = 1.6;
  for (std::uint32_t i = 0; i < 20; ++i) {
    site.send(5'000 + i, groma_HostToNode_get_counters_tag);
    while (site.listener.replies.back().request_id != 5'000 + i && t_s < 3.0) site.run_until(t_s += 0.0005);
  }
  EXPECT_EQ(site.listener.replies.size(), answered + 21);
  EXPECT_EQ(site.listener.counters.link_bytes_lost, lost);
}

struct Errors {
  int count = 0;
  double rms_m = 0.0;
  double worst_m = 0.0;
};

Errors errors_of(const SiteBench& site, double from_s) {
  Errors errors;
  double squares = 0.0;
  site.each_range(
      [&](const groma_SlotReport& report, const groma_Range& range) {
        if (range.status != groma_RangeStatus_RANGE_OK) return;
        const double error_m = static_cast<double>(range.range_m) -
                               site.space.distance_m(static_cast<std::uint16_t>(report.tag_id),
                                                     static_cast<std::uint16_t>(range.anchor_id));
        ++errors.count;
        squares += error_m * error_m;
        errors.worst_m = std::max(errors.worst_m, std::abs(error_m));
      },
      from_s);
  errors.rms_m = std::sqrt(squares / std::max(errors.count, 1));
  return errors;
}

TEST_F(ShippedImage, IsConfiguredOverItsUartAndRangesWithNativeNeighbours) {
  SiteSettings settings{.tags = 1, .anchors = 3};
  settings.make_node = [](const NodeSpec& spec, Medium& medium) -> std::unique_ptr<NodeHost> {
    if (spec.chip.id != nth_tag(0)) return make_native_node(spec, medium);
    NodeSpec blank = spec;
    blank.stored_config.clear();
    return make_emulated_node(blank, shipped(), medium);
  };
  SiteBench site(settings);
  site.run_until(1.0);
  ASSERT_EQ(site.listeners[0].hellos.size(), 1U);
  EXPECT_EQ(site.listeners[0].hellos[0].role, groma_Role_ROLE_UNCONFIGURED);

  groma_HostToNode command = groma_HostToNode_init_zero;
  command.request_id = 1;
  command.which_body = groma_HostToNode_write_config_tag;
  command.body.write_config = site.config_of(nth_tag(0), groma_Role_ROLE_TAG);
  ASSERT_TRUE(site.network.send(0, frame_of(command)));
  site.run_until(1.5);
  command.request_id = 2;
  command.which_body = groma_HostToNode_apply_config_tag;
  ASSERT_TRUE(site.network.send(0, frame_of(command)));
  site.run_until(4.0);
  ASSERT_EQ(site.listeners[0].replies.size(), 2U);
  EXPECT_EQ(site.listeners[0].replies[0].result, groma_Result_RESULT_OK);
  EXPECT_EQ(site.listeners[0].replies[1].result, groma_Result_RESULT_OK);
  const Errors errors = errors_of(site, 2.5);
  EXPECT_GT(errors.count, 300);
  EXPECT_LT(errors.worst_m, 0.01);
  EXPECT_EQ(site.listeners[0].undecodable, 0);
}

TEST_F(ShippedImage, RangesInAMixedNetwork) {
  // An emulated master, native and emulated anchors and tags.
  SiteBench site(emulating({.tags = 2, .anchors = 4}, {}, [](std::uint16_t id) { return id % 2 == 1; }));
  site.run_until(3.0);
  const Errors errors = errors_of(site, 1.5);
  EXPECT_GT(errors.count, 500);
  EXPECT_LT(errors.worst_m, 0.01);
  for (std::size_t i = 0; i < site.network.size(); ++i) {
    EXPECT_EQ(site.listeners[i].undecodable, 0) << i;
    EXPECT_EQ(site.listeners[i].counters.late_transmits, 0U) << i;
    EXPECT_EQ(site.listeners[i].counters.radio_recoveries, 0U) << i;
    EXPECT_EQ(site.network.node(i).chip().late_announcements(), 0U) << i;
    EXPECT_EQ(site.network.node(i).chip().garbled_transfers(), 0U) << i;
  }
}

TEST_F(ShippedImage, RangesWithASeparateProcessorCrystal) {
  SiteSettings settings{.tags = 1, .anchors = 3};
  settings.make_node = [](const NodeSpec& spec, Medium& medium) -> std::unique_ptr<NodeHost> {
    NodeSpec changed = spec;
    changed.cpu_clock = ClockSpec{.offset_ppm = spec.chip.id % 2 == 0 ? 40.0 : -40.0};
    return make_emulated_node(changed, shipped(), medium);
  };
  SiteBench site(settings);
  site.run_until(2.0);
  const Errors errors = errors_of(site, 1.0);
  EXPECT_GT(errors.count, 300);
  EXPECT_LT(errors.worst_m, 0.01);
  EXPECT_EQ(site.listeners[0].undecodable, 0);
}

using RangeKey = std::tuple<std::uint32_t, std::uint32_t, std::uint32_t>;  // superframe, tag, anchor

std::map<RangeKey, double> ranges_of(const SiteBench& site) {
  std::map<RangeKey, double> ranges;
  site.each_range([&](const groma_SlotReport& report, const groma_Range& range) {
    if (range.status == groma_RangeStatus_RANGE_OK)
      ranges[{report.superframe, report.tag_id, range.anchor_id}] = static_cast<double>(range.range_m);
  });
  return ranges;
}

TEST_F(ShippedImage, AgreesWithTheNativeNodes) {
  const SiteSettings settings{.tags = 2, .anchors = 4, .medium = kNoise};
  SiteBench native(settings);
  SiteBench emulation(emulating(settings));
  native.run_until(4.0);
  emulation.run_until(4.0);
  const auto expected = ranges_of(native);
  const auto seen = ranges_of(emulation);
  int common = 0;
  double squares = 0.0;
  for (const auto& [key, range_m] : seen) {
    const auto other = expected.find(key);
    if (other == expected.end()) continue;
    ++common;
    squares += (range_m - other->second) * (range_m - other->second);
  }
  const double rms_m = std::sqrt(squares / std::max(common, 1));
  RecordProperty("common_ranges", common);
  RecordProperty("rms_um", static_cast<int>(rms_m * 1e6));
  std::cout << "native and emulated: " << expected.size() << " and " << seen.size() << " ranges, " << common
            << " in common, " << rms_m * 1e3 << " mm rms apart\n";
  EXPECT_GT(common, static_cast<int>(expected.size() * 9 / 10));
  EXPECT_LT(rms_m, 0.02);
  EXPECT_NEAR(static_cast<double>(seen.size()), static_cast<double>(expected.size()),
              0.05 * static_cast<double>(expected.size()));
}

TEST_F(ShippedImage, SendsTheSameBytesForTheSameSeedWithAnyQuantumAndThreads) {
  const SiteSettings settings{.tags = 1, .anchors = 3, .medium = kNoise};
  const auto traces = [&](SimTime quantum_us, std::uint64_t seed, unsigned threads = 1) {
    SiteSettings seeded = settings;
    seeded.seed = seed;
    SiteBench site(emulating(seeded, {.quantum = quantum_us * kUnitsPerMicrosecond}));
    site.network.set_threads(threads);
    site.run_until(1.0);
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.request_id = 3;
    command.which_body = groma_HostToNode_read_config_tag;
    EXPECT_TRUE(site.network.send(0, frame_of(command)));
    site.run_until(2.0);
    EXPECT_GT(site.good_ranges(), 50);
    EXPECT_EQ(site.listeners[0].replies.size(), 1U);
    return site.line_traces();
  };
  const auto reference = traces(40, 1);
  EXPECT_EQ(traces(40, 1), reference);
  for (const SimTime quantum_us : {1, 13, 50}) EXPECT_EQ(traces(quantum_us, 1), reference) << quantum_us;
  EXPECT_EQ(traces(40, 1, 2), reference);
  EXPECT_NE(traces(40, 2), reference);
}

TEST_F(ShippedImage, RunsAheadByNoMoreThanTheHostsDelay) {
  FreeSpace space;
  Network network(space, {}, 1);
  EXPECT_THROW(
      (void)make_emulated_node({}, shipped(), network.medium(), {.quantum = 51 * kUnitsPerMicrosecond}),
      SimulationError);
}

// ---- faults ---------------------------------------------------------------------------------------------

TEST_F(ShippedImage, ReportsTheProgramCounterOfABadAddress) {
  LoneNode site;
  site.run_until(1.5);
  // An address without code.
  site.node().cpu().set_register(Register::kPc, 0x00300000);
  site.run_until(3.0);
  ASSERT_EQ(site.listener.hellos.size(), 2U);
  const groma_Hello& hello = site.listener.hellos[1];
  EXPECT_EQ(hello.reset_reason, groma_ResetReason_RESET_FAULT);
  ASSERT_TRUE(hello.has_last_fault);
  EXPECT_EQ(hello.last_fault.pc, 0x00300000U);
  EXPECT_NE(hello.last_fault.cfsr, 0U);
  // The node works again.
  EXPECT_STREQ(hello.radio_error, "");
  site.send(1, groma_HostToNode_get_hello_tag);
  site.run_until(3.5);
  EXPECT_EQ(site.listener.replies.size(), 1U);
}

TEST_F(ShippedImage, ReportsAStackOverflow) {
  LoneNode site;
  site.run_until(1.5);
  site.node().cpu().set_register(Register::kSp, kRamAddress + 16);
  site.run_until(3.0);
  ASSERT_EQ(site.listener.hellos.size(), 2U);
  EXPECT_EQ(site.listener.hellos[1].reset_reason, groma_ResetReason_RESET_FAULT);
  ASSERT_TRUE(site.listener.hellos[1].has_last_fault);
  EXPECT_NE(site.listener.hellos[1].last_fault.cfsr, 0U);
}

TEST_F(ShippedImage, IsResetByTheWatchdogWhenStuck) {
  LoneNode site;
  site.run_until(1.5);
  // An endless loop where the image leaves flash blank: 200 NOPs and a branch back.
  constexpr std::uint32_t kLoop = 0x60000;
  constexpr std::uint32_t kLoopEnd = kLoop + 400;
  EmulatedNode& node = site.node();
  for (std::uint32_t at = kLoop; at < kLoopEnd; at += 2) {
    node.flash()[at] = 0x00;  // NOP
    node.flash()[at + 1] = 0xBF;
  }
  node.flash()[kLoopEnd] = 0x36;  // B kLoop
  node.flash()[kLoopEnd + 1] = 0xE7;
  node.cpu().flash_changed(kLoop, kLoopEnd + 2 - kLoop);
  node.cpu().set_register(Register::kPc, kLoop);
  // It slept with its interrupts masked.
  node.cpu().set_register(Register::kPrimask, 0);
  site.run_until(4.0);
  EXPECT_EQ(site.listener.hellos.size(), 1U);
  site.run_until(11.0);
  ASSERT_EQ(site.listener.hellos.size(), 2U);
  const groma_Hello& hello = site.listener.hellos[1];
  EXPECT_EQ(hello.reset_reason, groma_ResetReason_RESET_WATCHDOG);
  ASSERT_TRUE(hello.has_last_fault);
  EXPECT_GE(hello.last_fault.pc, kLoop);
  EXPECT_LE(hello.last_fault.pc, kLoopEnd);
}

TEST_F(ShippedImage, ReportsItsResetPin) {
  LoneNode site;
  site.run_until(1.0);
  site.node().press_reset(site.network.now());
  site.run_until(2.0);
  ASSERT_EQ(site.listener.hellos.size(), 2U);
  EXPECT_EQ(site.listener.hellos[1].reset_reason, groma_ResetReason_RESET_PIN);
}

TEST_F(ShippedImage, LosesItsRamInAPowerCut) {
  LoneNode site;
  site.run_until(1.0);
  site.network.set_power(0, false);
  site.run_until(1.2);
  EXPECT_EQ(site.node().next_work(), kNever);
  site.network.set_power(0, true);
  site.run_until(2.2);
  ASSERT_EQ(site.listener.hellos.size(), 2U);
  EXPECT_EQ(site.listener.hellos[1].reset_reason, groma_ResetReason_RESET_POWER_ON);
  EXPECT_FALSE(site.listener.hellos[1].has_last_fault);
  EXPECT_NEAR(site.node().usage(site.network.now()).powered_s, 2.0, 0.01);
}

}  // namespace
}  // namespace groma::sim
