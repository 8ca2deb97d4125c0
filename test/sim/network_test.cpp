// Whole sites of native nodes: the unmodified firmware on the chip model and the medium.
#include "firmware/sim/network.hpp"

#include <gtest/gtest.h>
#include <pb_encode.h>

#include <algorithm>
#include <cmath>
#include <set>
#include <utility>

#include "test/sim/site_bench.hpp"

namespace groma::sim {
namespace {

constexpr double kSynchronized_s = 0.6;  // by then each node is synchronized and each pair has ranged

void expect_sound(SiteBench& site) {
  for (std::size_t i = 0; i < site.network.size(); ++i) {
    Dw1000Chip& chip = site.network.node(i).chip();
    EXPECT_EQ(chip.late_announcements(), 0U) << chip.id();
    EXPECT_EQ(chip.garbled_transfers(), 0U) << chip.id();
    EXPECT_EQ(site.listeners[i].undecodable, 0) << chip.id();
    EXPECT_EQ(site.listeners[i].counters.radio_recoveries, 0U) << chip.id();
    EXPECT_EQ(site.listeners[i].counters.late_transmits, 0U) << chip.id();
    EXPECT_EQ(site.listeners[i].counters.late_receives, 0U) << chip.id();
    EXPECT_EQ(site.network.node(i).uart_out().overflow_bytes(), 0U) << chip.id();
  }
}

struct Errors {
  int good = 0;
  int missing = 0;
  double worst_m = 0.0;
  double mean_m = 0.0;
};

Errors errors_of(const SiteBench& site, double from_s = kSynchronized_s) {
  Errors errors;
  double sum = 0.0;
  site.each_range(
      [&](const groma_SlotReport& report, const groma_Range& range) {
        if (range.status != groma_RangeStatus_RANGE_OK) {
          ++errors.missing;
          return;
        }
        const double truth = site.space.distance_m(static_cast<std::uint16_t>(report.tag_id),
                                                   static_cast<std::uint16_t>(range.anchor_id));
        const double error = static_cast<double>(range.range_m) - truth;
        ++errors.good;
        sum += error;
        errors.worst_m = std::max(errors.worst_m, std::abs(error));
      },
      from_s);
  errors.mean_m = errors.good > 0 ? sum / errors.good : 0.0;
  return errors;
}

// Ranges per second by the schedule.
double scheduled_rate(const SiteBench& site, const SiteSettings& settings) {
  const double superframe_s = seconds_of(site.superframe());
  return settings.tags * settings.anchors / superframe_s;
}

// ---- a small site ---------------------------------------------------------------------------------

TEST(SmallSite, StartsAndStaysSynchronized) {
  SiteBench site({});
  site.run_until(3.0);
  expect_sound(site);
  for (std::size_t i = 0; i < site.network.size(); ++i) {
    const Listener& node = site.listeners[i];
    ASSERT_EQ(node.hellos.size(), 1U);
    EXPECT_STREQ(node.hellos[0].radio_error, "");
    EXPECT_EQ(node.hellos[0].id, site.network.node(i).chip().id());
    EXPECT_EQ(node.hellos[0].reset_reason, groma_ResetReason_RESET_POWER_ON);
    EXPECT_EQ(node.hellos[0].schedule_hash, site.listeners[0].hellos[0].schedule_hash);
    EXPECT_EQ(node.status.state, groma_SyncState_SYNC_LOCKED);
    EXPECT_EQ(node.status.beacons_missed, 0U);
  }
}

TEST(SmallSite, TheSkewIsTheClocksDifference) {
  SiteBench site({});
  site.run_until(3.0);
  const double master_ppm = site.network.node(1).chip().clock().offset(0) * 1e6;
  for (std::size_t i = 0; i < site.network.size(); ++i) {
    const double own_ppm = site.network.node(i).chip().clock().offset(0) * 1e6;
    EXPECT_NEAR(site.listeners[i].status.skew_ppb, (master_ppm - own_ppm) * 1e3, 30.0);
  }
}

TEST(SmallSite, ReportsPowersAndTheAnchorsClockOffset) {
  SiteBench site({});
  site.run_until(2.0);
  const double tag_ppm = site.network.node(0).chip().clock().offset(0) * 1e6;
  int seen = 0;
  site.each_range(
      [&](const groma_SlotReport&, const groma_Range& range) {
        const auto anchor = static_cast<std::uint16_t>(range.anchor_id);
        const double anchor_ppm =
            site.network.node(1U + (anchor - nth_anchor(0))).chip().clock().offset(0) * 1e6;
        const Propagation path = site.space.between(1, anchor, 0.0);
        ASSERT_TRUE(range.has_first_path_power_cdbm && range.has_receive_power_cdbm &&
                    range.has_clock_offset_ppb);
        EXPECT_NEAR(range.clock_offset_ppb, (anchor_ppm - tag_ppm) * 1e3, 10.0);
        EXPECT_NEAR(range.receive_power_cdbm, path.receive_power_dbm * 100.0, 20.0);
        EXPECT_NEAR(range.first_path_power_cdbm, path.first_path_power_dbm * 100.0, 20.0);
        ++seen;
      },
      kSynchronized_s);
  EXPECT_GT(seen, 100);
}

TEST(SmallSite, EachRangeHasTheInstantOfItsExchange) {
  SiteBench site({});
  site.run_until(2.0);
  for (const Listener::Report& report : site.listeners[0].reports) {
    std::set<std::int64_t> instants;
    std::size_t good = 0;
    for (pb_size_t k = 0; k < report.body.ranges_count; ++k) {
      const groma_Range& range = report.body.ranges[k];
      if (range.status != groma_RangeStatus_RANGE_OK) continue;
      EXPECT_LT(range.instant_offset_dtu, 0);
      EXPECT_GT(range.instant_offset_dtu, -2 * site.superframe().duration().count());
      instants.insert(range.instant_offset_dtu);
      ++good;
    }
    EXPECT_EQ(instants.size(), good) << "each range has its own instant";
  }
}

TEST(SmallSite, DeviceTimeFollowsTheTagsClockOverTheWrap) {
  SiteBench site({});
  site.run_until(40.0);
  const auto& reports = site.listeners[0].reports;
  ASSERT_GT(reports.size(), 1000U);
  const double rate = 63.8976e9 * (1.0 + site.network.node(0).chip().clock().offset(0));
  for (const Listener::Report& report : reports) {
    const double device_s =
        static_cast<double>(report.body.device_time_dtu - reports.front().body.device_time_dtu) / rate;
    ASSERT_NEAR(device_s, to_seconds(report.t - reports.front().t), 0.002);
  }
  EXPECT_GT(errors_of(site).good, 28'000);
  EXPECT_LT(errors_of(site).worst_m, 0.01);
  EXPECT_EQ(errors_of(site).missing, 0);
}

// Fewest and most symbols of a preamble that the tag's receiver accumulated, without those of the SFD.
std::pair<int, int> symbols_at_tag(SiteBench& site) {
  constexpr int kOfTheSfd = 5;
  constexpr int kOverwritten = 0xA5A;
  std::pair<int, int> symbols{1'000, 0};
  site.run_until(kSynchronized_s);
  for (int i = 1; i <= 100; ++i) {
    site.run_until(kSynchronized_s + 0.0037 * i);
    const auto count = static_cast<int>(site.network.node(0).chip().register_value(Reg::kRxFinfo) >> 20);
    if (count == kOverwritten) continue;
    symbols.first = std::min(symbols.first, count - kOfTheSfd);
    symbols.second = std::max(symbols.second, count - kOfTheSfd);
  }
  return symbols;
}

// User manual 7.2.15: 16 us from a receiver's start to its hunt for preambles.
TEST(SmallSite, AReceiverHearsEachPreambleFromItsBeginAlsoWithAShortGuard) {
  SiteBench site({.guard_us = 5});
  EXPECT_GT(symbols_at_tag(site).first, 113);
  expect_sound(site);
}

// ---- ranges without noise -------------------------------------------------------------------------

struct Variant {
  const char* name;
  SiteSettings settings;
};

class NoiseFree : public testing::TestWithParam<Variant> {};

TEST_P(NoiseFree, RangesAreTrueAndAtTheScheduledRate) {
  const SiteSettings& settings = GetParam().settings;
  SiteBench site(settings);
  site.run_until(kSynchronized_s + 2.0);
  expect_sound(site);
  const Errors errors = errors_of(site);
  EXPECT_EQ(errors.missing, 0);
  EXPECT_LT(errors.worst_m, 0.01);
  EXPECT_LT(std::abs(errors.mean_m), 0.003);
  EXPECT_NEAR(errors.good, 2.0 * scheduled_rate(site, settings), settings.tags * settings.anchors + 0.0);
}

INSTANTIATE_TEST_SUITE_P(
    Sites, NoiseFree,
    testing::Values(
        Variant{"one_tag_three_anchors", {}}, Variant{"no_clock_offset", {.spread_ppm = 0.0}},
        Variant{"three_tags_twelve_anchors", {.tags = 3, .anchors = 12}},
        Variant{"sixteen_anchors", {.tags = 2, .anchors = 16}},
        Variant{"preamble_64", {.tags = 2, .anchors = 6, .preamble = groma_Preamble_PREAMBLE_64}},
        Variant{"preamble_256", {.tags = 2, .anchors = 6, .preamble = groma_Preamble_PREAMBLE_256}},
        Variant{"next_poll", {.tags = 1, .anchors = 4, .method = groma_RangingMethod_METHOD_DS_NEXT_POLL}}),
    [](const auto& test) { return std::string(test.param.name); });

// ---- noise ----------------------------------------------------------------------------------------

// tof = (Ra Rb - Da Db) / (Ra + Rb + Da + Db), with independent noise on each of the three receive
// timestamps.
TEST(NoisyTimestamps, SpreadRangesAsInTheClosedForm) {
  SiteBench site({.tags = 1, .anchors = 6, .medium = {.timestamp_noise_s = 1e-10}});
  site.run_until(12.0);
  double squares = 0.0;
  int count = 0;
  site.each_range(
      [&](const groma_SlotReport& report, const groma_Range& range) {
        if (range.status != groma_RangeStatus_RANGE_OK) return;
        ASSERT_TRUE(range.has_raw);
        const auto ra = static_cast<double>(range.raw.tag_round_dtu);
        const auto db = static_cast<double>(range.raw.anchor_reply_dtu);
        const auto rb = static_cast<double>(range.raw.anchor_round_dtu);
        const auto da = static_cast<double>(range.raw.tag_reply_dtu);
        const double sum = ra + rb + da + db;
        const double poll = da / sum;
        const double response = (rb + db) / sum;
        const double closing = ra / sum;
        const double timestamp_sigma_m = std::hypot(1e-10, 15.65e-12 / std::sqrt(12.0)) * 299'792'458.0;
        const double sigma_m =
            timestamp_sigma_m * std::sqrt(poll * poll + response * response + closing * closing);
        const double truth = site.space.distance_m(static_cast<std::uint16_t>(report.tag_id),
                                                   static_cast<std::uint16_t>(range.anchor_id));
        const double normalized = (static_cast<double>(range.range_m) - truth) / sigma_m;
        EXPECT_LT(std::abs(normalized), 6.0);
        squares += normalized * normalized;
        ++count;
      },
      kSynchronized_s);
  ASSERT_GT(count, 5000);
  EXPECT_NEAR(squares / count, 1.0, 4.0 * std::sqrt(2.0 / count) + 0.02);
}

// ---- faults ---------------------------------------------------------------------------------------

TEST(Faults, LostFramesCostRangesAndNothingElse) {
  const SiteSettings settings{
      .tags = 3,
      .anchors = 12,
      .medium = {.timestamp_noise_s = 0.0, .carrier_noise_ppm = 0.0, .loss_probability = 0.02}};
  SiteBench site(settings);
  site.run_until(kSynchronized_s + 10.0);
  const Errors errors = errors_of(site);
  EXPECT_LT(errors.worst_m, 0.01) << "a lost frame never gives a wrong range";
  const double share = errors.good / (10.0 * scheduled_rate(site, settings));
  // POLL, RESPONSE, FINAL, then the next POLL and RESPONSE that return the closing timestamp.
  const double product = std::pow(0.98, 5);
  EXPECT_GT(share, 0.9 * product);
  EXPECT_LT(share, 1.02 * product);
  for (const Listener& node : site.listeners) {
    EXPECT_EQ(node.counters.radio_recoveries, 0U);
    EXPECT_EQ(node.counters.bad_stamps, 0U);
  }
  // Each kind of failure occurred.
  EXPECT_GT(site.listeners[0].counters.crc_errors, 0U);
  EXPECT_GT(site.listeners[0].counters.header_errors, 0U);
  EXPECT_GT(site.listeners[0].counters.sfd_timeouts, 0U);
}

TEST(Faults, TheSiteRecoversFromThirtyPercentLoss) {
  const SiteSettings settings{
      .tags = 2,
      .anchors = 6,
      .medium = {.timestamp_noise_s = 0.0, .carrier_noise_ppm = 0.0, .loss_probability = 0.3}};
  SiteBench site(settings);
  site.run_until(10.0);
  EXPECT_LT(errors_of(site).worst_m, 0.01);
  EXPECT_GT(errors_of(site).good, 100);
  MediumSettings clear = settings.medium;
  clear.loss_probability = 0.0;
  site.network.medium().set_settings(clear);
  site.run_until(14.0);
  EXPECT_NEAR(site.good_ranges(12.0), 2.0 * scheduled_rate(site, settings), 24.0);
}

TEST(Faults, ADeadAnchorCostsItsOwnRangesOnly) {
  const SiteSettings settings{.tags = 2, .anchors = 6};
  SiteBench site(settings);
  site.run_until(2.0);
  site.network.set_power(2 + 3, false);
  site.run_until(4.0);
  int others = 0;
  site.each_range(
      [&](const groma_SlotReport&, const groma_Range& range) {
        if (range.anchor_id == nth_anchor(3)) {
          EXPECT_NE(range.status, groma_RangeStatus_RANGE_OK);
        } else if (range.status == groma_RangeStatus_RANGE_OK) {
          ++others;
        }
      },
      2.5);
  EXPECT_NEAR(others, 1.5 * scheduled_rate(site, settings) * 5.0 / 6.0, 12.0);
  site.network.set_power(2 + 3, true);
  site.run_until(6.0);
  EXPECT_NEAR(site.good_ranges(5.0), scheduled_rate(site, settings), 12.0);
  EXPECT_LT(errors_of(site).worst_m, 0.01);
}

TEST(Faults, ADeadMasterSilencesTheSiteUntilItReturns) {
  const SiteSettings settings{.tags = 1, .anchors = 4};
  SiteBench site(settings);
  site.run_until(2.0);
  site.network.set_power(1, false);
  site.run_until(5.0);
  EXPECT_EQ(site.listeners[0].status.state, groma_SyncState_SYNC_SEARCHING);
  site.network.set_power(1, true);
  site.run_until(8.0);
  EXPECT_NEAR(site.good_ranges(7.0), scheduled_rate(site, settings), 8.0);
  EXPECT_LT(errors_of(site).worst_m, 0.01);
}

TEST(Faults, ARebootedTagResumesRanging) {
  const SiteSettings settings{.tags = 2, .anchors = 4};
  SiteBench site(settings);
  site.run_until(2.0);
  groma_HostToNode command = groma_HostToNode_init_zero;
  command.request_id = 77;
  command.which_body = groma_HostToNode_reboot_tag;
  ASSERT_TRUE(site.network.send(0, frame_of(command)));
  site.run_until(4.0);
  ASSERT_EQ(site.listeners[0].hellos.size(), 2U);
  EXPECT_EQ(site.listeners[0].hellos[1].reset_reason, groma_ResetReason_RESET_SOFTWARE);
  EXPECT_EQ(site.listeners[0].hellos[0].boot_count, 1U);
  EXPECT_EQ(site.listeners[0].hellos[1].boot_count, 2U);
  ASSERT_EQ(site.listeners[0].replies.size(), 1U);
  EXPECT_EQ(site.listeners[0].replies[0].request_id, 77U);
  EXPECT_NEAR(site.good_ranges(3.0), scheduled_rate(site, settings), 8.0);
  EXPECT_LT(errors_of(site).worst_m, 0.01);
}

TEST(Faults, AConfigurationWrittenOverTheLinkIsKept) {
  SiteBench site({.tags = 2, .anchors = 4});
  site.run_until(1.0);
  groma_HostToNode command = groma_HostToNode_init_zero;
  command.request_id = 1;
  command.which_body = groma_HostToNode_write_config_tag;
  command.body.write_config = site.config_of(nth_tag(0), groma_Role_ROLE_TAG);
  command.body.write_config.report_raw_stamps = false;
  ASSERT_TRUE(site.network.send(0, frame_of(command)));
  site.run_until(1.5);
  command.request_id = 2;
  command.which_body = groma_HostToNode_apply_config_tag;
  ASSERT_TRUE(site.network.send(0, frame_of(command)));
  site.run_until(4.0);
  ASSERT_EQ(site.listeners[0].replies.size(), 2U);
  EXPECT_EQ(site.listeners[0].replies[1].result, groma_Result_RESULT_OK);
  EXPECT_FALSE(site.listeners[0].reports.back().body.ranges[0].has_raw);
  EXPECT_TRUE(site.listeners[1].reports.back().body.ranges[0].has_raw);
}

// Writes often enough that pages fill up and are erased: each erase takes the node off the air for 90 ms.
TEST(Faults, WritingFlashKeepsAllNodesSynchronized) {
  for (const std::size_t writer : {0U, 1U, 2U}) {  // the tag, the master, another anchor
    const SiteSettings settings{.tags = 1, .anchors = 3};
    SiteBench site(settings);
    site.run_until(1.0);
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.which_body = groma_HostToNode_write_config_tag;
    command.body.write_config =
        writer == 0 ? site.config_of(nth_tag(0), groma_Role_ROLE_TAG)
                    : site.config_of(static_cast<std::uint16_t>(100 + writer), groma_Role_ROLE_ANCHOR);
    constexpr std::uint32_t kWrites = 80;
    for (std::uint32_t i = 0; i < kWrites; ++i) {
      command.request_id = i;
      command.body.write_config.transmit_antenna_delay_dtu = 16'000 + i;
      ASSERT_TRUE(site.network.send(writer, frame_of(command)));
      site.run_until(1.0 + 0.15 * (i + 1));
    }
    const double end_s = 1.0 + 0.15 * kWrites;
    site.run_until(end_s + 1.2);
    ASSERT_EQ(site.listeners[writer].replies.size(), kWrites);
    for (const groma_Reply& reply : site.listeners[writer].replies) {
      EXPECT_EQ(reply.result, groma_Result_RESULT_OK);
      EXPECT_EQ(reply.config.transmit_antenna_delay_dtu, 16'000 + reply.request_id);
    }
    const auto& logs = site.listeners[writer].logs;
    EXPECT_EQ(std::count(logs.begin(), logs.end(), "off the air to write flash"), kWrites);
    for (std::size_t i = 0; i < site.network.size(); ++i) {
      const auto& node_logs = site.listeners[i].logs;
      EXPECT_EQ(std::count(node_logs.begin(), node_logs.end(), "beacons lost, searching"), 0)
          << writer << ' ' << i;
      EXPECT_EQ(site.listeners[i].status.state, groma_SyncState_SYNC_LOCKED);
      EXPECT_EQ(site.listeners[i].counters.radio_recoveries, 0U);
    }
    // As many superframes as without the writes, so no session restarted.
    EXPECT_NEAR(site.listeners[0].status.superframe,
                end_s / to_seconds(site.superframe().duration().count() * kUnitsPerTick),
                1.2 / to_seconds(site.superframe().duration().count() * kUnitsPerTick));
    EXPECT_GT(site.good_ranges(end_s), 0.95 * scheduled_rate(site, settings));
    EXPECT_LT(errors_of(site).worst_m, 0.01);
  }
}

// Erratum SYSSTAT-1, far more often than a chip shows it.
TEST(Faults, FalsePllFlagsAreCountedAndCostNothing) {
  const SiteSettings settings{.equip = [](ChipSpec& chip) { chip.quirks.false_pll_flags_per_minute = 60.0; }};
  SiteBench site(settings);
  site.run_until(kSynchronized_s + 10.0);
  expect_sound(site);
  for (const Listener& node : site.listeners) EXPECT_NEAR(node.counters.pll_flags, 10, 9);
  EXPECT_GT(errors_of(site).good, 0.99 * 10.0 * scheduled_rate(site, settings));
}

// As the firmware that came with the module may leave it. The reset line does not wake the chip.
TEST(Faults, ARadioThatSleepsIsWoken) {
  const SiteSettings settings{.equip = [](ChipSpec& chip) { chip.quirks.asleep = chip.id == nth_tag(0); }};
  SiteBench site(settings);
  site.run_until(kSynchronized_s + 2.0);
  expect_sound(site);
  const Listener& woken = site.listeners[0];
  EXPECT_STREQ(woken.hellos.at(0).radio_error, "");
  EXPECT_EQ(std::count(woken.logs.begin(), woken.logs.end(), "radio: woken from sleep"), 1);
  EXPECT_GT(errors_of(site).good, 0.99 * 2.0 * scheduled_rate(site, settings));
}

int times_logged(const Listener& node, const char* text) {
  return static_cast<int>(std::count(node.logs.begin(), node.logs.end(), text));
}

// All nodes are synchronized and have been since they joined.
void expect_nobody_searched(const SiteBench& site) {
  for (const Listener& node : site.listeners) {
    EXPECT_EQ(times_logged(node, "beacons lost, searching"), 0);
    EXPECT_EQ(node.status.state, groma_SyncState_SYNC_LOCKED);
  }
}

TEST(Faults, ALostEventCostsSomeSuperframes) {
  for (const std::size_t node : {0U, 1U, 2U}) {  // the tag, the master, another anchor
    const SiteSettings settings{};
    SiteBench site(settings);
    site.run_until(1.5);
    site.network.node(node).chip().lose_next_event();
    site.run_until(3.1);
    EXPECT_EQ(site.listeners[node].counters.radio_recoveries, 1U);
    EXPECT_EQ(times_logged(site.listeners[node], "radio: no answer, started again"), 1);
    expect_nobody_searched(site);
    EXPECT_GT(errors_of(site, 1.5).good, (1.6 - 0.04) * scheduled_rate(site, settings));
    EXPECT_LT(errors_of(site).worst_m, 0.01);
  }
}

// With its counter. In this method an exchange lasts from one superframe to the next; none may span the
// reset.
TEST(Faults, AChipThatResetsItselfIsBroughtUpInItsPlace) {
  for (const std::size_t node : {0U, 1U, 2U}) {
    const SiteSettings settings{.method = groma_RangingMethod_METHOD_DS_NEXT_POLL};
    SiteBench site(settings);
    site.run_until(3.5);
    site.network.node(node).chip().reset(site.network.now());
    site.run_until(5.6);
    EXPECT_EQ(site.listeners[node].counters.radio_recoveries, 1U);
    EXPECT_EQ(times_logged(site.listeners[node], "radio: no answer, brought up again"), 1);
    expect_nobody_searched(site);
    EXPECT_GT(errors_of(site, 3.5).good, (2.1 - 0.08) * scheduled_rate(site, settings));
    EXPECT_LT(errors_of(site).worst_m, 0.01);
  }
}

TEST(Faults, AFullLineDropsWholeReportsAndCountsThem) {
  // 20 kbit/s is far too slow for this many reports.
  SiteBench site({.tags = 1, .anchors = 12, .uart_bits_per_s = 20'000});
  site.run_until(6.0);
  const UartLine& line = site.network.node(0).uart_out();
  EXPECT_GT(line.overflow_writes(), 100U);
  EXPECT_EQ(site.listeners[0].undecodable, 0);
  EXPECT_GT(site.listeners[0].counters.reports_dropped, 0U);
  // Sequence numbers show the gap.
  const auto& reports = site.listeners[0].reports;
  ASSERT_GT(reports.size(), 3U);
  EXPECT_GT(reports.back().body.sequence, reports.front().body.sequence + reports.size() - 1);
}

// ---- determinism ----------------------------------------------------------------------------------

TEST(Determinism, TheNumberOfThreadsChangesNothing) {
  const auto trace = [&](unsigned threads) {
    SiteBench site({.tags = 3, .anchors = 12, .medium = {.loss_probability = 0.02}});
    site.network.set_threads(threads);
    site.run_until(1.0);
    // A power cut, perhaps within a frame.
    site.network.set_power(4, false);
    site.run_until(1.3);
    site.network.set_power(4, true);
    site.run_until(2.0);
    EXPECT_GT(site.good_ranges(), 500);
    for (std::size_t i = 0; i < site.network.size(); ++i)
      EXPECT_EQ(site.network.node(i).chip().late_announcements(), 0U) << i;
    return site.line_traces();
  };
  const auto reference = trace(1);
  EXPECT_EQ(trace(2), reference);
  EXPECT_EQ(trace(3), reference);
}

TEST(Determinism, OneSeedGivesOneTraceForAnySteps) {
  SiteSettings settings{.tags = 2, .anchors = 5, .medium = {.loss_probability = 0.02}};
  const auto trace = [&](double step_s) {
    SiteBench site(settings);
    std::uint64_t bytes = 0;
    for (double t_s = step_s; t_s < 2.0 + step_s / 2; t_s += step_s) site.run_until(std::min(t_s, 2.0));
    site.run_until(2.0);
    for (std::size_t i = 0; i < site.network.size(); ++i)
      bytes = bytes * 31 + site.network.node(i).uart_out().accepted_bytes();
    return std::pair{site.line_traces(), bytes};
  };
  const auto whole = trace(2.0);
  EXPECT_EQ(whole, trace(2.0));
  EXPECT_EQ(whole, trace(0.0137));
  settings.seed = 2;
  EXPECT_NE(whole, trace(2.0));
}

// A node's speed changes no timestamp: the same frames carry the same noise.
TEST(Determinism, TheBusSpeedChangesNoRange) {
  const auto ranges = [](double transaction_us) {
    SiteBench site({.tags = 1,
                    .anchors = 4,
                    .medium = {.timestamp_noise_s = 1e-10},
                    .spi_transaction_us = transaction_us});
    site.run_until(2.0);
    std::map<std::pair<std::uint32_t, std::uint32_t>, float> out;
    site.each_range([&](const groma_SlotReport& report, const groma_Range& range) {
      if (range.status == groma_RangeStatus_RANGE_OK)
        out[{report.superframe, range.anchor_id}] = range.range_m;
    });
    return out;
  };
  const auto slow = ranges(2.5);
  const auto fast = ranges(1.5);
  ASSERT_GT(slow.size(), 500U);
  double squares = 0.0;
  int shared = 0;
  for (const auto& [key, range_m] : slow) {
    const auto other = fast.find(key);
    if (other == fast.end()) continue;
    squares += std::pow(static_cast<double>(range_m - other->second), 2);
    ++shared;
  }
  ASSERT_GT(shared, 500);
  // Independent noise would be 3 cm and more; the tick's rounding is some millimetres.
  EXPECT_LT(std::sqrt(squares / shared), 0.02);
}

TEST(Faults, DriftRampsBiasNoRange) {
  SiteBench site({.tags = 2, .anchors = 5, .drift_ppm_per_s = 1.0});
  site.run_until(12.0);
  const Errors errors = errors_of(site, 1.0);
  EXPECT_GT(errors.good, 1000);
  EXPECT_LT(errors.worst_m, 0.01);
  EXPECT_EQ(errors.missing, 0);
}

}  // namespace
}  // namespace groma::sim
