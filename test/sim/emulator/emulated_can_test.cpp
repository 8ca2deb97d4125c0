// The shipped image with an MCP2518FD on its header: reports over one CAN bus to the host's tap.
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdio>
#include <map>
#include <memory>
#include <sstream>
#include <string>
#include <vector>

#include "firmware/sim/can_bus.hpp"
#include "firmware/sim/can_log.hpp"
#include "firmware/sim/mcp2518fd_chip.hpp"
#include "test/sim/emulator/emulated_site.hpp"

namespace groma::sim {
namespace {

// Tags run the image, each with a controller on the same bus; the anchors are native.
class CanSite {
 public:
  CanSite(groma_Link link, SiteSettings settings, SimTime quantum = EmulatorOptions{}.quantum,
          bool with_controllers = true)
      : tap(bus, {}) {
    settings.make_node = [=, this](const NodeSpec& spec, Medium& medium) -> std::unique_ptr<NodeHost> {
      if (spec.chip.id > 100) return make_native_node(spec, medium);
      NodeSpec changed = spec;
      groma_Config config = *node::decode_config(spec.stored_config);
      config.link = link;
      config.report_raw_stamps = false;
      changed.stored_config.resize(node::kMaxConfigBytes);
      changed.stored_config.resize(node::encode_config(config, changed.stored_config));
      EmulatorOptions options;
      options.quantum = quantum;
      if (with_controllers) {
        chips.push_back(std::make_unique<Mcp2518fdChip>(bus, Mcp2518fdSpec{}));
        chips.back()->set_power(true, 0);
        options.can = chips.back().get();
      }
      return make_emulated_node(changed, shipped(), medium, options);
    };
    site = std::make_unique<SiteBench>(settings);
    listeners.resize(static_cast<std::size_t>(settings.tags));
  }

  void run_until(double t_s) {
    site->run_until(t_s);
    bus.advance(site->network.now());
    for (const TimedCanFrame& timed : tap.take(site->network.now())) {
      recording.push_back(timed);
      const auto address = wire::can_address(timed.frame.id);
      ASSERT_TRUE(address && address->node >= 1 && address->node <= listeners.size());
      std::vector<TimedByte> bytes;
      for (const std::uint8_t byte : timed.frame.payload()) bytes.push_back({timed.t, byte});
      listeners[address->node - 1U].take(bytes);
    }
    for (const auto& chip : chips) ASSERT_EQ(chip->fault(), "");
    ASSERT_EQ(bus.fault(), "");
  }

  void send(std::uint16_t node, std::uint32_t request_id, pb_size_t which, wire::CanFormat format) {
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.request_id = request_id;
    command.which_body = which;
    const auto bytes = frame_of(command);
    std::span<const std::uint8_t> left(bytes);
    while (!left.empty()) {
      wire::CanFrame frame;
      frame.id = wire::can_id({wire::CanDirection::kToNode, node});
      left = left.subspan(wire::cut_can_payload(left, format, frame));
      tap.send(site->network.now(), frame);
    }
  }

  // The largest error of the good ranges.
  double worst_error_m() const {
    double worst_m = 0.0;
    for (const Listener& listener : listeners) {
      for (const Listener::Report& report : listener.reports) {
        for (pb_size_t i = 0; i < report.body.ranges_count; ++i) {
          const groma_Range& range = report.body.ranges[i];
          if (range.status != groma_RangeStatus_RANGE_OK) continue;
          const double true_m = site->space.distance_m(static_cast<std::uint16_t>(report.body.tag_id),
                                                       static_cast<std::uint16_t>(range.anchor_id));
          worst_m = std::max(worst_m, std::abs(static_cast<double>(range.range_m) - true_m));
        }
      }
    }
    return worst_m;
  }
  int good_ranges() const {
    int count = 0;
    for (const Listener& listener : listeners) {
      for (const Listener::Report& report : listener.reports) {
        for (pb_size_t i = 0; i < report.body.ranges_count; ++i) {
          count += report.body.ranges[i].status == groma_RangeStatus_RANGE_OK ? 1 : 0;
        }
      }
    }
    return count;
  }
  // Reports missing between the first and the last.
  std::uint32_t lost_reports() const {
    std::uint32_t lost = 0;
    for (const Listener& listener : listeners) {
      if (listener.reports.empty()) continue;
      const auto first = listener.reports.front().body.sequence;
      const auto last = listener.reports.back().body.sequence;
      lost += last - first + 1 - static_cast<std::uint32_t>(listener.reports.size());
    }
    return lost;
  }

  CanBus bus;
  CanTap tap;
  std::vector<std::unique_ptr<Mcp2518fdChip>> chips;
  std::unique_ptr<SiteBench> site;
  std::vector<Listener> listeners;  // of each tag, over CAN
  std::vector<TimedCanFrame> recording;
};

class EmulatedCan : public ::testing::TestWithParam<groma_Link> {
 protected:
  void SetUp() override { GROMA_NEEDS_SHIPPED_IMAGE(); }
  [[nodiscard]] static wire::CanFormat format() {
    return GetParam() == groma_Link_LINK_CAN_FD ? wire::CanFormat::kFd : wire::CanFormat::kClassic;
  }
};

INSTANTIATE_TEST_SUITE_P(Links, EmulatedCan, ::testing::Values(groma_Link_LINK_CAN, groma_Link_LINK_CAN_FD),
                         [](const auto& link) {
                           return link.param == groma_Link_LINK_CAN_FD ? "Fd" : "Classic";
                         });

TEST_P(EmulatedCan, ThreeTagsStreamTheirRangesAndLoseNone) {
  CanSite can(GetParam(), {.tags = 3, .anchors = 12});
  can.run_until(1.5);
  const SimTime busy = can.bus.counters().busy;
  const int before = can.good_ranges();
  can.run_until(4.5);
  const double load =
      static_cast<double>(can.bus.counters().busy - busy) / static_cast<double>(from_seconds(3.0));
  const double rate = (can.good_ranges() - before) / 3.0;
  std::printf("%.0f ranges/s, bus load %.1f %%, SPI load of a module %.1f %%, processor %.1f %%\n", rate,
              100.0 * load, 100.0 * emulated(*can.site, 0).usage(can.site->network.now()).can_spi_s / 4.5,
              100.0 * emulated(*can.site, 0).usage(can.site->network.now()).cpu_load);
  EXPECT_GT(rate, 300.0);
  EXPECT_LT(load, 0.6);
  EXPECT_EQ(can.lost_reports(), 0U);
  EXPECT_LT(can.worst_error_m(), 0.01);
  EXPECT_EQ(can.bus.counters().errors, 0U);
  for (std::size_t i = 0; i < 3; ++i) {
    const Listener& listener = can.listeners[i];
    ASSERT_FALSE(listener.hellos.empty());
    EXPECT_STREQ(listener.hellos.front().link_error, "");
    EXPECT_STREQ(listener.hellos.front().radio_error, "");
    EXPECT_EQ(listener.frames().bytes_discarded, 0U);
    EXPECT_EQ(listener.undecodable, 0);
    EXPECT_EQ(listener.compact_reports > 0, GetParam() == groma_Link_LINK_CAN);
    EXPECT_EQ(listener.counters.reports_dropped, 0U);
    EXPECT_EQ(listener.counters.can_bus_offs, 0U);
    EXPECT_GT(listener.counters.can_frames_sent, 100U);
    EXPECT_EQ(listener.counters.late_transmits, 0U);
    EXPECT_EQ(listener.counters.radio_recoveries, 0U);
    // Nothing goes to the UART.
    EXPECT_TRUE(can.site->listeners[i].reports.empty());
    EXPECT_TRUE(can.site->listeners[i].hellos.empty());
  }
}

// One tag ranges as fast as the schedule allows: a bus carries the rate that `groma plan` predicts for it.
TEST_P(EmulatedCan, ATagAloneGetsAllItsReportsOntoTheBus) {
  SiteSettings settings{.tags = 1, .anchors = 4, .method = groma_RangingMethod_METHOD_DS_NEXT_POLL};
  CanSite can(GetParam(), settings);
  can.run_until(3.0);
  const std::size_t before = can.listeners[0].reports.size();
  const int good_before = can.good_ranges();
  can.run_until(5.0);
  const Listener& listener = can.listeners[0];
  const double superframe_s = seconds_of(can.site->superframe());
  const double reports_per_s = static_cast<double>(listener.reports.size() - before) / 2.0;
  std::printf("%.0f of %.0f reports/s, %u dropped\n", reports_per_s, 1.0 / superframe_s,
              listener.counters.reports_dropped);
  EXPECT_GT(reports_per_s, 0.98 / superframe_s);
  EXPECT_EQ(can.lost_reports(), 0U);
  EXPECT_EQ(listener.counters.reports_dropped, 0U);
  EXPECT_EQ(listener.counters.late_transmits, 0U);
  EXPECT_GT(can.good_ranges() - good_before, 0.98 * 4 * 2.0 / superframe_s);
}

TEST_P(EmulatedCan, AnswersOnTheLinkOnWhichItIsAsked) {
  CanSite can(GetParam(), {.tags = 1, .anchors = 3});
  can.run_until(1.0);
  can.send(1, 77, groma_HostToNode_get_hello_tag, format());
  can.run_until(1.2);
  ASSERT_EQ(can.listeners[0].replies.size(), 1U);
  EXPECT_EQ(can.listeners[0].replies[0].request_id, 77U);
  EXPECT_EQ(can.listeners[0].hellos.size(), 2U);
  EXPECT_TRUE(can.site->listeners[0].replies.empty());

  groma_HostToNode command = groma_HostToNode_init_zero;
  command.request_id = 78;
  command.which_body = groma_HostToNode_get_counters_tag;
  ASSERT_TRUE(can.site->network.send(0, frame_of(command)));
  can.run_until(1.4);
  ASSERT_EQ(can.site->listeners[0].replies.size(), 1U);
  EXPECT_EQ(can.site->listeners[0].replies[0].request_id, 78U);
  EXPECT_GT(can.site->listeners[0].counters.can_frames_received, 0U);
  EXPECT_EQ(can.listeners[0].replies.size(), 1U);
  EXPECT_EQ(can.lost_reports(), 0U);
}

TEST_P(EmulatedCan, KeepsRangingThroughBusOffAndReportsAfterIt) {
  CanSite can(GetParam(), {.tags = 1, .anchors = 3});
  can.run_until(1.5);
  const std::size_t before = can.listeners[0].reports.size();
  can.bus.damage(from_seconds(1.5), from_seconds(2.0));
  can.run_until(2.0);
  EXPECT_LE(can.listeners[0].reports.size(), before + 1);  // one may have been on its way
  can.run_until(5.0);
  const auto& listener = can.listeners[0];
  EXPECT_GT(listener.reports.size(), before + 100);
  EXPECT_GE(listener.counters.can_bus_offs, 2U);
  EXPECT_EQ(listener.counters.can_restarts, 0U);
  EXPECT_EQ(listener.counters.radio_recoveries, 0U);
  EXPECT_EQ(listener.counters.beacons_missed, 0U);
  EXPECT_LT(can.worst_error_m(), 0.01);
}

TEST_P(EmulatedCan, IsDeterministicForAnyQuantum) {
  const auto recording_of = [](SimTime quantum) {
    CanSite can(GetParam(), {.tags = 2, .anchors = 3}, quantum);
    can.run_until(1.5);
    std::ostringstream text;
    write_candump(text, can.recording);
    return text.str();
  };
  const std::string first = recording_of(40 * kUnitsPerMicrosecond);
  EXPECT_GT(first.size(), 10'000U);
  EXPECT_EQ(recording_of(40 * kUnitsPerMicrosecond), first);
  EXPECT_EQ(recording_of(23 * kUnitsPerMicrosecond), first);
}

TEST_P(EmulatedCan, ReportsAMissingControllerOnItsUart) {
  CanSite can(GetParam(), {.tags = 1, .anchors = 3}, EmulatorOptions{}.quantum, false);
  can.run_until(2.0);
  const Listener& listener = can.site->listeners[0];
  ASSERT_FALSE(listener.hellos.empty());
  EXPECT_STREQ(listener.hellos[0].link_error, "no MCP2518FD answers on SPI");
  EXPECT_GT(listener.reports.size(), 20U);
}

}  // namespace
}  // namespace groma::sim
