// The driver of the MCP2518FD and the link on top of it against the model of the chip.
#include <gtest/gtest.h>

#include <algorithm>
#include <random>
#include <span>
#include <vector>

#include "firmware/sim/mcp2518fd_chip.hpp"
#include "proto/frame_codec.hpp"
#include "test/sim/can_bench.hpp"

namespace groma::sim {
namespace {

using mcp2518fd::BringUp;
using mcp2518fd::Settings;
using test::CanModule;
using test::frame_of;
using wire::CanDirection;
using wire::CanFormat;

constexpr SimTime kMicrosecond = kUnitsPerMicrosecond;
constexpr SimTime kMs = kUnitsPerMillisecond;
constexpr SimTime kCanBit = can_bit_time(1'000'000);
constexpr SimTime kLong = 40 * kMs;
constexpr SimTime kRecovery = SimTime{128} * 11 * kCanBit;

using Bytes = std::vector<std::uint8_t>;

Bytes framed(std::size_t size, std::uint64_t seed) {
  std::mt19937_64 random(seed);
  Bytes payload(size);
  for (auto& byte : payload) byte = static_cast<std::uint8_t>(random());
  Bytes out(wire::max_encoded_size(size));
  out.resize(wire::encode_frame(payload, out));
  return out;
}

// Decodes the frames as the host does.
struct Host {
  wire::FrameDecoder decoder;
  std::vector<Bytes> payloads;

  void take(const std::vector<TimedCanFrame>& frames, std::uint16_t node) {
    for (const TimedCanFrame& timed : frames) {
      for (const std::uint8_t byte : wire::stream_in(timed.frame, {CanDirection::kToHost, node})) {
        if (decoder.push(byte)) payloads.emplace_back(decoder.payload().begin(), decoder.payload().end());
      }
    }
  }
};

class McpTest : public ::testing::TestWithParam<CanFormat> {
 protected:
  McpTest() : tap(bus, {}), module(bus) {}

  Settings settings() const { return {.node = 3, .format = GetParam()}; }
  void start() {
    ASSERT_EQ(module.start(settings()), BringUp::kOk) << module.chip.fault();
    ASSERT_EQ(module.chip.fault(), "");
  }
  void TearDown() override {
    EXPECT_EQ(module.chip.fault(), "");
    EXPECT_EQ(bus.fault(), "");
  }

  CanBus bus;
  CanTap tap;
  CanModule module;
};

INSTANTIATE_TEST_SUITE_P(Formats, McpTest, ::testing::Values(CanFormat::kClassic, CanFormat::kFd),
                         [](const auto& format) {
                           return format.param == CanFormat::kFd ? "Fd" : "Classic";
                         });

TEST_P(McpTest, CarriesFramesToTheHostWithoutLossInOrder) {
  start();
  Host host;
  std::vector<Bytes> sent;
  for (std::uint64_t i = 0; i < 200; ++i) {
    const Bytes frame = framed(20 + i % 150, i);
    ASSERT_TRUE(module.link.write(frame)) << i;
    wire::FrameDecoder decoder;
    for (const std::uint8_t byte : frame) {
      if (decoder.push(byte)) sent.emplace_back(decoder.payload().begin(), decoder.payload().end());
    }
    module.run(module.now + 10 * kMs);
    host.take(tap.take(module.now), 3);
  }
  module.run(module.now + 100 * kMs);
  host.take(tap.take(module.now), 3);
  EXPECT_EQ(host.payloads, sent);
  EXPECT_EQ(host.decoder.counters().bytes_discarded, 0U);
  EXPECT_EQ(bus.counters().errors, 0U);
  EXPECT_EQ(module.link.counters().frames_sent, bus.counters().frames);
}

TEST_P(McpTest, SendsExtendedFramesOfItsFormat) {
  start();
  ASSERT_TRUE(module.link.write(framed(30, 1)));
  module.run(module.now + 10 * kMs);
  const auto frames = tap.take(module.now);
  ASSERT_FALSE(frames.empty());
  for (const TimedCanFrame& timed : frames) {
    EXPECT_EQ(timed.frame.id, 0x16000003U);
    EXPECT_EQ(timed.frame.format, GetParam());
    EXPECT_EQ(timed.frame.bit_rate_switch, GetParam() == CanFormat::kFd);
  }
}

TEST_P(McpTest, FillsTheBusWhenTheQueueIsFull) {
  start();
  Host host;
  const SimTime begin = module.now;
  const SimTime busy = bus.counters().busy;
  const std::size_t transfers = module.spi.transfers;
  std::uint64_t refused = 0;
  for (std::uint64_t i = 0; i < 2'000; ++i) {
    if (!module.link.write(framed(150, i))) ++refused;
    module.run(module.now + 300 * kMicrosecond);
    host.take(tap.take(module.now), 3);
  }
  EXPECT_GT(refused, 100U);
  EXPECT_EQ(host.decoder.counters().bytes_discarded, 0U);
  // Two transfers per frame, and a few to check for room.
  EXPECT_LT(module.spi.transfers - transfers, module.link.counters().frames_sent * 11 / 4);
  // Frames follow each other: the bus is idle only where a write was refused.
  EXPECT_GT(static_cast<double>(bus.counters().busy - busy), 0.97 * static_cast<double>(module.now - begin));
}

TEST_P(McpTest, ReceivesOnlyTheFramesToItsNode) {
  start();
  const Bytes command = framed(100, 4);
  std::uint32_t pieces = 0;
  std::span<const std::uint8_t> left(command);
  while (!left.empty()) {
    wire::CanFrame frame;
    frame.id = wire::can_id({CanDirection::kToNode, 3});
    left = left.subspan(wire::cut_can_payload(left, GetParam(), frame));
    tap.send(module.now, frame);
    // Frames to others, which must not come through.
    frame.id = wire::can_id({CanDirection::kToNode, 2});
    tap.send(module.now, frame);
    frame.id = wire::can_id({CanDirection::kToHost, 7});
    tap.send(module.now, frame);
    frame.id = wire::can_id({CanDirection::kToHost, 3});
    tap.send(module.now, frame);
    ++pieces;
    frame.id = wire::can_id({CanDirection::kToNode, 3}) ^ (1U << 28);
    tap.send(module.now, frame);
  }
  module.run(module.now + 30 * kMs);
  ASSERT_GE(module.received.size(), command.size());
  EXPECT_TRUE(std::equal(command.begin(), command.end(), module.received.begin()));
  EXPECT_EQ(std::count(module.received.begin() + static_cast<std::ptrdiff_t>(command.size()),
                       module.received.end(), 0),
            static_cast<std::ptrdiff_t>(module.received.size() - command.size()));
  // The chip's filter has kept the others out: they never crossed the SPI.
  EXPECT_EQ(module.link.counters().frames_received, pieces);
  EXPECT_FALSE(module.chip.irq());
}

TEST_P(McpTest, CountsReceiveOverrunsAndContinues) {
  start();
  wire::CanFrame frame = frame_of(wire::can_id({CanDirection::kToNode, 3}), 8, GetParam());
  for (int i = 0; i < 50; ++i) tap.send(module.now, frame);
  module.now += 50 * kMs;  // the processor does not serve the chip
  module.run(module.now + 10 * kMs);
  EXPECT_EQ(module.link.counters().receive_overruns, 1U);
  EXPECT_EQ(module.link.counters().frames_received, GetParam() == CanFormat::kFd ? 8U : 32U);
  tap.send(module.now, frame);
  module.run(module.now + 10 * kMs);
  EXPECT_EQ(module.link.counters().frames_received, GetParam() == CanFormat::kFd ? 9U : 33U);
  EXPECT_FALSE(module.chip.irq());
}

TEST_P(McpTest, KeepsEachStepWithinItsBounds) {
  start();
  std::mt19937_64 random(5);
  module.longest_step = 0;
  module.most_bytes = module.most_transfers = 0;
  for (std::uint64_t i = 0; i < 500; ++i) {
    (void)module.link.write(framed(10 + random() % 400, i));
    if (random() % 3 == 0) tap.send(module.now, frame_of(0x16010003, 8, GetParam()));
    if (i == 200) bus.damage(module.now, module.now + 30 * kMs);
    module.run(module.now + static_cast<SimTime>(random() % 3'000) * kMicrosecond);
  }
  EXPECT_GE(module.link.counters().bus_offs, 1U);
  EXPECT_LE(module.most_bytes, 230U);
  EXPECT_LE(module.most_transfers, 13U);
  EXPECT_LE(module.longest_step, (GetParam() == CanFormat::kFd ? 270 : 160) * kMicrosecond);
}

TEST_P(McpTest, RecoversFromBusOffByItself) {
  start();
  Host host;
  std::uint64_t seed = 0;
  const auto feed = [&](SimTime duration) {
    const SimTime until = module.now + duration;
    while (module.now < until) {
      (void)module.link.write(framed(60, seed++));
      module.run(module.now + 5 * kMs);
      host.take(tap.take(module.now), 3);
    }
  };
  feed(100 * kMs);
  const std::size_t before = host.payloads.size();
  EXPECT_EQ(host.decoder.counters().bytes_discarded, 0U);
  bus.damage(module.now, module.now + 300 * kMs);
  feed(300 * kMs);
  EXPECT_EQ(host.payloads.size(), before);
  EXPECT_GE(module.link.counters().bus_offs, 3U);
  // Each attempt costs 32 failed frames; the waits between them double from 10 ms on.
  EXPECT_LE(module.link.counters().bus_offs, 6U);
  feed(400 * kMs);
  const std::size_t after = host.payloads.size();
  EXPECT_GT(after, before);
  feed(1'000 * kMs);
  EXPECT_GE(host.payloads.size(), after + 195);
  EXPECT_EQ(module.chip.transmit_errors(), 0U);
  EXPECT_EQ(module.link.counters().errors.transmit, 0U);
  EXPECT_EQ(module.link.counters().restarts, 0U);
  // For each bus-off the host sees at most one torn frame.
  const auto& seen = host.decoder.counters();
  EXPECT_LE(seen.crc_errors + seen.cobs_errors + seen.truncated, module.link.counters().bus_offs);
}

TEST_P(McpTest, SurvivesAShortCircuit) {
  start();
  bus.hold_dominant(module.now, module.now + 100 * kMs);
  (void)module.link.write(framed(60, 1));
  module.run(module.now + 100 * kMs);
  EXPECT_EQ(module.link.counters().bus_offs, 1U);
  EXPECT_TRUE(module.chip.bus_off());
  module.run(module.now + 2 * kMs);
  EXPECT_FALSE(module.chip.bus_off());
  const Bytes frame = framed(60, 2);
  ASSERT_TRUE(module.link.write(frame));
  module.run(module.now + 10 * kMs);
  Host host;
  host.take(tap.take(module.now), 3);
  // The controller's content is lost and is not sent later.
  wire::FrameDecoder decoder;
  for (const std::uint8_t byte : frame) (void)decoder.push(byte);
  EXPECT_EQ(host.payloads, std::vector<Bytes>({Bytes(decoder.payload().begin(), decoder.payload().end())}));
}

TEST_P(McpTest, RetriesUntilSomebodyAcknowledges) {
  tap.set_connected(false);
  start();
  ASSERT_TRUE(module.link.write(framed(20, 1)));
  module.run(module.now + 500 * kMs);
  EXPECT_FALSE(module.chip.bus_off());
  EXPECT_EQ(module.chip.transmit_errors(), 128U);
  EXPECT_EQ(module.link.counters().bus_offs, 0U);
  ASSERT_TRUE(module.link.write(framed(20, 2)));
  module.run(module.now + 10 * kMs);
  EXPECT_TRUE(module.link.empty()) << "an error-passive controller takes frames";
  tap.set_connected(true);
  module.run(module.now + 10 * kMs);
  Host host;
  host.take(tap.take(module.now), 3);
  EXPECT_EQ(host.payloads.size(), 2U);
}

TEST_P(McpTest, ReinitializesAChipAfterAPowerLoss) {
  start();
  ASSERT_TRUE(module.link.write(framed(20, 1)));
  module.run(module.now + 5 * kMs);
  module.chip.set_power(false, module.now);
  module.now += 20 * kMs;
  module.chip.set_power(true, module.now);
  module.now += 5 * kMs;
  module.run(module.now + 200 * kMs);
  EXPECT_EQ(module.link.counters().restarts, 1U);
  Host host;
  (void)tap.take(module.now);
  ASSERT_TRUE(module.link.write(framed(20, 2)));
  module.run(module.now + 10 * kMs);
  host.take(tap.take(module.now), 3);
  EXPECT_EQ(host.payloads.size(), 1U);
}

TEST_P(McpTest, CanBeRestartedWithOtherSettingsDuringTraffic) {
  start();
  for (int i = 0; i < 5; ++i) (void)module.link.write(framed(200, 1));
  module.run(module.now + 1 * kMs);
  ASSERT_EQ(module.start({.node = 4, .format = CanFormat::kClassic}), BringUp::kOk);
  (void)tap.take(module.now);
  ASSERT_TRUE(module.link.write(framed(20, 2)));
  module.run(module.now + 10 * kMs);
  Host host;
  host.take(tap.take(module.now), 4);
  EXPECT_EQ(host.payloads.size(), 1U);
}

TEST_P(McpTest, UsesTheWholeTransmitFifo) {
  tap.set_connected(false);
  start();
  for (int i = 0; i < 10; ++i) (void)module.link.write(framed(140, 1));
  module.run(module.now + 50 * kMs);
  EXPECT_EQ(module.link.counters().frames_sent, GetParam() == CanFormat::kFd ? 20U : 32U);
}

TEST_P(McpTest, RefusesAFrameThatDoesNotFitWhole) {
  start();
  tap.set_connected(false);
  std::size_t accepted = 0;
  while (module.link.write(framed(100, accepted))) ++accepted;
  EXPECT_EQ(accepted, decltype(module.link)::kQueueBytes / framed(100, 0).size());
  EXPECT_TRUE(module.link.write(framed(1, 0)));
}

TEST(McpBringUp, ReportsWhatFailed) {
  const auto result_of = [](const Mcp2518fdSpec& spec, const Settings& settings = {.node = 3}) {
    CanBus bus;
    CanTap tap(bus, {});
    CanModule module(bus, spec);
    return module.start(settings);
  };
  EXPECT_EQ(result_of({}), BringUp::kOk);
  EXPECT_EQ(result_of({.oscillates = false}), BringUp::kNoClock);
  EXPECT_EQ(result_of({.is_mcp2517fd = true}), BringUp::kOtherChip);
  EXPECT_EQ(result_of({.keeps_ram = false}), BringUp::kNotWritable);
  EXPECT_EQ(result_of({}, {.node = 3, .nominal_bit_per_s = 333'333}), BringUp::kNoBitRate);
  EXPECT_EQ(result_of({}, {.node = 3, .format = CanFormat::kFd, .data_bit_per_s = 1}), BringUp::kNoBitRate);
  {
    CanBus bus;
    CanModule module(bus);
    module.chip.set_power(false, 0);
    EXPECT_EQ(module.start({.node = 3}), BringUp::kNoChip);
    EXPECT_FALSE(module.link.write(framed(1, 1)));
    EXPECT_FALSE(module.service());
  }
  {
    CanBus bus;
    CanModule module(bus);
    bus.hold_dominant(0, 1'000 * kMs);
    EXPECT_EQ(module.start({.node = 3}), BringUp::kBusNotIdle);
  }
  for (int i = 0; i <= static_cast<int>(BringUp::kBusNotIdle); ++i) {
    const std::string text = describe(static_cast<BringUp>(i));
    EXPECT_LE(text.size(), 31U) << text;
    EXPECT_EQ(text.empty(), i == 0);
  }
}

TEST(McpBringUp, WorksAtEachUsualBitRate) {
  for (const std::uint32_t nominal : {1'000'000U, 500'000U, 250'000U, 125'000U}) {
    for (const std::uint32_t data : {0U, 1'000'000U, 2'000'000U, 4'000'000U, 5'000'000U, 8'000'000U}) {
      CanBus bus;
      const std::uint32_t data_rate = data == 0 ? 2'000'000U : data;
      CanTap tap(bus, {.nominal = can_bit_time(nominal), .data = can_bit_time(data_rate)});
      CanModule module(bus);
      ASSERT_EQ(module.start({.node = 3,
                              .format = data == 0 ? CanFormat::kClassic : CanFormat::kFd,
                              .nominal_bit_per_s = nominal,
                              .data_bit_per_s = data_rate}),
                BringUp::kOk);
      ASSERT_TRUE(module.link.write(framed(100, 1)));
      module.run(module.now + 50 * kMs);
      Host host;
      host.take(tap.take(module.now), 3);
      EXPECT_EQ(host.payloads.size(), 1U) << nominal << " " << data;
      EXPECT_EQ(module.chip.fault(), "");
    }
  }
}

// ---- the model's own strictness ---------------------------------------------------------------------------

class McpChipTest : public ::testing::Test {
 protected:
  McpChipTest() : tap(bus, {}), chip(bus, {}) {
    chip.set_power(true, 0);
    now = 5 * kMs;
  }
  Bytes transfer(Bytes bytes, std::uint32_t hz = 8'000'000) {
    now += 10 * kMicrosecond;
    Bytes in(bytes.size());
    chip.transfer(now, bytes, in, hz);
    return in;
  }
  std::uint32_t read(unsigned address) {
    const Bytes in = transfer(
        {static_cast<std::uint8_t>(0x30U | address >> 8), static_cast<std::uint8_t>(address), 0, 0, 0, 0});
    return in[2] | static_cast<std::uint32_t>(in[3]) << 8 | static_cast<std::uint32_t>(in[4]) << 16 |
           static_cast<std::uint32_t>(in[5]) << 24;
  }
  void write(unsigned address, std::uint32_t word) {
    transfer({static_cast<std::uint8_t>(0x20U | address >> 8), static_cast<std::uint8_t>(address),
              static_cast<std::uint8_t>(word), static_cast<std::uint8_t>(word >> 8),
              static_cast<std::uint8_t>(word >> 16), static_cast<std::uint8_t>(word >> 24)});
  }

  CanBus bus;
  CanTap tap;
  Mcp2518fdChip chip;
  SimTime now = 0;
};

TEST_F(McpChipTest, HasTheDataSheetsResetValues) {
  EXPECT_EQ(read(0x000), 0x04980760U);
  EXPECT_EQ(read(0x004), 0x003E0F0FU);
  EXPECT_EQ(read(0x008), 0x000E0303U);
  EXPECT_EQ(read(0x00C), 0x00021000U);
  EXPECT_EQ(read(0x034), 0x00200000U);
  EXPECT_EQ(read(0x05C), 0x00600400U);
  EXPECT_EQ(read(0xE00), 0x00000460U);
  EXPECT_EQ(chip.fault(), "");
}

TEST_F(McpChipTest, FaultsWhatIsNotModelled) {
  (void)read(0x038);
  EXPECT_NE(chip.fault().find("0x038"), std::string::npos);
}

TEST_F(McpChipTest, FaultsHalfAWordOfRam) {
  transfer({0x24, 0x00, 1, 2, 3});
  EXPECT_NE(chip.fault().find("whole words"), std::string::npos);
}

TEST_F(McpChipTest, FaultsATooFastBus) {
  transfer({0x30, 0x00, 0, 0, 0, 0}, 17'000'000);
  EXPECT_EQ(chip.fault(), "");
  transfer({0x30, 0x00, 0, 0, 0, 0}, 18'000'000);
  EXPECT_NE(chip.fault().find("18000000 Hz"), std::string::npos);
}

TEST_F(McpChipTest, FaultsBitTimingChangedOnTheBus) {
  write(0x000, 0x06000760);
  now += kMs;
  EXPECT_EQ(read(0x000) >> 21 & 7, 6U);
  write(0x004, 0x001E0707);
  EXPECT_NE(chip.fault().find("CiNBTCFG"), std::string::npos);
}

TEST_F(McpChipTest, FaultsALateSamplePoint) {
  write(0x004, 0x00260000);
  write(0x000, 0x06000760);
  EXPECT_NE(chip.fault().find("sampled"), std::string::npos);
}

TEST_F(McpChipTest, FaultsAResetOnTheBus) {
  write(0x000, 0x06000760);
  now += kMs;
  (void)read(0x000);
  transfer({0x00, 0x00});
  EXPECT_NE(chip.fault().find("reset"), std::string::npos);
}

TEST_F(McpChipTest, FindsARamWordThatWasNeverWritten) {
  write(0xE0C, 0x00000007);
  (void)read(0x400);
  EXPECT_TRUE((read(0x01C) & 1U << 8) != 0);
  EXPECT_EQ(read(0xE10) & 6U, 4U);
  EXPECT_EQ(chip.fault(), "");
}

TEST_F(McpChipTest, WaitsForElevenRecessiveBitsBeforeItJoins) {
  write(0x004, 0x001E0707);
  write(0x000, 0x06000760);
  EXPECT_EQ(read(0x000) >> 21 & 7, 4U);
  now += 11 * kCanBit;
  EXPECT_EQ(read(0x000) >> 21 & 7, 6U);
}

TEST_F(McpChipTest, RecoversFromBusOffAfter128Times11RecessiveBits) {
  write(0x004, 0x001E0707);
  write(0x05C, 0x07600080);
  write(0x000, 0x06000760);
  now += kMs;
  (void)read(0x000);
  write(0x400, 0x16);
  write(0x404, 0x18);
  write(0x408, 0);
  write(0x40C, 0);
  transfer({0x20, 0x5D, 0x03});
  const SimTime quiet = now + kLong;
  bus.hold_dominant(now, quiet);
  SimTime t = now;
  while (!chip.bus_off() && t < quiet) chip.advance(t += kMicrosecond);
  // 32 failures of 8 each take it beyond 255.
  EXPECT_EQ(bus.counters().errors, 32U);
  now = t;
  EXPECT_TRUE((read(0x034) & 1U << 21) != 0);
  EXPECT_EQ(read(0x060) & 4U, 4U);  // emptied
  EXPECT_EQ(chip.next_event(), kNever);
  chip.advance(quiet);
  EXPECT_EQ(chip.next_event(), quiet + kRecovery);
  chip.advance(quiet + kRecovery - 1);
  EXPECT_TRUE(chip.bus_off());
  chip.advance(quiet + kRecovery);
  EXPECT_FALSE(chip.bus_off());
  EXPECT_EQ(chip.transmit_errors(), 0U);
  EXPECT_EQ(chip.fault(), "");
}

TEST_F(McpChipTest, CountsTheEndOfEachFrameForItsRecovery) {
  write(0x004, 0x001E0707);
  write(0x05C, 0x07600080);
  write(0x000, 0x06000760);
  now += kMs;
  (void)read(0x000);
  for (const unsigned address : {0x400U, 0x408U, 0x40CU}) write(address, 0x16);
  write(0x404, 0x18);
  transfer({0x20, 0x5D, 0x03});
  const SimTime quiet = now + kLong;
  bus.hold_dominant(now, quiet);
  chip.advance(quiet);
  ASSERT_TRUE(chip.bus_off());
  // Others send without a pause: each of their frames gives one sequence of 11 bits and no more.
  CanTap talker(bus, {});
  for (int i = 0; i < 200; ++i) talker.send(quiet, frame_of(0x16000005, 8, CanFormat::kClassic));
  SimTime t = quiet;
  while (chip.bus_off()) chip.advance(t += 10 * kMicrosecond);
  EXPECT_EQ(200U - talker.waiting(), 128U);
}

}  // namespace
}  // namespace groma::sim
