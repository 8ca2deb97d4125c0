// SPI, registers, clocks and the transmitter of the chip model.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>

#include "test/sim/radio_bench.hpp"

namespace groma::sim {
namespace {

using testing::HasSubstr;

struct Dw1000ChipTest : testing::Test {
  RadioBench bench;
  HandDriven& radio = bench.add({.id = 1});
};

TEST_F(Dw1000ChipTest, ResetValuesAreTheManuals) {
  radio.chip().set_power(true, 0);
  radio.t = 3 * kMillisecond;
  EXPECT_EQ(radio.read(0x00, 0, 4), 0xDECA0130U);
  EXPECT_EQ(radio.read(0x03, 0, 4), 0xFFFFFFFFU);
  EXPECT_EQ(radio.read(0x04, 0, 4), 0x00001200U);
  EXPECT_EQ(radio.read(0x08, 0, 5), 0x15400CU);
  EXPECT_EQ(radio.read(0x1E, 0, 4), 0x1E080222U);
  EXPECT_EQ(radio.read(0x1F, 0, 4), 0x21040055U);
  EXPECT_EQ(radio.read(0x27, 0x08, 4), 0x311E0035U);
  EXPECT_EQ(radio.read(0x27, 0x20, 2), 0x1041U);
  EXPECT_EQ(radio.read(0x2B, 0x0E, 1), 0x60U);
  EXPECT_EQ(radio.read(0x36, 0x00, 4), 0xF0300200U);
  EXPECT_EQ(radio.read(0x36, 0x04, 4), 0x81020738U);
  EXPECT_EQ(radio.chip().fault(), "");
}

void start_converter(HandDriven& radio) {
  radio.write(0x28, 0x11, 0x80, 1);
  radio.write(0x28, 0x12, 0x0A, 1);
  radio.write(0x28, 0x12, 0x0F, 1);
  radio.write(0x2A, 0x00, 0x00, 1);
  radio.write(0x2A, 0x00, 0x01, 1);
}

TEST_F(Dw1000ChipTest, ItsConverterMeasuresTemperatureAndSupply) {
  radio.bring_up();
  radio.chip().set_ambient({.temperature_c = 23.0 + 1.14 * 20.0, .supply_v = 3.3 - 26.0 / 173.0});
  start_converter(radio);
  radio.t += kMillisecond;
  EXPECT_EQ(radio.read(0x2A, 0x03, 1), 0xA9U - 26U);
  EXPECT_EQ(radio.read(0x2A, 0x04, 1), 0x7DU + 20U);
  EXPECT_EQ(radio.chip().fault(), "");
}

TEST_F(Dw1000ChipTest, ItsConverterNeedsItsBiasAndItsTime) {
  radio.bring_up();
  start_converter(radio);
  radio.t += 500 * kMicrosecond;
  EXPECT_EQ(radio.read(0x2A, 0x04, 1), 0U);
  radio.t += 500 * kMicrosecond;
  EXPECT_EQ(radio.read(0x2A, 0x04, 1), 0x7DU);
  HandDriven& unbiased = bench.add({.id = 2});
  unbiased.bring_up();
  unbiased.write(0x2A, 0x00, 0x01, 1);
  unbiased.t += kMillisecond;
  EXPECT_EQ(unbiased.read(0x2A, 0x04, 1), 0U);
}

TEST_F(Dw1000ChipTest, DecodesEachFormOfHeader) {
  radio.bring_up();
  // One, two and three bytes of header, reads and writes, and a window in the middle of a register.
  radio.write(0x0A, 0, 0x1122334455, 5);
  EXPECT_EQ(radio.read(0x0A, 1, 2), 0x3344U);
  radio.write(0x2E, 0x1804, 0xBEEF, 2);
  EXPECT_EQ(radio.read(0x2E, 0x1804, 2), 0xBEEFU);
  EXPECT_EQ(radio.read(0x2E, 0x1804, 4), 0x0607BEEFU);  // LDE_CFG2 follows
  const std::vector<std::uint8_t> mosi{0x80 | 0x40 | 0x2E, 0x80 | 0x04, 0x30, 0x34, 0x12};
  std::vector<std::uint8_t> miso(mosi.size());
  radio.chip().transfer(radio.t, mosi, miso, radio.hz);
  EXPECT_EQ(radio.read(0x2E, 0x1804, 2), 0x1234U);
  const std::vector<std::uint8_t> ask{0x00, 0, 0, 0, 0};
  radio.chip().transfer(radio.t, ask, miso, radio.hz);
  EXPECT_EQ(miso, (std::vector<std::uint8_t>{0, 0x30, 0x01, 0xCA, 0xDE}));
  EXPECT_EQ(radio.chip().fault(), "");
}

TEST_F(Dw1000ChipTest, NamesAnUnknownRegister) {
  radio.bring_up();
  radio.read(0x2E, 0x1006, 2);
  EXPECT_THAT(radio.chip().fault(), HasSubstr("read of 2E:1006"));
}

TEST_F(Dw1000ChipTest, AnAccessBeyondARegistersEndIsCaught) {
  radio.bring_up();
  radio.write(0x18, 0, 0x123456, 3);
  EXPECT_THAT(radio.chip().fault(), HasSubstr("write to 18:0002"));
}

TEST_F(Dw1000ChipTest, AWriteToAReadOnlyRegisterIsCaught) {
  radio.bring_up();
  radio.write(0x15, 0, 0, 5);
  EXPECT_THAT(radio.chip().fault(), HasSubstr("RX_TIME"));
}

TEST_F(Dw1000ChipTest, AReadHeaderOnAWriteIsCaught) {
  radio.bring_up();
  const std::vector<std::uint8_t> header{0x0A};
  radio.chip().write(radio.t, header, std::vector<std::uint8_t>{1}, radio.hz);
  EXPECT_THAT(radio.chip().fault(), HasSubstr("header"));
}

TEST_F(Dw1000ChipTest, IsSilentUntilTheCrystalRuns) {
  radio.chip().set_power(true, 0);
  radio.hz = 2'000'000;
  radio.t = Dw1000Chip::kSpiReadyAfterReset - 1;
  EXPECT_EQ(radio.read(0x00, 0, 4), 0U);
  radio.t = Dw1000Chip::kSpiReadyAfterReset;
  EXPECT_EQ(radio.read(0x00, 0, 4), 0xDECA0130U);
}

TEST_F(Dw1000ChipTest, AFastBusBeforeThePllLocksGivesGarbage) {
  radio.chip().set_power(true, 0);
  radio.t = 2 * kMillisecond;
  radio.hz = 2'000'000;
  EXPECT_EQ(radio.status() & status::kCplock, 0U);
  radio.hz = 8'000'000;
  EXPECT_NE(radio.read(0x00, 0, 4), 0xDECA0130U);
  radio.write(0x18, 0, 1234, 2);
  radio.t = Dw1000Chip::kPllLockAfterReset;
  EXPECT_EQ(radio.read(0x18, 0, 2), 0U);
  EXPECT_NE(radio.status() & status::kCplock, 0U);
  EXPECT_EQ(radio.read(0x00, 0, 4), 0xDECA0130U);
  EXPECT_EQ(radio.chip().garbled_transfers(), 2U);
  // Transfers are garbled again when the clock is forced back to the crystal.
  radio.write(0x36, 0, 0x0201, 2);
  EXPECT_NE(radio.read(0x00, 0, 4), 0xDECA0130U);
  radio.hz = 3'000'000;
  EXPECT_EQ(radio.read(0x00, 0, 4), 0xDECA0130U);
}

TEST_F(Dw1000ChipTest, ReadsItsOneTimeWords) {
  radio.bring_up();
  radio.hz = 2'000'000;
  radio.write(0x36, 0, 0x0301, 2);
  for (const auto& [address, word] :
       {std::pair{0x06U, 0x10000001U}, std::pair{0x07U, 0x0D0D0001U}, std::pair{0x1EU, 0x10U}}) {
    radio.write(0x2D, 0x04, address, 2);
    radio.write(0x2D, 0x06, 0x0003, 2);
    radio.write(0x2D, 0x06, 0x0000, 2);
    EXPECT_EQ(radio.read(0x2D, 0x0A, 4), word);
  }
  EXPECT_EQ(radio.chip().fault(), "");
}

TEST_F(Dw1000ChipTest, ASoftResetRestoresAllRegisters) {
  radio.bring_up();
  radio.hz = 2'000'000;
  radio.write(0x36, 0x00, 0x01, 1);
  radio.write(0x36, 0x03, 0x00, 1);
  radio.t += 10 * kMicrosecond;
  radio.write(0x36, 0x03, 0xF0, 1);
  radio.write(0x36, 0x00, 0x00, 1);
  EXPECT_EQ(radio.read(0x1F, 0, 4), 0x21040055U);
  EXPECT_EQ(radio.status() & status::kCplock, 0U);
  radio.t += 11 * kMicrosecond;
  EXPECT_NE(radio.status() & status::kCplock, 0U);
  EXPECT_EQ(radio.chip().fault(), "");
}

TEST_F(Dw1000ChipTest, StatusBitsAreClearedByWritingOnes) {
  radio.bring_up();
  radio.load({1, 2, 3});
  radio.send_now();
  bench.run_until(radio.t + kMillisecond);
  const std::uint64_t all = status::kTxfrb | status::kTxprs | status::kTxphs | status::kTxfrs;
  EXPECT_EQ(radio.status() & all, all);
  radio.write(0x0F, 0, status::kTxprs, 4);
  EXPECT_EQ(radio.status() & all, all & ~status::kTxprs);
  radio.write(0x0F, 0, 0xF8, 1);
  EXPECT_EQ(radio.status() & all, 0U);
}

TEST_F(Dw1000ChipTest, TheInterruptLineFollowsMaskAndStatus) {
  radio.bring_up();
  radio.write(0x0F, 0, 0xFFFFFFFF, 4);
  radio.write(0x0E, 0, status::kTxfrs, 4);
  radio.load({1, 2, 3});
  radio.send_now();
  bench.run_until(radio.t + 100 * kMicrosecond);
  EXPECT_NE(radio.status() & status::kTxfrb, 0U);
  EXPECT_FALSE(radio.chip().irq());
  bench.run_until(radio.t + kMillisecond);
  EXPECT_TRUE(radio.chip().irq());
  EXPECT_NE(radio.status() & status::kIrqs, 0U);
  radio.write(0x0E, 0, 0, 4);
  EXPECT_FALSE(radio.chip().irq());
  radio.write(0x0E, 0, status::kTxfrs, 4);
  EXPECT_TRUE(radio.chip().irq());
  radio.write(0x0F, 0, status::kTxfrs, 4);
  EXPECT_FALSE(radio.chip().irq());
}

TEST_F(Dw1000ChipTest, SystemTimeCountsInStepsOf512) {
  radio.bring_up();
  const std::uint64_t before = radio.system_time();
  EXPECT_EQ(before % 512, 0U);
  radio.t += kMillisecond;
  EXPECT_NEAR(static_cast<double>(radio.system_time() - before), 63'897'600.0, 512.0);
}

// ---- quirks ---------------------------------------------------------------------------------------

constexpr std::uint64_t kPllFlags = status::kRfpllLl | status::kClkpllLl;

TEST(Dw1000Quirks, FalsePllFlagsComeAtTheirRate) {
  RadioBench bench;
  HandDriven& radio = bench.add({.id = 1, .quirks = {.false_pll_flags_per_minute = 60.0}});
  radio.bring_up();
  int flags = 0;
  std::uint64_t kinds = 0;
  for (int i = 0; i < 6'000; ++i) {
    bench.run_until(radio.t + 100 * kMillisecond);
    const std::uint64_t flag = radio.status() & kPllFlags;
    flags += flag != 0 ? 1 : 0;
    kinds |= flag;
    radio.write(0x0F, 0, flag, 4);
    EXPECT_EQ(radio.status() & kPllFlags, 0U);
  }
  // One a second; a step of 100 ms shows one flag at most.
  EXPECT_NEAR(flags, 6'000 * (1.0 - std::exp(-0.1)), 100.0);
  EXPECT_EQ(kinds, kPllFlags);
  EXPECT_EQ(radio.chip().fault(), "");
}

TEST(Dw1000Quirks, FalsePllFlagsFollowHalfOfTheLocks) {
  int flagged = 0;
  for (std::uint64_t seed = 1; seed <= 100; ++seed) {
    RadioBench bench({}, seed);
    HandDriven& radio = bench.add({.id = 1, .quirks = {.false_pll_flags_per_minute = 1e-3}});
    radio.chip().set_power(true, 0);
    bench.run_until(Dw1000Chip::kPllLockAfterReset + 500 * kMicrosecond);
    flagged += (radio.status() & kPllFlags) == status::kClkpllLl ? 1 : 0;
  }
  EXPECT_NEAR(flagged, 50, 20);
}

TEST(Dw1000Quirks, FalsePllFlagsDependOnTheSeed) {
  const auto first_flag_ms = [](std::uint64_t seed) {
    RadioBench bench({}, seed);
    HandDriven& radio = bench.add({.id = 1, .quirks = {.false_pll_flags_per_minute = 60.0}});
    radio.bring_up();
    radio.write(0x0F, 0, kPllFlags, 4);
    int ms = 0;
    for (; (radio.status() & kPllFlags) == 0; ++ms) bench.run_until(radio.t + kMillisecond);
    return ms;
  };
  EXPECT_EQ(first_flag_ms(1), first_flag_ms(1));
  EXPECT_NE(first_flag_ms(1), first_flag_ms(2));
}

struct SleepingChip : testing::Test {
  RadioBench bench;
  HandDriven& radio = bench.add({.id = 1, .quirks = {.asleep = true}});

  void SetUp() override {
    radio.chip().set_power(true, 0);
    radio.hz = 2'000'000;
    radio.t = 10 * kMillisecond;
  }
  void hold_select(SimTime duration) {
    radio.chip().select(radio.t, true);
    radio.t += duration;
    radio.chip().select(radio.t, false);
  }
  void reset() {
    radio.chip().reset(radio.t);
    radio.t += 3 * kMillisecond;
  }
  std::uint64_t device_id() { return radio.read(0x00, 0, 4); }
};

TEST_F(SleepingChip, OnlyALongSelectWakesIt) {
  EXPECT_EQ(device_id(), 0U);
  reset();
  EXPECT_EQ(device_id(), 0U);
  hold_select(499 * kMicrosecond);
  radio.t += 5 * kMillisecond;
  EXPECT_EQ(device_id(), 0U);
  hold_select(500 * kMicrosecond);
  radio.t += 3 * kMillisecond;
  EXPECT_EQ(device_id(), 0U);
  radio.t += kMillisecond;
  EXPECT_EQ(device_id(), 0xDECA0130U);
  EXPECT_FALSE(radio.chip().irq());
}

TEST_F(SleepingChip, SleepsAgainAtTheNextResetUnlessItsMemoryIsCleared) {
  for (const bool clear : {false, true}) {
    hold_select(600 * kMicrosecond);
    radio.t += 5 * kMillisecond;
    ASSERT_EQ(device_id(), 0xDECA0130U);
    if (clear) {
      radio.write(0x2C, 0x00, 0, 2);
      radio.write(0x2C, 0x06, 0, 1);
      radio.write(0x2C, 0x02, 0x02, 1);
    }
    reset();
    EXPECT_EQ(device_id() == 0xDECA0130U, clear);
    EXPECT_EQ(radio.chip().fault(), "");
  }
}

TEST_F(SleepingChip, ItsWakeUpSettingsHaveToBeClearedToo) {
  hold_select(600 * kMicrosecond);
  radio.t += 5 * kMillisecond;
  radio.write(0x2C, 0x06, 0, 1);
  radio.write(0x2C, 0x02, 0x02, 1);
  reset();
  EXPECT_THAT(radio.chip().fault(), HasSubstr("restores settings"));
}

// ---- transmitting ---------------------------------------------------------------------------------

TEST_F(Dw1000ChipTest, ADelayedTransmitIgnoresTheLowNineBits) {
  radio.bring_up();
  for (const std::uint64_t low : {0U, 1U, 255U, 511U}) {
    radio.load({1, 2, 3});
    const std::uint64_t target = (radio.system_time() + 40'000'000) & ~std::uint64_t{0x1FF};
    radio.send_at(target | low);
    EXPECT_EQ(radio.status() & (status::kHpdwarn | status::kTxpute), 0U);
    bench.run_until(radio.t + 2 * kMillisecond);
    EXPECT_NE(radio.status() & status::kTxfrs, 0U);
    EXPECT_EQ(radio.transmit_timestamp(), target + 16436);
    EXPECT_EQ(radio.read(0x17, 5, 5), target);
  }
  EXPECT_EQ(radio.chip().fault(), "");
}

TEST_F(Dw1000ChipTest, AFrameTakesItsAirTime) {
  struct Case {
    std::uint16_t preamble;
    std::size_t length;
    int expected_us;  // rounded
  };
  for (const Case& c :
       {Case{64, 12, 113}, Case{64, 127, 250}, Case{128, 20, 187}, Case{128, 100, 281}, Case{256, 64, 368}}) {
    RadioBench alone;
    HandDriven& sender = alone.add({.id = 1});
    sender.bring_up(c.preamble);
    sender.load(std::vector<std::uint8_t>(c.length - 2));
    const SimTime begin = sender.t;
    sender.send_now();
    alone.run_until(begin + Dw1000Chip::kTransmitterPowerUpTicks * 5 + SimTime{10} * 512 +
                    (c.expected_us + 1) * kMicrosecond);
    EXPECT_NE(sender.status() & status::kTxfrs, 0U) << c.preamble << ' ' << c.length;
    RadioBench again;
    HandDriven& early = again.add({.id = 1});
    early.bring_up(c.preamble);
    early.load(std::vector<std::uint8_t>(c.length - 2));
    early.send_now();
    again.run_until(begin + Dw1000Chip::kTransmitterPowerUpTicks * 5 + (c.expected_us - 1) * kMicrosecond);
    EXPECT_EQ(early.status() & status::kTxfrs, 0U) << c.preamble << ' ' << c.length;
  }
}

TEST_F(Dw1000ChipTest, ALateTransmitRaisesTheHalfPeriodWarning) {
  radio.bring_up();
  radio.load({1, 2, 3});
  radio.write(0x2F, 0, 1, 4);
  radio.send_at(radio.system_time());  // its preamble should have begun 138 us ago
  EXPECT_NE(radio.status() & status::kHpdwarn, 0U);
  EXPECT_EQ(radio.read(0x2F, 0x18, 2), 1U);
  bench.run_until(radio.t + 10 * kMillisecond);
  EXPECT_EQ(radio.status() & status::kTxfrb, 0U);
  radio.off();
  EXPECT_EQ(radio.status() & status::kHpdwarn, 0U);
  radio.t += kMillisecond;
  bench.run_until(radio.t + 20 * kUnitsPerSecond);
  EXPECT_EQ(radio.status() & status::kTxfrb, 0U);
}

TEST_F(Dw1000ChipTest, AnUncancelledLateTransmitComesAPeriodLater) {
  radio.bring_up();
  radio.load({1, 2, 3});
  const std::uint64_t target = radio.system_time() & ~std::uint64_t{0x1FF};
  radio.send_at(target);
  bench.run_until(radio.t + from_seconds(9.0));
  EXPECT_EQ(radio.status() & status::kHpdwarn, 0U) << "less than half a period to go";
  bench.run_until(radio.t + from_seconds(8.25));
  EXPECT_NE(radio.status() & status::kTxfrs, 0U);
  EXPECT_EQ(radio.transmit_timestamp(), (target + 16436) & kMask40);
}

// The manual's two cases of a late transmit: the preamble's start is past (HPDWARN), or it leaves too little
// time for the power-up (TXPUTE).
TEST_F(Dw1000ChipTest, TooLittleTimeForPowerUpIsReported) {
  radio.bring_up();
  const std::int64_t preamble = preamble_ticks(128);
  const auto attempt = [&](std::int64_t start_ahead_ticks) {
    radio.off();
    radio.t += kMillisecond;
    radio.load({1, 2, 3});
    radio.write(0x0F, 0, kMask40, 5);
    const std::uint64_t now = radio.system_time();
    radio.send_at(now + static_cast<std::uint64_t>(preamble + start_ahead_ticks + 511));
    return radio.status() & (status::kHpdwarn | status::kTxpute);
  };
  EXPECT_EQ(attempt(Dw1000Chip::kTransmitterPowerUpTicks + 1024), 0U);
  EXPECT_EQ(attempt(Dw1000Chip::kTransmitterPowerUpTicks - 1024), status::kTxpute);
  EXPECT_EQ(attempt(1024), status::kTxpute);
  EXPECT_EQ(attempt(-2048), status::kHpdwarn);
}

TEST(Dw1000Quirks, WithoutTimeForPowerUpNothingIsSent) {
  RadioBench bench;
  HandDriven& radio = bench.add({.id = 1, .quirks = {.missed_starts = true}});
  radio.bring_up();
  const auto send_in = [&](std::int64_t ticks) {
    radio.write(0x0F, 0, kMask40, 5);
    radio.load({1, 2, 3});
    radio.send_at(radio.system_time() + static_cast<std::uint64_t>(preamble_ticks(128) + ticks + 511));
    const std::uint64_t late = radio.status() & (status::kHpdwarn | status::kTxpute);
    bench.run_until(radio.t + 2 * kMillisecond);
    return late;
  };
  EXPECT_EQ(send_in(5 * std::int64_t{kTicksPerMicrosecond}), status::kTxpute);
  EXPECT_EQ(radio.status() & (status::kTxfrb | status::kTxfrs), 0U);
  radio.off();
  EXPECT_EQ(send_in(7 * std::int64_t{kTicksPerMicrosecond}), 0U);
  EXPECT_NE(radio.status() & status::kTxfrs, 0U);
  EXPECT_EQ(radio.chip().fault(), "");
}

TEST_F(Dw1000ChipTest, WithoutTheForcedClockADelayedTransmitNeverCompletes) {
  radio.bring_up();
  radio.load({1, 2, 3});
  radio.write(0x0A, 0, radio.system_time() + 40'000'000, 5);
  radio.write(0x0D, 0, 0x06, 1);
  bench.run_until(radio.t + 2 * kMillisecond);
  EXPECT_NE(radio.status() & status::kTxphs, 0U);
  EXPECT_EQ(radio.status() & status::kTxfrs, 0U) << "erratum TX-1";
}

TEST_F(Dw1000ChipTest, TransmitTimestampsWrapAtFortyBits) {
  RadioBench wrapping;
  HandDriven& late =
      wrapping.add({.id = 1, .clock = {.first_tick = (std::uint64_t{1} << 40) - 1'000'000'000}});
  late.bring_up();
  // 5 ms are 319 million ticks; 10.6 ms more to the wrap.
  late.load({1, 2, 3});
  const std::uint64_t target = 0x2000;
  EXPECT_GT(late.system_time(), std::uint64_t{1} << 39);
  late.send_at(target);
  EXPECT_EQ(late.status() & (status::kHpdwarn | status::kTxpute), 0U);
  wrapping.run_until(late.t + 12 * kMillisecond);
  EXPECT_NE(late.status() & status::kTxfrs, 0U);
  EXPECT_EQ(late.transmit_timestamp(), target + 16436);
  late.load({1, 2, 3});
  late.write(0x18, 0, 0xFFFF, 2);
  late.send_at((std::uint64_t{1} << 40) - 512);
  EXPECT_NE(late.status() & status::kHpdwarn, 0U) << "17 s away";
}

TEST_F(Dw1000ChipTest, InvalidCommandsAreCaught) {
  const auto fault_of = [](auto&& misuse) {
    RadioBench alone;
    HandDriven& r = alone.add({.id = 1});
    r.bring_up();
    r.load({1, 2, 3});
    misuse(r);
    return r.chip().fault();
  };
  EXPECT_THAT(fault_of([](HandDriven& r) {
                r.receive_now();
                r.send_now();
              }),
              HasSubstr("receiver is on"));
  EXPECT_THAT(fault_of([](HandDriven& r) {
                r.send_now();
                r.send_now();
              }),
              HasSubstr("pending"));
  EXPECT_THAT(fault_of([](HandDriven& r) {
                r.send_now();
                r.receive_now();
              }),
              HasSubstr("RXENAB"));
  EXPECT_THAT(fault_of([](HandDriven& r) {
                r.hz = 2'000'000;
                r.write(0x36, 0, 0x01, 1);
                r.send_now();
              }),
              HasSubstr("crystal"));
  EXPECT_THAT(fault_of([](HandDriven& r) { r.write(0x04, 0, 0x20001200, 4); }), HasSubstr("SYS_CFG"));
  EXPECT_THAT(fault_of([](HandDriven& r) { r.write(0x04, 0, 0x00000200, 4); }), HasSubstr("double"));
  EXPECT_THAT(fault_of([](HandDriven& r) { r.write(0x36, 3, 0x00, 1); }), HasSubstr("soft reset"));
  EXPECT_THAT(fault_of([](HandDriven& r) { r.write(0x2B, 0x0E, 0x10, 1); }), HasSubstr("FS_XTALT"));
  EXPECT_THAT(fault_of([](HandDriven& r) {
                r.write(0x08, 0, 0x0016C000 | 200, 5);
                r.send_now();
              }),
              HasSubstr("127"));
  EXPECT_EQ(fault_of([](HandDriven& r) { r.send_now(); }), "");
}

}  // namespace
}  // namespace groma::sim
