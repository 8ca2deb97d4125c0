// Each peripheral alone, driven register by register.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>

#include "test/sim/emulator/soc_bench.hpp"

namespace groma::sim {
namespace {

using ::testing::Each;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

constexpr std::uint32_t kReloadKey = 0x6E524635;

// ---- strictness -----------------------------------------------------------------------------------------

TEST(Soc, FailsTheRunForRegistersThatAreNotModelled) {
  SocBench bench;
  const auto complaint = SocBench::error_of([&] { bench.read(reg::kTimer + 0x300); });
  EXPECT_THAT(complaint, HasSubstr("0x40008300"));
  EXPECT_THAT(complaint, HasSubstr("PC 0x00001234"));
  // A peripheral that the board does not use.
  EXPECT_THAT(SocBench::error_of([&] { bench.write(0x40011000, 1); }), HasSubstr("0x40011000"));
  EXPECT_THAT(SocBench::error_of([&] { bench.write(reg::kUarte + 0x504, 1); }), HasSubstr("0x40002504"));
  EXPECT_THAT(SocBench::error_of([&] { bench.write(0x10000060, 1); }), HasSubstr("FICR cannot be written"));
  EXPECT_THAT(SocBench::error_of([&] { bench.read(0x10000020); }), HasSubstr("0x10000020"));
  EXPECT_THAT(SocBench::error_of([&] { bench.soc.write(reg::kP0 + 0x508, 1, 1); }), HasSubstr("as words"));
}

TEST(Soc, IsABusFaultOutsideTheMemoryMap) {
  SocBench bench;
  std::uint32_t value = 0;
  for (const std::uint32_t address : {0x40027000U, 0x40080000U, 0x50001000U, 0x5FFFFFFCU}) {
    EXPECT_FALSE(bench.soc.read(address, 4, value)) << hexadecimal(address);
    EXPECT_FALSE(bench.soc.write(address, 4, 0)) << hexadecimal(address);
  }
}

TEST(Soc, ReportsItsIdentity) {
  SocBench bench;
  bench.uicr[0x200] = 21;
  EXPECT_EQ(bench.read(0x10000060), 0x89ABCDEFU);
  EXPECT_EQ(bench.read(0x10000064), 0x01234567U);
  EXPECT_EQ(bench.read(0x10000100), 0x52832U);
  EXPECT_EQ(bench.read(0x10001200), 0xFFFFFF15U);
  EXPECT_EQ(bench.read(0x10001208), 0xFFFFFFFFU);
}

// ---- CLOCK and POWER ------------------------------------------------------------------------------------

TEST(ClockPower, StartsItsCrystalsInTheirTime) {
  SocBench bench;
  bench.run_us(330);
  bench.write(reg::kPower + 0x518, 1);
  bench.write(reg::kPower + 0x304, 1);
  bench.write(reg::kPower + 0x000, 1);
  bench.write(reg::kPower + 0x008, 1);
  bench.run_us(359);
  EXPECT_EQ(bench.read(reg::kPower + 0x100), 0U);
  EXPECT_EQ(bench.read(reg::kPower + 0x40C), 0x00010000U);
  bench.run_us(2);
  EXPECT_EQ(bench.read(reg::kPower + 0x100), 1U);
  EXPECT_EQ(bench.read(reg::kPower + 0x40C), 0x00010001U);
  EXPECT_TRUE(bench.irq(0));
  bench.write(reg::kPower + 0x100, 0);
  EXPECT_FALSE(bench.irq(0));
  EXPECT_EQ(bench.read(reg::kPower + 0x418), 0U);
  bench.run_us(250'000);
  EXPECT_EQ(bench.read(reg::kPower + 0x104), 1U);
  EXPECT_EQ(bench.read(reg::kPower + 0x418), 0x00010001U);
  EXPECT_THAT(SocBench::error_of([&] { bench.write(reg::kPower + 0x518, 0); }), HasSubstr("LFCLKSRC"));
}

TEST(ClockPower, DoesNotStartTheSlowClockSoonAfterItStopped) {
  ClockPower clock(SiliconQuirks{});
  clock.reset(ResetCause::kPin, 0);
  const auto start = [&](SimTime t) { EXPECT_TRUE(clock.write(t, 0x008, 1)); };
  EXPECT_THAT(SocBench::error_of([&] { start(ClockPower::kLfclkRestart - 1); }), HasSubstr("anomaly 132"));
  start(ClockPower::kLfclkRestart);
  EXPECT_TRUE(clock.write(kMillisecond, 0x00C, 1));
  EXPECT_THAT(SocBench::error_of([&] { start(kMillisecond + 138 * kMicrosecond); }),
              HasSubstr("anomaly 132"));
  start(kMillisecond + ClockPower::kLfclkRestart);
  ClockPower other({.lfclk_restart = false});
  EXPECT_TRUE(other.write(0, 0x008, 1));
}

TEST(ClockPower, GathersResetReasonsUntilTheyAreWrittenBack) {
  SocBench bench;
  EXPECT_EQ(bench.read(reg::kPower + 0x400), 0U);
  bench.write(reg::kPower + 0x51C, 0x5A);
  bench.soc.reset(ResetCause::kSoftware, bench.processor.t);
  EXPECT_EQ(bench.read(reg::kPower + 0x400), 4U);
  EXPECT_EQ(bench.read(reg::kPower + 0x51C), 0x5AU);
  bench.soc.reset(ResetCause::kWatchdog, bench.processor.t);
  EXPECT_EQ(bench.read(reg::kPower + 0x400), 6U);
  EXPECT_EQ(bench.read(reg::kPower + 0x51C), 0U);
  bench.write(reg::kPower + 0x400, 2);
  EXPECT_EQ(bench.read(reg::kPower + 0x400), 4U);
  bench.soc.reset(ResetCause::kPowerOn, bench.processor.t);
  EXPECT_EQ(bench.read(reg::kPower + 0x400), 0U);
}

// ---- P0 and GPIOTE --------------------------------------------------------------------------------------

TEST(Gpio, DrivesItsPinsAndReadsThem) {
  SocBench bench;
  EXPECT_EQ(bench.read(reg::kP0 + 0x700 + 4 * 14), 2U);
  bench.write(reg::kP0 + 0x508, 1U << 14);
  bench.write(reg::kP0 + 0x700 + 4 * 14, 1);
  EXPECT_FALSE(bench.soc.lit(0));
  EXPECT_EQ(bench.read(reg::kP0 + 0x510), 1U << 14);
  bench.write(reg::kP0 + 0x50C, 1U << 14);
  EXPECT_TRUE(bench.soc.lit(0));
  EXPECT_EQ(bench.read(reg::kP0 + 0x504), 0U);
  EXPECT_EQ(bench.read(reg::kP0 + 0x514), 1U << 14);
  bench.write(reg::kP0 + 0x51C, 1U << 14);
  EXPECT_FALSE(bench.soc.lit(0));
  // An undriven input reads its pull; with its buffer off it reads 0.
  bench.write(reg::kP0 + 0x700 + 4 * 2, 0xC);
  EXPECT_EQ(bench.read(reg::kP0 + 0x510), 1U << 2);
  bench.write(reg::kP0 + 0x700 + 4 * 2, 0xE);
  EXPECT_EQ(bench.read(reg::kP0 + 0x510), 0U);
  EXPECT_THAT(SocBench::error_of([&] { bench.write(reg::kP0 + 0x700, 0x20000); }), HasSubstr("PIN_CNF[0]"));
}

TEST(Gpio, HoldsTheRadioInResetAndMustNotDriveItHigh) {
  SocBench bench;
  bench.run_us(5000);
  const std::int64_t before = bench.chip.ticks(bench.processor.t);
  bench.write(reg::kP0 + 0x518, 1U << 24);
  bench.run_us(100);
  bench.write(reg::kP0 + 0x51C, 1U << 24);
  EXPECT_LT(bench.chip.ticks(bench.processor.t), 10);
  EXPECT_GT(before, 300'000'000);
  bench.write(reg::kP0 + 0x508, 1U << 24);
  EXPECT_THAT(SocBench::error_of([&] { bench.write(reg::kP0 + 0x518, 1U << 24); }),
              HasSubstr("reset line high"));
}

TEST(Gpio, MayOpenTheDrainOfTheRadiosReset) {
  SocBench bench;
  // S0D1: high is not driven.
  bench.write(reg::kP0 + 0x508, 1U << 24);
  bench.write(reg::kP0 + 0x700 + 4 * 24, 6U << 8 | 1);
  EXPECT_EQ(bench.soc.gpio().drive(24), PinDrive::kFloating);
}

TEST(Gpiote, RaisesEventsOnTheConfiguredEdges) {
  SocBench bench;
  bench.can.raises_interrupt = true;
  bench.write(reg::kP0 + 0x700 + 4 * 27, 0);
  bench.write(reg::kGpiote + 0x514, 2U << 16 | 27U << 8 | 1);
  bench.write(reg::kGpiote + 0x304, 2);
  EXPECT_FALSE(bench.irq(6));
  // The chip's line is active low; a transfer asserts it.
  for (const auto& [offset, value] :
       {std::pair{0x508U, 4U}, {0x50CU, 6U}, {0x510U, 7U}, {0x534U, 0x20000100U}, {0x538U, 2U}, {0x500U, 7U}})
    bench.write(reg::kSpim1 + offset, value);
  bench.write(reg::kP0 + 0x518, 1U << 3);
  bench.write(reg::kP0 + 0x700 + 4 * 4, 1);
  bench.write(reg::kSpim1 + 0x10, 1);
  EXPECT_FALSE(bench.irq(6));
  bench.run_us(100);
  EXPECT_TRUE(bench.irq(6));
  EXPECT_EQ(bench.read(reg::kGpiote + 0x104), 1U);
  EXPECT_EQ(bench.read(reg::kGpiote + 0x100), 0U);
  bench.write(reg::kGpiote + 0x104, 0);
  EXPECT_FALSE(bench.irq(6));
  EXPECT_THAT(SocBench::error_of([&] { bench.write(reg::kGpiote + 0x510, 3); }), HasSubstr("CONFIG[0]"));
}

// ---- TIMER0 ---------------------------------------------------------------------------------------------

struct TimerBench : SocBench {
  TimerBench() {
    write(reg::kTimer + 0x508, 3);
    write(reg::kTimer + 0x510, 4);
  }
  std::uint32_t capture() {
    write(reg::kTimer + 0x44, 1);
    return read(reg::kTimer + 0x544);
  }
};

TEST(Timer, CountsMicrosecondsAndSignalsAMatch) {
  TimerBench bench;
  bench.write(reg::kTimer + 0x540, 1000);
  bench.write(reg::kTimer + 0x304, 1U << 16);
  bench.write(reg::kTimer + 0x000, 1);
  bench.run_us(999.9);
  EXPECT_EQ(bench.capture(), 999U);
  EXPECT_FALSE(bench.irq(8));
  bench.run_us(0.2);
  EXPECT_EQ(bench.capture(), 1000U);
  EXPECT_TRUE(bench.irq(8));
  EXPECT_EQ(bench.read(reg::kTimer + 0x140), 1U);
  bench.write(reg::kTimer + 0x140, 0);
  EXPECT_FALSE(bench.irq(8));
  // A compare value that is past or current matches only after the counter has wrapped.
  bench.write(reg::kTimer + 0x540, 1000);
  bench.run_us(2e6);
  EXPECT_FALSE(bench.irq(8));
}

TEST(Timer, StopsClearsAndContinues) {
  TimerBench bench;
  bench.write(reg::kTimer + 0x000, 1);
  bench.run_us(50.5);
  bench.write(reg::kTimer + 0x004, 1);
  bench.run_us(100);
  EXPECT_EQ(bench.capture(), 50U);
  bench.write(reg::kTimer + 0x000, 1);
  bench.run_us(10.5);
  EXPECT_EQ(bench.capture(), 60U);
  bench.write(reg::kTimer + 0x00C, 1);
  bench.run_us(3.5);
  EXPECT_EQ(bench.capture(), 3U);
  EXPECT_THAT(SocBench::error_of([&] { bench.write(reg::kTimer + 0x510, 1); }), HasSubstr("PRESCALER"));
}

TEST(Timer, RepeatsByItsShortcutInSixteenBits) {
  TimerBench bench;
  bench.write(reg::kTimer + 0x508, 0);
  bench.write(reg::kTimer + 0x510, 0);
  bench.write(reg::kTimer + 0x540, 16'000);
  bench.write(reg::kTimer + 0x200, 1);
  bench.write(reg::kTimer + 0x000, 1);
  bench.run_us(2'500);
  EXPECT_EQ(bench.read(reg::kTimer + 0x140), 1U);
  EXPECT_EQ(bench.capture(), 8'000U);
  bench.write(reg::kTimer + 0x200, 1U << 8);
  bench.run_us(10'000);
  EXPECT_EQ(bench.capture(), 16'000U);
}

TEST(Timer, KeepsTheCrystalsTime) {
  TimerBench bench;
  bench.write(reg::kTimer + 0x000, 1);
  bench.run_us(4'000'000'000.5);
  EXPECT_EQ(bench.capture(), 4'000'000'000U);
  bench.run_us(294'967'296);
  EXPECT_EQ(bench.capture(), 0U);
}

// ---- ECB ------------------------------------------------------------------------------------------------

// FIPS 197, appendix C.1: key 00 01 02 ..., clear block 00 11 22 ...
struct EcbBench : SocBench {
  EcbBench() {
    for (std::size_t i = 0; i < 16; ++i) {
      ram[kOffset + i] = static_cast<std::uint8_t>(i);
      ram[kOffset + 16 + i] = static_cast<std::uint8_t>(0x11 * i);
    }
    write(reg::kEcb + 0x504, kRamAddress + kOffset);
  }
  [[nodiscard]] std::vector<std::uint8_t> encrypted() const {
    return {ram.begin() + kOffset + 32, ram.begin() + kOffset + 48};
  }
  static constexpr std::uint32_t kOffset = 0x100;
};

TEST(Ecb, EncryptsTheBlockInItsTime) {
  EcbBench bench;
  bench.write(reg::kEcb + 0x304, 1);
  bench.write(reg::kEcb + 0x000, 1);
  bench.run_us(7.1);
  EXPECT_EQ(bench.read(reg::kEcb + 0x100), 0U);
  EXPECT_THAT(bench.encrypted(), Each(0));
  EXPECT_FALSE(bench.irq(14));
  bench.run_us(0.2);
  EXPECT_EQ(bench.read(reg::kEcb + 0x100), 1U);
  EXPECT_EQ(bench.read(reg::kEcb + 0x104), 0U);
  EXPECT_TRUE(bench.irq(14));
  EXPECT_THAT(bench.encrypted(), ElementsAre(0x69, 0xC4, 0xE0, 0xD8, 0x6A, 0x7B, 0x04, 0x30, 0xD8, 0xCD, 0xB7,
                                             0x80, 0x70, 0xB4, 0xC5, 0x5A));
  bench.write(reg::kEcb + 0x100, 0);
  EXPECT_FALSE(bench.irq(14));
  EXPECT_EQ(bench.soc.ecb().blocks(), 1U);
}

TEST(Ecb, ReportsABlockThatWasStopped) {
  EcbBench bench;
  bench.write(reg::kEcb + 0x000, 1);
  bench.run_us(3.0);
  bench.write(reg::kEcb + 0x004, 1);
  bench.run_us(10.0);
  EXPECT_EQ(bench.read(reg::kEcb + 0x100), 0U);
  EXPECT_EQ(bench.read(reg::kEcb + 0x104), 1U);
  EXPECT_THAT(bench.encrypted(), Each(0));
  bench.write(reg::kEcb + 0x000, 1);
  bench.soc.reset(ResetCause::kSoftware, bench.processor.t);
  bench.run_us(10.0);
  EXPECT_EQ(bench.read(reg::kEcb + 0x100), 0U);
  EXPECT_EQ(bench.read(reg::kEcb + 0x504), 0U);
}

TEST(Ecb, FailsTheRunForInvalidUse) {
  {
    EcbBench bench;
    bench.write(reg::kEcb + 0x504, kRamAddress + kRamBytes - 47);
    EXPECT_THAT(SocBench::error_of([&] { bench.write(reg::kEcb, 1); }), HasSubstr("not in RAM"));
    bench.write(reg::kEcb + 0x504, 0x1000);
    EXPECT_THAT(SocBench::error_of([&] { bench.write(reg::kEcb, 1); }), HasSubstr("not in RAM"));
  }
  EcbBench bench;
  bench.write(reg::kEcb, 1);
  EXPECT_THAT(SocBench::error_of([&] { bench.write(reg::kEcb, 1); }), HasSubstr("STARTECB"));
  EXPECT_THAT(SocBench::error_of([&] { bench.write(reg::kEcb + 0x504, 0); }), HasSubstr("ECBDATAPTR"));
  EXPECT_THAT(SocBench::error_of([&] { bench.read(reg::kEcb + 0x500); }), HasSubstr("0x4000E500"));
  EXPECT_THAT(SocBench::error_of([&] { bench.write(reg::kEcb + 0x304, 4); }), HasSubstr("0x4000E304"));
  bench.ram[EcbBench::kOffset + 20] ^= 1;
  EXPECT_THAT(SocBench::error_of([&] { bench.run_us(8.0); }), HasSubstr("clear block changed"));
}

// ---- SPIM -----------------------------------------------------------------------------------------------

struct SpimBench : SocBench {
  SpimBench() {
    write(reg::kP0 + 0x508, 1U << 3);
    write(reg::kP0 + 0x518, 1U << 3);
    write(reg::kP0 + 0x700 + 4 * 4, 1);
    write(reg::kSpim1 + 0x508, 4);
    write(reg::kSpim1 + 0x50C, 6);
    write(reg::kSpim1 + 0x510, 7);
    write(reg::kSpim1 + 0x524, 0x80000000);
    write(reg::kSpim1 + 0x500, 7);
    write(reg::kSpim1 + 0x304, 1U << 6);
  }
  void select() { write(reg::kP0 + 0x50C, 1U << 3); }
  void deselect() { write(reg::kP0 + 0x508, 1U << 3); }
  void buffers(std::uint32_t out, std::uint32_t out_bytes, std::uint32_t in, std::uint32_t in_bytes) {
    write(reg::kSpim1 + 0x544, out);
    write(reg::kSpim1 + 0x548, out_bytes);
    write(reg::kSpim1 + 0x534, in);
    write(reg::kSpim1 + 0x538, in_bytes);
  }
  void start() { write(reg::kSpim1 + 0x010, 1); }
};

TEST(Spim, MovesBytesBothWaysAndIsDoneWhenTheLastOneIs) {
  SpimBench bench;
  std::iota(bench.ram.begin(), bench.ram.begin() + 8, std::uint8_t{1});
  bench.write(reg::kSpim1 + 0x5C0, 0xEE);
  bench.buffers(0x20000000, 3, 0x20000100, 5);
  bench.select();
  bench.start();
  EXPECT_EQ(bench.read(reg::kSpim1 + 0x14C), 1U);
  // Five bytes at 8 MHz take 5 us.
  const SimTime due = bench.processor.t + 5 * kMicrosecond + kSpiOverhead;
  bench.run_until(due - 1);
  EXPECT_FALSE(bench.irq(4));
  EXPECT_EQ(bench.ram[0x100], 0);
  EXPECT_THAT(bench.can.seen, IsEmpty());
  bench.run_until(due);
  EXPECT_TRUE(bench.irq(4));
  EXPECT_EQ(bench.can.last_end, due);
  EXPECT_EQ(bench.can.last_hz, 8'000'000U);
  ASSERT_EQ(bench.can.seen.size(), 1U);
  EXPECT_THAT(bench.can.seen[0], ElementsAre(1, 2, 3, 0xEE, 0xEE));
  EXPECT_THAT(std::span(bench.ram).subspan(0x100, 6), ElementsAre(0x80, 0x81, 0x82, 0x83, 0x84, 0));
  EXPECT_EQ(bench.read(reg::kSpim1 + 0x53C), 5U);
  EXPECT_EQ(bench.read(reg::kSpim1 + 0x54C), 3U);
  for (const std::uint32_t event : {0x110U, 0x118U, 0x120U}) EXPECT_EQ(bench.read(reg::kSpim1 + event), 1U);
  bench.write(reg::kSpim1 + 0x118, 0);
  EXPECT_FALSE(bench.irq(4));
}

TEST(Spim, ReachesOnlyRam) {
  SpimBench bench;
  bench.select();
  bench.buffers(0x00001000, 4, 0x20000000, 4);
  EXPECT_THAT(SocBench::error_of([&] { bench.start(); }), HasSubstr("SPIM1 TXD.PTR: 4 bytes at 0x00001000"));
  bench.buffers(0x20000000, 4, 0x2000FFFE, 4);
  EXPECT_THAT(SocBench::error_of([&] { bench.start(); }), HasSubstr("SPIM1 RXD.PTR"));
  bench.buffers(0x20000000, 256, 0x20000000, 4);
  EXPECT_THAT(SocBench::error_of([&] { bench.start(); }), HasSubstr("at most 255 bytes"));
}

TEST(Spim, RejectsInvalidUse) {
  SpimBench bench;
  bench.buffers(0x20000000, 1, 0x20000100, 1);
  bench.select();
  EXPECT_THAT(SocBench::error_of([&] { bench.start(); }), HasSubstr("erratum 58"));
  bench.buffers(0x20000000, 2, 0x20000100, 2);
  bench.start();
  EXPECT_THAT(SocBench::error_of([&] { bench.start(); }), HasSubstr("in progress"));
  EXPECT_THAT(SocBench::error_of([&] { bench.deselect(); }), HasSubstr("chip select changes"));
}

TEST(Spim, RequiresItsBufferUnchanged) {
  SpimBench bench;
  bench.buffers(0x20000000, 2, 0x20000100, 2);
  bench.select();
  bench.start();
  bench.ram[1] = 0x55;
  EXPECT_THAT(SocBench::error_of([&] { bench.run_us(100); }), HasSubstr("buffer was changed"));
}

TEST(Spim, RequiresOneChipSelectPerTransfer) {
  SpimBench bench;
  bench.buffers(0x20000000, 2, 0x20000100, 2);
  bench.start();
  EXPECT_THAT(SocBench::error_of([&] { bench.run_us(100); }), HasSubstr("no chip is selected"));
  bench.select();
  bench.start();
  bench.run_us(100);
  bench.start();
  EXPECT_THAT(SocBench::error_of([&] { bench.run_us(100); }), HasSubstr("second transfer"));
  bench.deselect();
  bench.select();
  bench.start();
  bench.run_us(100);
  EXPECT_EQ(bench.can.seen.size(), 2U);
}

TEST(Spim, ReadsTheRadiosIdentity) {
  SocBench bench;
  bench.run_us(5000);
  bench.write(reg::kP0 + 0x518, 1U << 17);
  bench.write(reg::kP0 + 0x700 + 4 * 16, 1);
  for (const auto& [offset, value] : {std::pair{0x508U, 16U},
                                      {0x50CU, 20U},
                                      {0x510U, 18U},
                                      {0x524U, 0x20000000U},
                                      {0x500U, 7U},
                                      {0x544U, 0x20000000U},
                                      {0x548U, 1U},
                                      {0x534U, 0x20000100U},
                                      {0x538U, 5U},
                                      {0x304U, 1U << 6},
                                      {0x010U, 1U}})
    bench.write(reg::kSpim2 + offset, value);
  bench.run_us(30);
  EXPECT_TRUE(bench.irq(35));
  EXPECT_THAT(std::span(bench.ram).subspan(0x100, 5), ElementsAre(0, 0x30, 0x01, 0xCA, 0xDE));
}

// ---- UARTE0 ---------------------------------------------------------------------------------------------

struct UarteBench : SocBench {
  UarteBench() {
    write(reg::kUarte + 0x50C, 5);
    write(reg::kUarte + 0x514, 11);
    write(reg::kUarte + 0x524, 0x10000000);
    write(reg::kUarte + 0x500, 8);
  }
  void send(std::uint32_t from, std::uint32_t bytes) {
    write(reg::kUarte + 0x544, from);
    write(reg::kUarte + 0x548, bytes);
    write(reg::kUarte + 0x008, 1);
  }
  void receive_to(std::uint32_t to, std::uint32_t bytes) {
    write(reg::kUarte + 0x534, to);
    write(reg::kUarte + 0x538, bytes);
    write(reg::kUarte + 0x000, 1);
  }
  std::vector<TimedByte> sent() {
    std::vector<TimedByte> bytes;
    to_host.take(processor.t, bytes);
    return bytes;
  }
  // Sends bytes from the host and waits until they have arrived.
  void host_sends(const std::vector<std::uint8_t>& bytes) {
    ASSERT_TRUE(from_host.write(processor.t, bytes));
    run_us(static_cast<double>(bytes.size()) * 10 + 50);
  }
};

TEST(Uarte, SendsEachByteInItsTime) {
  UarteBench bench;
  bench.write(reg::kUarte + 0x304, 1U << 8);
  std::iota(bench.ram.begin(), bench.ram.begin() + 4, std::uint8_t{0x41});
  bench.run_us(7);
  const SimTime start = bench.processor.t;
  bench.send(0x20000000, 4);
  EXPECT_EQ(bench.read(reg::kUarte + 0x150), 1U);
  bench.run_us(9.9);
  EXPECT_EQ(bench.read(reg::kUarte + 0x11C), 0U);
  bench.run_us(0.2);
  EXPECT_EQ(bench.read(reg::kUarte + 0x11C), 1U);
  bench.run_us(10.4);
  EXPECT_EQ(bench.sent().size(), 2U);
  EXPECT_FALSE(bench.irq(2));
  bench.run_us(20);
  EXPECT_TRUE(bench.irq(2));
  EXPECT_EQ(bench.read(reg::kUarte + 0x54C), 4U);
  const auto rest = bench.sent();
  ASSERT_EQ(rest.size(), 2U);
  EXPECT_EQ(rest[1].value, 0x44);
  EXPECT_EQ(rest[1].t, start + 40 * kMicrosecond);
}

TEST(Uarte, StopsAfterTheByteThatIsOnTheLine) {
  UarteBench bench;
  bench.send(0x20000000, 100);
  bench.run_us(25);
  bench.write(reg::kUarte + 0x00C, 1);
  EXPECT_EQ(bench.read(reg::kUarte + 0x158), 0U);
  bench.run_us(5);
  EXPECT_EQ(bench.read(reg::kUarte + 0x158), 1U);
  EXPECT_EQ(bench.read(reg::kUarte + 0x54C), 3U);
  bench.run_us(1000);
  EXPECT_EQ(bench.sent().size(), 3U);
}

TEST(Uarte, RequiresItsBufferInRamAndUnchanged) {
  UarteBench bench;
  EXPECT_THAT(SocBench::error_of([&] { bench.send(0x1000, 4); }), HasSubstr("UARTE0 TXD.PTR"));
  bench.send(0x20000000, 4);
  EXPECT_THAT(SocBench::error_of([&] { bench.send(0x20000000, 4); }), HasSubstr("in progress"));
  bench.ram[3] = 1;
  EXPECT_THAT(SocBench::error_of([&] { bench.run_us(100); }), HasSubstr("buffer was changed"));
}

TEST(Uarte, RunsAtTheSpeedOfTheHostsLine) {
  UarteBench bench;
  bench.write(reg::kUarte + 0x524, 0x0F000000);
  EXPECT_THAT(SocBench::error_of([&] { bench.send(0x20000000, 4); }), HasSubstr("at 937500 bit/s"));
}

TEST(Uarte, ReceivesIntoItsBufferByteByByte) {
  UarteBench bench;
  bench.write(reg::kUarte + 0x304, 1U << 4);
  bench.receive_to(0x20000200, 3);
  EXPECT_EQ(bench.read(reg::kUarte + 0x14C), 1U);
  bench.host_sends({1, 2});
  EXPECT_EQ(bench.read(reg::kUarte + 0x108), 1U);
  EXPECT_THAT(std::span(bench.ram).subspan(0x200, 4), ElementsAre(1, 2, 0, 0));
  EXPECT_FALSE(bench.irq(2));
  bench.host_sends({3});
  EXPECT_TRUE(bench.irq(2));
  EXPECT_EQ(bench.read(reg::kUarte + 0x53C), 3U);
  // Four more wait in the FIFO; a fifth is lost.
  bench.host_sends({4, 5, 6, 7});
  EXPECT_EQ(bench.read(reg::kUarte + 0x124), 0U);
  bench.host_sends({8});
  EXPECT_EQ(bench.read(reg::kUarte + 0x124), 1U);
  EXPECT_EQ(bench.read(reg::kUarte + 0x480), 1U);
  EXPECT_EQ(bench.soc.uarte().lost_bytes(), 1U);
  bench.write(reg::kUarte + 0x480, 1);
  EXPECT_EQ(bench.read(reg::kUarte + 0x480), 0U);
  bench.receive_to(0x20000300, 8);
  EXPECT_THAT(std::span(bench.ram).subspan(0x300, 5), ElementsAre(4, 5, 6, 7, 0));
}

TEST(Uarte, ContinuesWithTheNextBufferByItsShortcut) {
  UarteBench bench;
  bench.write(reg::kUarte + 0x200, 1U << 5);
  bench.receive_to(0x20000200, 2);
  bench.write(reg::kUarte + 0x534, 0x20000280);
  bench.host_sends({1, 2, 3});
  EXPECT_EQ(bench.read(reg::kUarte + 0x110), 1U);
  EXPECT_THAT(std::span(bench.ram).subspan(0x200, 3), ElementsAre(1, 2, 0));
  EXPECT_THAT(std::span(bench.ram).subspan(0x280, 2), ElementsAre(3, 0));
}

TEST(Uarte, StopsReceivingAndFlushesLateBytes) {
  UarteBench bench;
  bench.receive_to(0x20000200, 10);
  bench.host_sends({1, 2, 3});
  // Two bytes are on the line.
  ASSERT_TRUE(bench.from_host.write(bench.processor.t - 45 * kMicrosecond, std::vector<std::uint8_t>{9, 8}));
  bench.write(reg::kUarte + 0x004, 1);
  EXPECT_EQ(bench.read(reg::kUarte + 0x110), 1U);
  EXPECT_EQ(bench.read(reg::kUarte + 0x53C), 3U);
  EXPECT_EQ(bench.read(reg::kUarte + 0x144), 0U);
  bench.run_us(41);
  EXPECT_EQ(bench.read(reg::kUarte + 0x144), 1U);
  bench.write(reg::kUarte + 0x534, 0x20000240);
  bench.write(reg::kUarte + 0x02C, 1);
  EXPECT_EQ(bench.read(reg::kUarte + 0x53C), 2U);
  EXPECT_THAT(std::span(bench.ram).subspan(0x240, 2), ElementsAre(9, 8));
  bench.host_sends({7});
  EXPECT_EQ(bench.soc.uarte().lost_bytes(), 1U);
}

// ---- NVMC -----------------------------------------------------------------------------------------------

struct NvmcBench : SocBench {
  [[nodiscard]] std::uint32_t word(std::uint32_t address) const {
    std::uint32_t value = 0;
    for (unsigned i = 0; i < 4; ++i) value |= static_cast<std::uint32_t>(flash[address + i]) << (8 * i);
    return value;
  }
  void store(std::uint32_t address, std::uint32_t value) {
    write(reg::kNvmc + 0x504, 1);
    ASSERT_TRUE(soc.flash_write(address, 4, value));
  }
  void erase(std::uint32_t page) {
    write(reg::kNvmc + 0x504, 2);
    write(reg::kNvmc + 0x508, page);
  }
};

TEST(Nvmc, ClearsBitsByWritesAndSetsThemByErases) {
  NvmcBench bench;
  bench.store(0x7E000, 0x12345678);
  EXPECT_EQ(bench.processor.stalled, Nvmc::kWriteTime);
  EXPECT_EQ(bench.word(0x7E000), 0xFFFFFFFFU);
  EXPECT_EQ(bench.read(reg::kNvmc + 0x400), 0U);
  bench.run_us(338);
  EXPECT_EQ(bench.read(reg::kNvmc + 0x400), 1U);
  EXPECT_EQ(bench.word(0x7E000), 0x12345678U);
  EXPECT_EQ(bench.processor.flash_changes, 1);
  bench.store(0x7E000, 0xFFFF0000);
  bench.run_us(338);
  EXPECT_EQ(bench.word(0x7E000), 0x12340000U);
  bench.store(0x7F000, 0);
  bench.run_us(338);
  bench.erase(0x7E000);
  EXPECT_EQ(bench.processor.stalled, 3 * Nvmc::kWriteTime + Nvmc::kEraseTime);
  bench.run_us(89'700);
  EXPECT_EQ(bench.word(0x7E000), 0xFFFFFFFFU);
  EXPECT_EQ(bench.word(0x7F000), 0U);
}

TEST(Nvmc, FaultsAStoreThatIsNotEnabled) {
  NvmcBench bench;
  EXPECT_FALSE(bench.soc.flash_write(0x7E000, 4, 0));
  bench.write(reg::kNvmc + 0x504, 1);
  EXPECT_FALSE(bench.soc.flash_write(0x7E000, 2, 0));
  EXPECT_FALSE(bench.soc.flash_write(0x7E000, 1, 0));
  bench.write(reg::kNvmc + 0x504, 2);
  EXPECT_FALSE(bench.soc.flash_write(0x7E000, 4, 0));
  EXPECT_EQ(bench.word(0x7E000), 0xFFFFFFFFU);
  bench.write(reg::kNvmc + 0x504, 0);
  EXPECT_THAT(SocBench::error_of([&] { bench.write(reg::kNvmc + 0x508, 0x7E000); }),
              HasSubstr("not enabled"));
  EXPECT_THAT(SocBench::error_of([&] { bench.erase(0x7E004); }), HasSubstr("not the start of a page"));
}

TEST(Nvmc, FaultsMoreWritesThanABlockAllows) {
  NvmcBench bench;
  bench.write(reg::kNvmc + 0x504, 1);
  for (int i = 0; i < 181; ++i) {
    bench.store(0x7E000 + 4U * static_cast<unsigned>(i % 128), 0xFFFFFFFF);
    bench.run_us(338);
  }
  EXPECT_THAT(SocBench::error_of([&] { bench.store(0x7E000, 0); }), HasSubstr("more than 181 writes"));
  bench.store(0x7E200, 0);
  bench.run_us(338);
  bench.erase(0x7E000);
  bench.run_us(89'700);
  EXPECT_EQ(SocBench::error_of([&] { bench.store(0x7E000, 0); }), "");
}

TEST(Nvmc, WritesUicrToo) {
  NvmcBench bench;
  EXPECT_FALSE(bench.soc.write(0x10001208, 4, 0x5A));
  bench.write(reg::kNvmc + 0x504, 1);
  bench.write(0x10001208, 0x5A);
  bench.run_us(338);
  EXPECT_EQ(bench.read(0x10001208), 0x5AU);
  EXPECT_EQ(bench.processor.flash_changes, 0);
}

TEST(Nvmc, IsTornByAPowerCut) {
  for (const auto& [after_us, expected] : {std::pair{0.0, 0xFFFFFFFFU},
                                           {168.0, 0xFFFFFFFFU},
                                           {170.0, 0xFFFF5678U},
                                           {337.9, 0xFFFF5678U},
                                           {338.0, 0x12345678U}}) {
    NvmcBench bench;
    bench.store(0x7E000, 0x12345678);
    bench.soc.power_cut(from_seconds(after_us * 1e-6));
    EXPECT_EQ(bench.word(0x7E000), expected) << after_us;
    EXPECT_EQ(bench.soc.next_event(), bench.chip.next_event());
  }
  NvmcBench bench;
  std::fill(bench.flash.begin() + 0x7E000, bench.flash.end(), std::uint8_t{0});
  bench.erase(0x7E000);
  bench.soc.power_cut(bench.processor.t + Nvmc::kEraseTime / 4);
  const std::span<const std::uint8_t> page = std::span(bench.flash).subspan(0x7E000, 4096);
  EXPECT_THAT(page.first(1024), Each(0xFF));
  EXPECT_THAT(page.subspan(1024), Each(0));
}

// ---- WDT ------------------------------------------------------------------------------------------------

struct WatchdogBench : SocBench {
  WatchdogBench() {
    write(reg::kWdt + 0x504, 32'767);
    write(reg::kWdt + 0x508, 3);
    write(reg::kWdt + 0x304, 1);
    write(reg::kWdt + 0x000, 1);
  }
};

TEST(Watchdog, BitesTwoTicksAfterItsInterrupt) {
  WatchdogBench bench;
  EXPECT_EQ(bench.read(reg::kWdt + 0x400), 1U);
  bench.run_until(32'768 * Watchdog::kTick - 1);
  EXPECT_FALSE(bench.irq(16));
  bench.run_until(32'768 * Watchdog::kTick);
  EXPECT_TRUE(bench.irq(16));
  EXPECT_EQ(bench.read(reg::kWdt + 0x100), 1U);
  EXPECT_FALSE(bench.soc.watchdog().bites());
  // Too late.
  bench.write(reg::kWdt + 0x600, kReloadKey);
  bench.write(reg::kWdt + 0x604, kReloadKey);
  bench.run_until(32'770 * Watchdog::kTick);
  EXPECT_TRUE(bench.soc.watchdog().bites());
}

TEST(Watchdog, IsFedByAllOfItsRequests) {
  WatchdogBench bench;
  bench.run_us(900'000);
  bench.write(reg::kWdt + 0x600, kReloadKey);
  EXPECT_EQ(bench.read(reg::kWdt + 0x404), 2U);
  bench.write(reg::kWdt + 0x604, 0x12345678);
  EXPECT_EQ(bench.read(reg::kWdt + 0x404), 2U);
  bench.write(reg::kWdt + 0x604, kReloadKey);
  EXPECT_EQ(bench.read(reg::kWdt + 0x404), 3U);
  bench.run_us(900'000);
  EXPECT_FALSE(bench.irq(16));
  bench.run_us(200'000);
  EXPECT_TRUE(bench.soc.watchdog().bites());
}

TEST(Watchdog, CannotBeChangedNorStoppedOnceItRuns) {
  WatchdogBench bench;
  bench.write(reg::kWdt + 0x504, 0x00FFFFFF);
  bench.write(reg::kWdt + 0x508, 1);
  EXPECT_EQ(bench.read(reg::kWdt + 0x504), 32'767U);
  EXPECT_EQ(bench.read(reg::kWdt + 0x508), 3U);
  EXPECT_NE(SocBench::error_of([&] { bench.write(reg::kWdt + 0x004, 1); }), "");
  bench.soc.reset(ResetCause::kSoftware, bench.processor.t);
  EXPECT_EQ(bench.read(reg::kWdt + 0x400), 1U);
  bench.soc.reset(ResetCause::kWatchdog, bench.processor.t);
  EXPECT_EQ(bench.read(reg::kWdt + 0x400), 0U);
  bench.run_us(2e6);
  EXPECT_FALSE(bench.soc.watchdog().bites());
}

}  // namespace
}  // namespace groma::sim
