// All that is reported with a range is true: its distance, spread, time and corrections.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <string>

#include "firmware/core/ranging/twr.hpp"
#include "test/sim/site_bench.hpp"

namespace groma::sim {
namespace {

constexpr double kSpeedOfLight_mps = 299'792'458.0;
constexpr double kTicksPerSecond = 63.8976e9;
constexpr double kMetresPerTick = kSpeedOfLight_mps / kTicksPerSecond;
constexpr double kRanging_s = 0.6;  // by then each node is synchronized and each pair has ranged

bool ok(const groma_Range& range) {
  return range.status == groma_RangeStatus_RANGE_OK;
}

// All anchors at the same distance from the tag, side by side, so that they hear each other.
void put_around(SiteBench& site, int anchors, double distance_m) {
  const Place tag{0.0, 0.0, 1.0};
  site.space.put(nth_tag(0), tag);
  for (int i = 0; i < anchors; ++i) {
    const double angle = 0.01 * i;
    site.space.put(nth_anchor(i),
                   {tag.x_m + distance_m * std::cos(angle), tag.y_m + distance_m * std::sin(angle), tag.z_m});
  }
}

double error_m(const SiteBench& site, const groma_SlotReport& report, const groma_Range& range) {
  return static_cast<double>(range.range_m) -
         site.space.distance_m(static_cast<std::uint16_t>(report.tag_id), range.anchor_id);
}

// The single-sided range of the exchange, with the anchor's clock rate from the carrier offset.
double single_sided_error_m(const SiteBench& site, const groma_SlotReport& report, const groma_Range& range) {
  const auto flight =
      ranging::single_sided(ranging::Ticks(range.raw.tag_round_dtu),
                            ranging::Ticks(range.raw.anchor_reply_dtu), range.clock_offset_ppb);
  return static_cast<double>(flight.value().distance_m()) -
         site.space.distance_m(static_cast<std::uint16_t>(report.tag_id), range.anchor_id);
}

// ---- absolute error -------------------------------------------------------------------------------

struct Accuracy {
  const char* name;
  groma_RangingMethod method;
  int anchors;
  double tag_ppm;
  double anchor_ppm;
};

class AbsoluteError : public testing::TestWithParam<Accuracy> {};

// One site; its anchors are moved further and further away.
TEST_P(AbsoluteError, IsAtMostACentimetreFrom1To100MetresForTheFirstAndTheLastResponder) {
  const Accuracy& p = GetParam();
  SiteBench site({.tags = 1, .anchors = p.anchors, .method = p.method, .equip = [&](ChipSpec& chip) {
                    chip.clock.offset_ppm = chip.id < 100 ? p.tag_ppm : p.anchor_ppm;
                  }});
  put_around(site, p.anchors, 1.0);
  double t_s = kRanging_s;
  site.run_until(t_s);
  for (const double distance_m : {1.0, 2.5, 7.0, 20.0, 50.0, 100.0}) {
    put_around(site, p.anchors, distance_m);
    // An exchange under way sees both distances; a report comes a superframe after its ranges.
    site.run_until(t_s + 0.25);
    std::map<int, int> count;
    double worst_m = 0.0;
    site.each_range(
        [&](const groma_SlotReport& report, const groma_Range& range) {
          ASSERT_TRUE(ok(range)) << range.status;
          const int responder = range.anchor_id - nth_anchor(0);
          const double error = error_m(site, report, range);
          EXPECT_LE(std::abs(error), 0.01) << distance_m << " m, responder " << responder;
          EXPECT_LE(std::abs(single_sided_error_m(site, report, range)), 0.01)
              << distance_m << " m, responder " << responder;
          EXPECT_EQ(
              ranging::double_sided(
                  {.tag_round = ranging::Ticks(range.raw.tag_round_dtu),
                   .anchor_reply = ranging::Ticks(range.raw.anchor_reply_dtu),
                   .anchor_round = ranging::Ticks(static_cast<std::int64_t>(range.raw.anchor_round_dtu)),
                   .tag_reply = ranging::Ticks(static_cast<std::int64_t>(range.raw.tag_reply_dtu))})
                  .value()
                  .distance_m(),
              range.range_m);
          EXPECT_TRUE(range.flags & groma_RangeFlag_RANGE_FLAG_ANTENNA_DELAYS);
          worst_m = std::max(worst_m, std::abs(error));
          ++count[responder];
        },
        t_s + 0.15);
    EXPECT_GE(count[0], 1);
    EXPECT_GE(count[p.anchors - 1], 1);
    EXPECT_EQ(count.size(), static_cast<std::size_t>(p.anchors));
    t_s += 0.25;
  }
}

constexpr auto kFinal = groma_RangingMethod_METHOD_DS_FINAL;
constexpr auto kNextPoll = groma_RangingMethod_METHOD_DS_NEXT_POLL;

INSTANTIATE_TEST_SUITE_P(Clocks, AbsoluteError,
                         testing::Values(Accuracy{"final_12_fast_tag", kFinal, 12, 20.0, -20.0},
                                         Accuracy{"final_16_slow_tag", kFinal, 16, -20.0, 20.0},
                                         Accuracy{"final_16_all_fast", kFinal, 16, 20.0, 20.0},
                                         Accuracy{"next_poll_12_fast_tag", kNextPoll, 12, 20.0, -20.0},
                                         Accuracy{"next_poll_16_slow_tag", kNextPoll, 16, -20.0, 20.0},
                                         Accuracy{"next_poll_12_all_slow", kNextPoll, 12, -20.0, -20.0}),
                         [](const auto& test) { return std::string(test.param.name); });

// ---- a clock that each delayed transmission shifts ---------------------------------------------------

// By derivation the last of twelve RESPONSEs would be 0.4 m off if it were launched when its POLL has been
// read. The lead is the preamble and 200 us whichever slot it is for, so that beta takes up the same 0.05 m a
// ppm of each range.
TEST(DelayedTransmitGain, MovesAllRangesAlikeWhicheverTheirSlots) {
  constexpr double kGain_ppm = 3.0;
  constexpr int kTags = 3;
  constexpr int kAnchors = 12;
  for (const auto method : {kNextPoll, kFinal}) {
    SiteBench site({.tags = kTags, .anchors = kAnchors, .method = method, .equip = [](ChipSpec& chip) {
                      chip.quirks.delayed_transmit_gain_ppm = kGain_ppm;
                    }});
    site.run_until(2.0 * kRanging_s);
    std::map<std::pair<int, int>, int> count;
    double least_m = 1.0;
    double most_m = -1.0;
    site.each_range(
        [&](const groma_SlotReport& report, const groma_Range& range) {
          ASSERT_TRUE(ok(range)) << range.status;
          ++count[{report.tag_id, range.anchor_id}];
          least_m = std::min(least_m, error_m(site, report, range));
          most_m = std::max(most_m, error_m(site, report, range));
        },
        kRanging_s);
    EXPECT_EQ(count.size(), static_cast<std::size_t>(kTags * kAnchors));
    EXPECT_GE(least_m, -0.05 * kGain_ppm);
    EXPECT_LE(most_m, -0.01 * kGain_ppm) << "the clocks are not shifted";
    EXPECT_LE(most_m - least_m, 0.025 * kGain_ppm);
  }
}

// ---- spread ---------------------------------------------------------------------------------------

struct Spread {
  const char* name;
  groma_RangingMethod method;
  int anchors;
};

class TimestampNoise : public testing::TestWithParam<Spread> {};

// See docs/explanation/ranging.md. With D from the POLL's RMARKER to the RESPONSE's and D' from there to the
// closing frame's, the three receive timestamps have the weights D' / 2(D + D'), 1/2 and D / 2(D + D').
// Single-sided, the two timestamps have the weight 1/2 each.
double closed_form_m(double timestamp_sigma_s, double to_response, double to_closing) {
  const double total = to_response + to_closing;
  return kSpeedOfLight_mps * timestamp_sigma_s * 0.5 *
         std::sqrt(1.0 + (to_response * to_response + to_closing * to_closing) / (total * total));
}

TEST_P(TimestampNoise, SpreadsRangesAsInTheClosedForm) {
  const Spread& p = GetParam();
  constexpr double kNoise_s = 1e-10;
  SiteBench site({.tags = 1,
                  .anchors = p.anchors,
                  .method = p.method,
                  .medium = {.timestamp_noise_s = kNoise_s, .carrier_noise_ppm = 0.0},
                  .seed = 7});
  site.run_until(kRanging_s + 20.0);
  // A timestamp is a whole number of ticks.
  const double timestamp_sigma_s = std::hypot(kNoise_s, 1.0 / kTicksPerSecond / std::sqrt(12.0));
  const mac::Superframe superframe = site.superframe();
  const auto count = static_cast<std::size_t>(p.anchors);
  const double single_sided_m = kSpeedOfLight_mps * timestamp_sigma_s / std::sqrt(2.0);
  double single_sided_squares = 0.0;
  std::vector<double> squares(count);
  std::vector<int> ranges(count);
  site.each_range(
      [&](const groma_SlotReport& report, const groma_Range& range) {
        // A POLL closes one exchange and opens the next, so only every other exchange is independent.
        if (!ok(range) || report.superframe % 2 == 1) return;
        const auto responder = static_cast<std::size_t>(range.anchor_id - nth_anchor(0));
        const auto to_response = static_cast<double>(superframe.response(responder, count).count());
        const auto closing = static_cast<double>(
            (p.method == kFinal ? superframe.final(count) : superframe.duration()).count());
        const double sigma_m = closed_form_m(timestamp_sigma_s, to_response, closing - to_response);
        const double normalized = error_m(site, report, range) / sigma_m;
        EXPECT_LT(std::abs(normalized), 6.0);
        squares[responder] += normalized * normalized;
        const double single_sided_normalized = single_sided_error_m(site, report, range) / single_sided_m;
        single_sided_squares += single_sided_normalized * single_sided_normalized;
        ++ranges[responder];
      },
      kRanging_s);
  double all = 0.0;
  int all_ranges = 0;
  for (std::size_t i = 0; i < count; ++i) {
    ASSERT_GT(ranges[i], 200);
    // Chi-squared with ranges[i] degrees of freedom, within 5 sigma.
    EXPECT_NEAR(squares[i], ranges[i], 5.0 * std::sqrt(2.0 * ranges[i])) << "responder " << i;
    all += squares[i];
    all_ranges += ranges[i];
  }
  EXPECT_NEAR(all, all_ranges, 5.0 * std::sqrt(2.0 * all_ranges));
  // Ranges of one exchange share only the POLL, which each anchor timestamps itself.
  EXPECT_NEAR(single_sided_squares, all_ranges, 5.0 * std::sqrt(2.0 * all_ranges));
  std::printf("%s: spread %.4f of the closed form over %d ranges; first %.4f, last %.4f\n", p.name,
              std::sqrt(all / all_ranges), all_ranges, std::sqrt(squares.front() / ranges.front()),
              std::sqrt(squares.back() / ranges.back()));
}

INSTANTIATE_TEST_SUITE_P(Methods, TimestampNoise,
                         testing::Values(Spread{"final_12", kFinal, 12}, Spread{"final_16", kFinal, 16},
                                         Spread{"next_poll_12", kNextPoll, 12},
                                         Spread{"next_poll_16", kNextPoll, 16}),
                         [](const auto& test) { return std::string(test.param.name); });

// ---- antenna delays -------------------------------------------------------------------------------

// Mean range error in metres if the configured delays differ from the true ones by these ticks.
double mean_error_with(std::int32_t tag_transmit, std::int32_t tag_receive, std::int32_t anchor_transmit,
                       std::int32_t anchor_receive) {
  constexpr std::int32_t kTransmit = 16'500;
  constexpr std::int32_t kReceive = 16'380;
  SiteBench site({.tags = 1,
                  .anchors = 2,
                  .configure =
                      [&](groma_Config& config) {
                        const bool tag = config.role == groma_Role_ROLE_TAG;
                        config.transmit_antenna_delay_dtu =
                            static_cast<std::uint32_t>(kTransmit + (tag ? tag_transmit : anchor_transmit));
                        config.receive_antenna_delay_dtu =
                            static_cast<std::uint32_t>(kReceive + (tag ? tag_receive : anchor_receive));
                      },
                  .equip =
                      [](ChipSpec& chip) {
                        chip.transmit_antenna_delay_ticks = kTransmit;
                        chip.receive_antenna_delay_ticks = kReceive;
                      }});
  site.run_until(1.5);
  double sum_m = 0.0;
  int count = 0;
  site.each_range(
      [&](const groma_SlotReport& report, const groma_Range& range) {
        if (!ok(range)) return;
        EXPECT_TRUE(range.flags & groma_RangeFlag_RANGE_FLAG_ANTENNA_DELAYS);
        sum_m += error_m(site, report, range);
        ++count;
      },
      kRanging_s);
  EXPECT_GT(count, 40);
  return sum_m / count;
}

// Each of the four delays enters a range once, by half.
TEST(AntennaDelays, AreSubtractedOnce) {
  constexpr std::int32_t kOff = 200;
  const double half_m = 0.5 * kOff * kMetresPerTick;
  EXPECT_NEAR(mean_error_with(0, 0, 0, 0), 0.0, 0.003);
  EXPECT_NEAR(mean_error_with(kOff, 0, 0, 0), -half_m, 0.003);
  EXPECT_NEAR(mean_error_with(0, kOff, 0, 0), -half_m, 0.003);
  EXPECT_NEAR(mean_error_with(0, 0, -kOff, 0), half_m, 0.003);
  EXPECT_NEAR(mean_error_with(0, 0, 0, kOff), -half_m, 0.003);
}

// ---- temperature, supply, receive power -----------------------------------------------------------

constexpr double kTagTemperature_c = 47.0;
constexpr double kTagSupply_v = 3.05;

double anchor_temperature_c(std::uint16_t id) {
  return -15.0 + 18.0 * (id - nth_anchor(0));
}
double anchor_supply_v(std::uint16_t id) {
  return 3.5 - 0.12 * (id - nth_anchor(0));
}

SiteSettings drifting(bool correct) {
  return {.tags = 1,
          .anchors = 5,
          .configure = [correct](groma_Config& config) { config.correct_temperature = correct; },
          .equip =
              [](ChipSpec& chip) {
                chip.bias.drift = true;
                chip.ambient = chip.id < 100
                                   ? Ambient{kTagTemperature_c, kTagSupply_v}
                                   : Ambient{anchor_temperature_c(chip.id), anchor_supply_v(chip.id)};
              }};
}

TEST(Drift, OfBothEndsBiasesARangeUntilCorrected) {
  SiteBench site(drifting(false));
  site.run_until(3.0);
  int count = 0;
  site.each_range(
      [&](const groma_SlotReport& report, const groma_Range& range) {
        if (!ok(range)) return;
        const double expected_m =
            0.00215 * (kTagTemperature_c - 23.0 + anchor_temperature_c(range.anchor_id) - 23.0) +
            0.0535 * (kTagSupply_v - 3.3 + anchor_supply_v(range.anchor_id) - 3.3);
        EXPECT_NEAR(error_m(site, report, range), expected_m, 0.01) << range.anchor_id;
        EXPECT_EQ(range.flags & (groma_RangeFlag_RANGE_FLAG_TEMPERATURE | groma_RangeFlag_RANGE_FLAG_SUPPLY),
                  0);
        ++count;
      },
      2.2);
  EXPECT_GT(count, 50);
}

TEST(Drift, IsCorrectedAndFlaggedIfConfigured) {
  SiteBench site(drifting(true));
  site.run_until(3.0);
  int count = 0;
  site.each_range(
      [&](const groma_SlotReport& report, const groma_Range& range) {
        if (!ok(range)) return;
        EXPECT_NEAR(error_m(site, report, range), 0.0, 0.012) << range.anchor_id;
        EXPECT_TRUE(range.flags & groma_RangeFlag_RANGE_FLAG_TEMPERATURE);
        EXPECT_TRUE(range.flags & groma_RangeFlag_RANGE_FLAG_SUPPLY);
        ++count;
      },
      2.2);
  EXPECT_GT(count, 50);
}

TEST(Health, OfEachChipIsReportedAndCostsNoSlot) {
  SiteBench site(drifting(true));
  site.run_until(4.2);
  for (std::size_t i = 0; i < site.network.size(); ++i) {
    const std::uint16_t id = site.network.node(i).chip().id();
    const groma_NetworkStatus& status = site.listeners[i].status;
    ASSERT_TRUE(status.has_temperature_cdegc && status.has_supply_mv) << id;
    EXPECT_NEAR(status.temperature_cdegc, 100.0 * (id < 100 ? kTagTemperature_c : anchor_temperature_c(id)),
                58.0);
    EXPECT_NEAR(status.supply_mv, 1000.0 * (id < 100 ? kTagSupply_v : anchor_supply_v(id)), 4.0);
    EXPECT_EQ(site.listeners[i].counters.late_transmits, 0U) << id;
    EXPECT_EQ(site.listeners[i].counters.late_receives, 0U) << id;
    EXPECT_EQ(site.network.node(i).chip().fault(), "") << id;
  }
  site.each_range([](const groma_SlotReport&, const groma_Range& range) { EXPECT_TRUE(ok(range)); },
                  kRanging_s);
  // A change is reported a second later.
  site.network.node(0).chip().set_ambient({.temperature_c = 60.0, .supply_v = 3.3});
  site.run_until(7.2);
  EXPECT_NEAR(site.listeners[0].status.temperature_cdegc, 6'000, 58.0);
}

// The simulated chip timestamps a strong signal early and a weak one late, as a leading edge threshold does.
TEST(PowerBias, BiasesARangeUntilCorrected) {
  for (const bool correct : {false, true}) {
    SiteBench site({.tags = 1,
                    .anchors = 3,
                    .configure = [&](groma_Config& config) { config.correct_power_bias = correct; },
                    .equip = [](ChipSpec& chip) { chip.bias.power = true; }});
    put_around(site, 3, 2.0);
    double t_s = kRanging_s;
    site.run_until(t_s);
    struct Point {
      double distance_m;
      double bias_m;  // read off the published table at -59 dBm - 20 log10(d)
    };
    // -65.02, -77.04, -83.08, -91.04 and -97 dBm.
    for (const Point& point : {Point{2.0, -0.09999}, Point{8.0, 0.0 - 0.027 + 0.00054}, Point{16.0, 0.0432},
                               Point{40.0, 0.0761}, Point{80.0, 0.081}}) {
      if (point.distance_m == 8.0 || point.distance_m == 16.0) continue;
      put_around(site, 3, point.distance_m);
      site.run_until(t_s + 0.4);
      int count = 0;
      site.each_range(
          [&](const groma_SlotReport& report, const groma_Range& range) {
            if (!ok(range)) return;
            EXPECT_NEAR(error_m(site, report, range), correct ? 0.0 : point.bias_m, 0.01) << point.distance_m;
            EXPECT_EQ((range.flags & groma_RangeFlag_RANGE_FLAG_POWER_BIAS) != 0, correct);
            ++count;
          },
          t_s + 0.2);
      EXPECT_GT(count, 10);
      t_s += 0.4;
    }
  }
}

// ---- quality --------------------------------------------------------------------------------------

TEST(Quality, ReportsTheLineOfSightAndTheNoise) {
  struct Case {
    double hidden_db;
    groma_LineOfSight hint;
  };
  for (const Case& each : {Case{2.0, groma_LineOfSight_LINE_OF_SIGHT_LIKELY},
                           Case{8.0, groma_LineOfSight_LINE_OF_SIGHT_UNCERTAIN},
                           Case{12.0, groma_LineOfSight_LINE_OF_SIGHT_UNLIKELY}}) {
    SiteBench site({});
    site.space.hidden_db = each.hidden_db;
    site.run_until(1.2);
    int count = 0;
    site.each_range(
        [&](const groma_SlotReport&, const groma_Range& range) {
          EXPECT_EQ(range.flags & 3, static_cast<int>(each.hint));
          EXPECT_GT(range.noise, 0);
          ++count;
        },
        kRanging_s);
    EXPECT_GT(count, 40);
  }
}

// ---- the instant ----------------------------------------------------------------------------------

// Predicted by the schedule alone: superframe, slot and the RESPONSE's place in it.
TEST(NetworkTime, OfARangeIsItsPlaceInTheSchedule) {
  SiteBench site({.tags = 3, .anchors = 6});
  site.run_until(3.0);
  const mac::Superframe superframe = site.superframe();
  int count = 0;
  site.each_range(
      [&](const groma_SlotReport& report, const groma_Range& range) {
        ASSERT_TRUE(ok(range));
        ASSERT_NE(report.network_time_dtu, 0U);
        const double offset =
            static_cast<double>(range.instant_offset_dtu) * (1.0 + report.network_rate_ppb * 1e-9);
        const auto at = static_cast<std::int64_t>(report.network_time_dtu) + std::llround(offset);
        const auto responder = static_cast<std::size_t>(range.anchor_id - nth_anchor(0));
        // A tag finds its slot from the superframe's start by its own clock.
        const double rate = 1.0 + report.network_rate_ppb * 1e-9;
        const double due = static_cast<double>((std::int64_t{report.superframe} * superframe.duration() +
                                                superframe.response(responder, 6))
                                                   .count()) +
                           static_cast<double>(superframe.poll(report.slot).count()) * rate;
        // The flight times of the beacon and of the two frames, the anchor's clock, and the transmit grid:
        // 0.2 us.
        EXPECT_NEAR(static_cast<double>(at), due, 12'800.0);
        ++count;
      },
      kRanging_s);
  EXPECT_GT(count, 500);
}

// The network time of both tags follows the master's clock.
TEST(NetworkTime, FollowsTheMastersClockOverTheCountersWrap) {
  SiteBench site({.tags = 2, .anchors = 3});
  site.run_until(20.0);
  const double master = 1.0 + site.network.node(2).chip().clock().offset(0);
  for (std::size_t tag = 0; tag < 2; ++tag) {
    const double own = 1.0 + site.network.node(tag).chip().clock().offset(0);
    const auto& reports = site.listeners[tag].reports;
    const auto first = std::find_if(reports.begin(), reports.end(), [](const Listener::Report& report) {
      return to_seconds(report.t) > kRanging_s;
    });
    ASSERT_NE(first, reports.end());
    for (auto report = first; report != reports.end(); ++report) {
      const auto network = static_cast<double>(report->body.network_time_dtu - first->body.network_time_dtu);
      const auto device = static_cast<double>(report->body.device_time_dtu - first->body.device_time_dtu);
      // 100 ticks: each of the two superframe starts is known to about a tick.
      ASSERT_NEAR(network, device * master / own, 100.0);
      ASSERT_NEAR(report->body.network_rate_ppb, (master / own - 1.0) * 1e9, 40.0);
    }
  }
}

// A back-up that takes over continues the dead master's count, phase and rate.
TEST(NetworkTime, ContinuesOverATakeover) {
  SiteBench site({.tags = 1, .anchors = 4, .configure = [](groma_Config& config) {
                    config.schedule.backup_ids_count = 1;
                    config.schedule.backup_ids[0] = nth_anchor(1);
                  }});
  site.run_until(2.0);
  const double master = 1.0 + site.network.node(1).chip().clock().offset(0);
  const double own = 1.0 + site.network.node(0).chip().clock().offset(0);
  site.network.set_power(1, false);
  site.run_until(4.5);
  EXPECT_EQ(site.listeners[0].status.state, groma_SyncState_SYNC_LOCKED);
  const auto& reports = site.listeners[0].reports;
  const auto first = std::find_if(reports.begin(), reports.end(),
                                  [](const Listener::Report& report) { return to_seconds(report.t) > 1.0; });
  ASSERT_NE(first, reports.end());
  int after = 0;
  for (auto report = first; report != reports.end(); ++report) {
    ASSERT_NE(report->body.network_time_dtu, 0U) << to_seconds(report->t);
    const auto network = static_cast<double>(report->body.network_time_dtu - first->body.network_time_dtu);
    const auto device = static_cast<double>(report->body.device_time_dtu - first->body.device_time_dtu);
    // 0.5 us: the back-up continues at its estimate of the dead master's rate.
    ASSERT_NEAR(network, device * master / own, 32'000.0) << to_seconds(report->t);
    if (to_seconds(report->t) > 3.5) ++after;
  }
  EXPECT_GT(after, 20);
}

// ---- host and node --------------------------------------------------------------------------------

// Each node answers by the clock of its reports: the answer lies between two of them.
TEST(TimeRequest, IsAnsweredByEachNodeWithItsOwnClock) {
  SiteBench site({});
  double t_s = 1.0;
  site.run_until(t_s);
  groma_HostToNode request = groma_HostToNode_init_zero;
  request.which_body = groma_HostToNode_time_request_tag;
  for (std::size_t i = 0; i < site.network.size(); ++i) {
    for (std::uint64_t k = 1; k <= 2; ++k) {
      request.body.time_request.host_time_ns = 123'456'789'012 * k;
      ASSERT_TRUE(site.network.send(i, frame_of(request)));
      t_s += 0.25;
      site.run_until(t_s);
      ASSERT_EQ(site.listeners[i].time_replies.size(), k);
      const groma_TimeReply& reply = site.listeners[i].time_replies.back();
      EXPECT_EQ(reply.host_time_ns, 123'456'789'012 * k);
      EXPECT_GT(reply.transmitted_dtu, reply.received_dtu);
      EXPECT_LT(static_cast<double>(reply.transmitted_dtu - reply.received_dtu) / kTicksPerSecond, 100e-6);
    }
    const auto& replies = site.listeners[i].time_replies;
    EXPECT_NEAR(static_cast<double>(replies[1].received_dtu - replies[0].received_dtu) / kTicksPerSecond,
                0.25, 0.001);
    EXPECT_EQ(site.listeners[i].replies.size(), 0U);
  }
  const auto& reports = site.listeners[0].reports;
  const std::uint64_t received = site.listeners[0].time_replies[0].received_dtu;
  const auto later = std::find_if(reports.begin(), reports.end(), [&](const Listener::Report& report) {
    return report.body.device_time_dtu > received;
  });
  ASSERT_TRUE(later != reports.end() && later != reports.begin());
  EXPECT_NEAR(to_seconds(later->t), 1.0, 0.1);
}

}  // namespace
}  // namespace groma::sim
