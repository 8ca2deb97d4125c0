// The demo's three tags, together some 1500 ranges a second, on one bus of 1 Mbit/s.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cstdio>
#include <memory>
#include <random>
#include <vector>

#include "firmware/core/node/messages.hpp"
#include "firmware/sim/can_bits.hpp"
#include "proto/compact_report.hpp"
#include "test/sim/can_bench.hpp"

namespace groma::sim {
namespace {

using mcp2518fd::BringUp;
using test::CanModule;
using wire::CanFormat;

constexpr int kTags = 3;
constexpr int kAnchors = 12;
constexpr SimTime kSuperframe = 24 * kUnitsPerMillisecond;  // 41.7 a second: 1500 ranges
constexpr SimTime kSlot = 7 * kUnitsPerMillisecond;

groma_NodeToHost report_of(std::uint32_t tag, std::uint32_t superframe, std::mt19937_64& random) {
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_slot_report_tag;
  groma_SlotReport& report = message.body.slot_report;
  report.sequence = superframe;
  report.superframe = superframe + 1'000'000;
  report.slot = tag;
  report.tag_id = tag;
  report.device_time_dtu = (std::uint64_t{1} << 52) + superframe * 1'533'542'400ULL;
  report.network_time_dtu = (std::uint64_t{1} << 51) + superframe * 1'533'542'400ULL;
  report.network_rate_ppb = -12'345;
  for (int i = 0; i < kAnchors; ++i) {
    groma_Range& range = report.ranges[report.ranges_count++];
    range.anchor_id = static_cast<std::uint16_t>(101 + i);
    range.instant_offset_dtu = -static_cast<std::int64_t>(random() % 1'500'000'000);
    range.range_m = static_cast<float>(random() % 40'000'000) * 1e-6F;
    range.has_first_path_power_cdbm = range.has_receive_power_cdbm = range.has_clock_offset_ppb = true;
    range.first_path_power_cdbm = static_cast<std::int16_t>(-7'500 - static_cast<int>(random() % 2'500));
    range.receive_power_cdbm = static_cast<std::int16_t>(-7'500 - static_cast<int>(random() % 2'500));
    range.clock_offset_ppb = static_cast<std::int32_t>(random() % 40'000) - 20'000;
    range.noise = static_cast<std::uint16_t>(30 + random() % 200);
    range.flags = groma_RangeFlag_RANGE_FLAG_ANTENNA_DELAYS;
  }
  return message;
}

struct Outcome {
  std::array<std::uint32_t, kTags> reports{};
  std::uint64_t refused = 0;
  std::uint64_t bad_frames = 0;
  double load = 0.0;
  double longest_ms = 0.0;  // from the report's writing to its last CAN frame's end
  double spi_load = 0.0;    // of one module
};

Outcome run(CanFormat format, bool compact, SimTime duration) {
  CanBus bus;
  CanTap tap(bus, {});
  std::array<std::unique_ptr<CanModule>, kTags> modules;
  std::array<CanModule*, kTags> pointers{};
  SimTime begin = 0;
  for (int i = 0; i < kTags; ++i) {
    modules[static_cast<std::size_t>(i)] = std::make_unique<CanModule>(bus);
    pointers[static_cast<std::size_t>(i)] = modules[static_cast<std::size_t>(i)].get();
    EXPECT_EQ(pointers[static_cast<std::size_t>(i)]->start(
                  {.node = static_cast<std::uint16_t>(i + 1), .format = format}),
              BringUp::kOk);
    begin = std::max(begin, pointers[static_cast<std::size_t>(i)]->now);
  }
  test::run_all(pointers, begin);
  std::mt19937_64 random(1);
  std::array<wire::FrameDecoder, kTags> decoders;
  std::array<SimTime, kTags> written_at{};
  node::MessageEncoder encoder;
  Outcome out;
  const SimTime busy = bus.counters().busy;
  const std::size_t spi_before = pointers[0]->spi.bytes;
  const auto listen = [&](SimTime t) {
    test::run_all(pointers, t);
    for (const TimedCanFrame& timed : tap.take(t)) {
      const std::size_t sender = wire::can_address(timed.frame.id)->node - 1U;
      for (const std::uint8_t byte : timed.frame.payload()) {
        if (!decoders[sender].push(byte)) continue;
        out.longest_ms = std::max(out.longest_ms, 1e3 * to_seconds(timed.t - written_at[sender]));
        ++out.reports[sender];
      }
    }
  };
  for (std::uint32_t superframe = 0; superframe * kSuperframe < duration; ++superframe) {
    for (std::size_t tag = 0; tag < kTags; ++tag) {
      // In one of ten superframes all three reports come at once.
      const SimTime offset = superframe % 10 == 0 ? 0 : static_cast<SimTime>(tag) * kSlot;
      const SimTime t = begin + superframe * kSuperframe + offset;
      listen(t);
      groma_NodeToHost message = report_of(static_cast<std::uint32_t>(tag + 1), superframe, random);
      if (compact) node::make_compact(message);
      if (!pointers[tag]->link.write(encoder.encode(message))) ++out.refused;
      written_at[tag] = t;
    }
  }
  const SimTime end = begin + duration + kSuperframe;
  listen(end);
  for (const auto& decoder : decoders) {
    const auto& seen = decoder.counters();
    out.bad_frames += seen.crc_errors + seen.cobs_errors + seen.truncated + seen.oversize;
  }
  for (const CanModule* module : pointers) EXPECT_EQ(module->chip.fault(), "");
  EXPECT_EQ(bus.fault(), "");
  out.load = static_cast<double>(bus.counters().busy - busy) / static_cast<double>(end - begin);
  out.spi_load = static_cast<double>(pointers[0]->spi.bytes - spi_before) * 8.0 / test::TimedSpi::kClock_hz /
                 to_seconds(end - begin);
  return out;
}

void print(const char* what, const Outcome& o) {
  std::printf("%s: bus load %.1f %%, a report on the host after %.1f ms at most, SPI load %.1f %%\n", what,
              100.0 * o.load, o.longest_ms, 100.0 * o.spi_load);
}

TEST(CanLoad, ThreeTagsLoseNothingOnClassicCanWithCompactReports) {
  const Outcome o = run(CanFormat::kClassic, true, 20 * kUnitsPerSecond);
  print("classic, compact", o);
  EXPECT_EQ(o.refused, 0U);
  EXPECT_EQ(o.bad_frames, 0U);
  for (const std::uint32_t reports : o.reports) EXPECT_EQ(reports, 834U);
  EXPECT_LT(o.load, 0.55);
  EXPECT_LT(o.longest_ms, 12.0);
}

TEST(CanLoad, ThreeTagsLoseNothingOnCanFdWithFullReports) {
  const Outcome o = run(CanFormat::kFd, false, 20 * kUnitsPerSecond);
  print("FD, full", o);
  EXPECT_EQ(o.refused, 0U);
  EXPECT_EQ(o.bad_frames, 0U);
  for (const std::uint32_t reports : o.reports) EXPECT_EQ(reports, 834U);
  EXPECT_LT(o.load, 0.40);
  EXPECT_LT(o.longest_ms, 10.0);
}

TEST(CanLoad, FullReportsNeedTwiceTheLoadOfClassicCan) {
  const Outcome compact = run(CanFormat::kClassic, true, 2 * kUnitsPerSecond);
  const Outcome full = run(CanFormat::kClassic, false, 2 * kUnitsPerSecond);
  print("classic, full", full);
  EXPECT_GT(full.load, 1.9 * compact.load);
}

}  // namespace
}  // namespace groma::sim
