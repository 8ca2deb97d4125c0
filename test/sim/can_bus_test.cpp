#include "firmware/sim/can_bus.hpp"

#include <gtest/gtest.h>

#include <sstream>

#include "firmware/sim/can_bits.hpp"
#include "firmware/sim/can_log.hpp"
#include "test/sim/can_bench.hpp"

namespace groma::sim {
namespace {

using test::frame_of;
using wire::CanFormat;

constexpr SimTime kUs = kUnitsPerMicrosecond;
constexpr SimTime kBit = can_bit_time(1'000'000);

TEST(CanBus, TakesEachFramesBitsAtItsRates) {
  CanBus bus;
  CanTap sender(bus, {});
  CanTap host(bus, {});
  const auto classic = frame_of(0x16000003, 8, CanFormat::kClassic, 0x00);
  const auto fd = frame_of(0x16000003, 64, CanFormat::kFd, 0x3C);
  sender.send(100 * kUs, classic);
  sender.send(100 * kUs, fd);
  bus.advance(2'000 * kUs);
  const auto got = host.take(2'000 * kUs);
  ASSERT_EQ(got.size(), 2U);
  const SimTime first = 100 * kUs + can_bits(classic).total() * kBit;
  EXPECT_EQ(got[0].t, first);
  const CanBits bits = can_bits(fd);
  EXPECT_EQ(got[1].t, first + 3 * kBit + bits.nominal * kBit + bits.data * (kBit / 2));
  EXPECT_EQ(bus.counters().frames, 2U);
  EXPECT_EQ(bus.counters().busy, got[1].t + 3 * kBit - 100 * kUs);
  EXPECT_EQ(got[1].frame.data, fd.data);
  EXPECT_TRUE(bus.fault().empty());
}

TEST(CanBus, GivesTheBusToTheLowestIdAndKeepsTheOthersWaiting) {
  CanBus bus;
  CanTap a(bus, {});
  CanTap b(bus, {});
  CanTap c(bus, {});
  CanTap host(bus, {});
  c.send(10 * kUs, frame_of(0x16000007, 8, CanFormat::kClassic));
  a.send(20 * kUs, frame_of(0x16000005, 8, CanFormat::kClassic));
  b.send(20 * kUs, frame_of(0x16000004, 8, CanFormat::kClassic));
  a.send(20 * kUs, frame_of(0x16000003, 8, CanFormat::kClassic));
  bus.advance(5'000 * kUs);
  std::vector<std::uint32_t> ids;
  for (const auto& frame : host.take(5'000 * kUs)) ids.push_back(frame.frame.id);
  EXPECT_EQ(ids, (std::vector<std::uint32_t>{0x16000007, 0x16000004, 0x16000005, 0x16000003}));
}

TEST(CanBus, FaultsTwoSendersOfTheSameId) {
  CanBus bus;
  CanTap a(bus, {});
  CanTap b(bus, {});
  a.send(0, frame_of(0x16000007, 8, CanFormat::kClassic));
  b.send(0, frame_of(0x16000007, 4, CanFormat::kClassic));
  bus.advance(1'000 * kUs);
  EXPECT_NE(bus.fault().find("same id"), std::string::npos);
}

TEST(CanBus, DoesNotDependOnItsSteps) {
  const auto run = [](SimTime step) {
    CanBus bus;
    CanTap a(bus, {});
    CanTap b(bus, {});
    CanTap host(bus, {});
    for (SimTime i = 0; i < 50; ++i) {
      a.send(i * 170 * kUs, frame_of(0x16000001, 8, CanFormat::kClassic, static_cast<std::uint8_t>(i)));
      b.send(i * 150 * kUs, frame_of(0x16000002, 8, CanFormat::kClassic, static_cast<std::uint8_t>(7 * i)));
    }
    bus.damage(2'000 * kUs, 2'100 * kUs);
    for (SimTime t = 0; t < 40'000 * kUs; t += step) bus.advance(t);
    std::ostringstream text;
    write_candump(text, host.take(39'000 * kUs));
    return text.str();
  };
  const std::string once = run(40'000 * kUs - 1);
  EXPECT_FALSE(once.empty());
  EXPECT_EQ(run(1 * kUs), once);
  EXPECT_EQ(run(333 * kUs), once);
}

TEST(CanBus, RepeatsAFrameThatWasDamaged) {
  CanBus bus;
  CanTap sender(bus, {});
  CanTap host(bus, {});
  sender.send(0, frame_of(0x16000003, 8, CanFormat::kClassic));
  bus.damage(50 * kUs, 51 * kUs);
  bus.advance(1'000 * kUs);
  const auto got = host.take(1'000 * kUs);
  ASSERT_EQ(got.size(), 1U);
  // Damaged at 50 us, flagged from the next bit on: 20 bits of error frame and 3 of intermission.
  const unsigned bits = can_bits(got[0].frame).total();
  EXPECT_EQ(got[0].t, (51 + 20 + 3 + bits) * kBit);
  EXPECT_EQ(sender.failures(), 1U);
  EXPECT_EQ(host.failures(), 1U);
  EXPECT_EQ(bus.counters().errors, 1U);
}

TEST(CanBus, AFrameWithoutAnotherNodeIsNotAcknowledged) {
  CanBus bus;
  CanTap sender(bus, {});
  CanTap host(bus, {});
  host.set_connected(false);
  sender.send(0, frame_of(0x16000003, 8, CanFormat::kClassic));
  bus.advance(1'000 * kUs);
  EXPECT_GT(sender.failures(), 3U);
  EXPECT_EQ(bus.counters().frames, 0U);
  host.set_connected(true);
  bus.advance(2'000 * kUs);
  EXPECT_EQ(host.take(2'000 * kUs).size(), 1U);
}

TEST(CanBus, EnforcesBitRatesAndFormats) {
  const auto delivered = [](const CanRates& sender_rates, const CanRates& host_rates, CanFormat format) {
    CanBus bus;
    CanTap sender(bus, sender_rates);
    CanTap host(bus, host_rates);
    CanTap third(bus, sender_rates);
    sender.send(0, frame_of(0x16000003, 8, format));
    bus.advance(20'000 * kUs);
    return !host.take(20'000 * kUs).empty();
  };
  const CanRates one_two{};
  const CanRates half{.nominal = can_bit_time(500'000)};
  const CanRates one_four{.data = can_bit_time(4'000'000)};
  const CanRates classic{.fd = false};
  EXPECT_TRUE(delivered(one_two, one_two, CanFormat::kFd));
  EXPECT_FALSE(delivered(one_two, half, CanFormat::kClassic));
  EXPECT_FALSE(delivered(one_two, one_four, CanFormat::kFd));
  EXPECT_TRUE(delivered(one_two, one_four, CanFormat::kClassic));
  EXPECT_FALSE(delivered(one_two, classic, CanFormat::kFd));
  EXPECT_TRUE(delivered(one_two, classic, CanFormat::kClassic));
}

TEST(CanLog, MatchesCandumpsFormat) {
  auto classic = frame_of(0x16000003, 3, CanFormat::kClassic);
  classic.data[0] = 0x01;
  classic.data[1] = 0xAB;
  classic.data[2] = 0xFF;
  EXPECT_EQ(candump_line({.t = 12'345'678 * kUs + 5, .frame = classic}),
            "(12.345678) can0 16000003#01ABFF\n");
  EXPECT_EQ(candump_line({.t = 7 * kUs, .frame = frame_of(0x16010003, 12, CanFormat::kFd, 0x00)}, "vcan1"),
            "(0.000007) vcan1 16010003##1000000000000000000000000\n");
  auto slow = frame_of(0x16010003, 0, CanFormat::kFd);
  slow.bit_rate_switch = false;
  EXPECT_EQ(candump_line({.t = 0, .frame = slow}), "(0.000000) can0 16010003##0\n");
}

}  // namespace
}  // namespace groma::sim
