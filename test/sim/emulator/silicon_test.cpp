// Each quirk of the silicon (silicon.hpp), met and avoided by a small program.
#include "firmware/sim/emulator/silicon.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <span>
#include <vector>

#include "test/sim/emulator/small_program.hpp"

namespace groma::sim {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

using Code = SmallProgram::Code;
using Writes = SmallProgram::Writes;
using Bytes = std::vector<std::uint8_t>;

constexpr double kEnd_s = 0.005;

const Code kAwake{
    0xE7FE,  // b .
};
const Code kSleep{
    0xB672,                          // cpsid i
    0xBF30,                          // wfi
    0xBF00, 0xBF00, 0xBF00, 0xBF00,  // nop
    0xE7FE,                          // b .
};
// After 100 turns of two instructions, some 4 us.
const Code kSleepLater{
    0x2364,                          // movs r3, #100
    0x3B01,                          // subs r3, #1
    0xD1FD,                          // bne .-2
    0xB672,                          // cpsid i
    0xBF30,                          // wfi
    0xBF00, 0xBF00, 0xBF00, 0xBF00,  // nop
    0xE7FE,                          // b .
};

// ---- anomaly 109 ------------------------------------------------------------------------------------------

// Four bytes from RAM to the device on SPIM1.
const Writes kTransfer{{kRamAddress, 0x04030201},
                       {reg::kP0 + 0x508, 1U << 3},
                       {reg::kP0 + 0x700 + 4 * 3, 3},
                       {reg::kP0 + 0x700 + 4 * 4, 1},
                       {reg::kP0 + 0x700 + 4 * 6, 3},
                       {reg::kP0 + 0x700 + 4 * 7, 0},
                       {reg::kP0 + 0x50C, 1U << 3},
                       {reg::kSpim1 + 0x508, 4},
                       {reg::kSpim1 + 0x50C, 6},
                       {reg::kSpim1 + 0x510, 7},
                       {reg::kSpim1 + 0x524, 0x80000000},
                       {reg::kSpim1 + 0x500, 7},
                       {reg::kSpim1 + 0x544, kRamAddress},
                       {reg::kSpim1 + 0x548, 4},
                       {reg::kSpim1 + 0x534, kRamAddress + 0x100},
                       {reg::kSpim1 + 0x538, 4},
                       {reg::kSpim1 + 0x010, 1}};

TEST(Silicon, SleepAtTheStartOfAnSpiTransferSpoilsItsFirstByte) {
  const auto sent = [](const Code& tail, bool on) {
    SmallProgram program(kTransfer, tail, {.silicon = {.spim_start = on}});
    program.run_until(kEnd_s);
    return program.device.seen.at(0);
  };
  const Bytes right{1, 2, 3, 4};
  EXPECT_EQ(sent(kAwake, true), right);
  EXPECT_EQ(sent(kSleepLater, true), right);
  EXPECT_EQ(sent(kSleep, false), right);
  const Bytes wrong = sent(kSleep, true);
  EXPECT_NE(wrong[0], right[0]);
  EXPECT_THAT(std::span(wrong).subspan(1), ElementsAre(2, 3, 4));
  EXPECT_EQ(sent(kSleep, true), wrong);
}

// Four bytes from RAM to the host.
const Writes kMessage{
    {kRamAddress, 0x04030201},         {reg::kP0 + 0x508, 1U << 5}, {reg::kP0 + 0x700 + 4 * 5, 3},
    {reg::kP0 + 0x700 + 4 * 11, 0xC},  {reg::kUarte + 0x50C, 5},    {reg::kUarte + 0x514, 11},
    {reg::kUarte + 0x524, 0x10000000}, {reg::kUarte + 0x500, 8},    {reg::kUarte + 0x544, kRamAddress},
    {reg::kUarte + 0x548, 4},          {reg::kUarte + 0x008, 1}};

TEST(Silicon, SleepAtTheStartOfAMessageToTheHostSpoilsItsFirstByte) {
  const auto sent = [](const Code& tail, bool on) {
    SmallProgram program(kMessage, tail, {.silicon = {.uarte_start = on}});
    program.run_until(kEnd_s);
    return program.sent();
  };
  const Bytes right{1, 2, 3, 4};
  EXPECT_EQ(sent(kAwake, true), right);
  EXPECT_EQ(sent(kSleepLater, true), right);
  EXPECT_EQ(sent(kSleep, false), right);
  const Bytes wrong = sent(kSleep, true);
  ASSERT_EQ(wrong.size(), 4U);
  EXPECT_NE(wrong[0], right[0]);
  EXPECT_THAT(std::span(wrong).subspan(1), ElementsAre(2, 3, 4));
}

// FIPS 197, appendix C.1.
const Writes kBlock{{kRamAddress + 0, 0x03020100},    {kRamAddress + 4, 0x07060504},
                    {kRamAddress + 8, 0x0B0A0908},    {kRamAddress + 12, 0x0F0E0D0C},
                    {kRamAddress + 16, 0x33221100},   {kRamAddress + 20, 0x77665544},
                    {kRamAddress + 24, 0xBBAA9988},   {kRamAddress + 28, 0xFFEEDDCC},
                    {reg::kEcb + 0x504, kRamAddress}, {reg::kEcb + 0x000, 1}};

TEST(Silicon, SleepAtTheStartOfAnEncryptionSpoilsTheBlock) {
  const auto first_bytes = [](const Code& tail, bool on) {
    SmallProgram program(kBlock, tail, {.silicon = {.ecb_start = on}});
    program.run_until(kEnd_s);
    const auto encrypted = program.node->ram().subspan(32, 4);
    return Bytes(encrypted.begin(), encrypted.end());
  };
  const Bytes right{0x69, 0xC4, 0xE0, 0xD8};
  EXPECT_EQ(first_bytes(kAwake, true), right);
  EXPECT_EQ(first_bytes(kSleepLater, true), right);
  EXPECT_EQ(first_bytes(kSleep, false), right);
  EXPECT_NE(first_bytes(kSleep, true), right);
}

// ---- SCK --------------------------------------------------------------------------------------------------

TEST(Silicon, NeedsTheInputBufferOfTheSpiClock) {
  const auto error_of = [](std::uint32_t clock_configuration, bool on) {
    Writes writes = kTransfer;
    writes[3].second = clock_configuration;
    SmallProgram program(writes, kAwake, {.silicon = {.sck_input = on}});
    return SocBench::error_of([&] { program.run_until(kEnd_s); });
  };
  EXPECT_EQ(error_of(1, true), "");
  EXPECT_THAT(error_of(3, true), HasSubstr("input buffer of SCK"));
  EXPECT_EQ(error_of(3, false), "");
}

// ---- anomaly 220 ------------------------------------------------------------------------------------------

TEST(Silicon, FailsTheRunIfMemoryCouldBeWrittenJustAfterAWakeUp) {
  const auto error_of = [](const Code& tail, bool on) {
    SmallProgram program({}, tail, {.silicon = {.wake_up = on}});
    return SocBench::error_of([&] { program.run_until(kEnd_s); });
  };
  EXPECT_EQ(error_of(kSleep, true), "");
  const Code hasty{
      0xB672,  // cpsid i
      0xBF30,  // wfi
      0xB662,  // cpsie i
      0xE7FE,  // b .
  };
  EXPECT_THAT(error_of(hasty, true), HasSubstr("anomaly 220"));
  EXPECT_EQ(error_of(hasty, false), "");
}

// ---- anomaly 132 ------------------------------------------------------------------------------------------

const Writes kSlowClockStart{{reg::kPower + 0x518, 1}, {reg::kPower + 0x008, 1}};

TEST(Silicon, FailsTheRunIfTheSlowClockIsStartedSoonAfterAReset) {
  const auto error_of = [](bool on) {
    SmallProgram program(kSlowClockStart, kAwake, {.silicon = {.lfclk_restart = on}});
    // The supply takes longer to rise than the clock needs.
    program.run_until(kEnd_s);
    program.node->press_reset(program.network.now());
    return SocBench::error_of([&] { program.run_until(2 * kEnd_s); });
  };
  EXPECT_THAT(error_of(true), HasSubstr("anomaly 132"));
  EXPECT_EQ(error_of(false), "");
}

}  // namespace
}  // namespace groma::sim
