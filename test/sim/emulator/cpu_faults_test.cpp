// Faults as the firmware's handlers see them: which fault, with which status and which stacked address.
#include <gtest/gtest.h>

#include <string>

#include "firmware/sim/simulation_error.hpp"
#include "test/sim/emulator/cpu_bench.hpp"

namespace groma::sim {
namespace {

// Bits of CFSR.
constexpr std::uint32_t kIaccviol = 1U << 0;
constexpr std::uint32_t kIbuserr = 1U << 8;
constexpr std::uint32_t kPreciserr = 1U << 9;
constexpr std::uint32_t kUnstkerr = 1U << 11;
constexpr std::uint32_t kStkerr = 1U << 12;
constexpr std::uint32_t kBfarvalid = 1U << 15;
constexpr std::uint32_t kUndefinstr = 1U << 16;
constexpr std::uint32_t kInvstate = 1U << 17;
constexpr std::uint32_t kInvpc = 1U << 18;
constexpr std::uint32_t kNocp = 1U << 19;
constexpr std::uint32_t kDivbyzero = 1U << 25;
// Bits of HFSR.
constexpr std::uint32_t kVecttbl = 1U << 1;
constexpr std::uint32_t kForced = 1U << 30;
constexpr std::uint32_t kDebugevt = 1U << 31;

class CpuFaults : public testing::Test {
 protected:
  // Enables MemManage, BusFault and UsageFault, and the FPU; sets R1 = 0x30000000, where nothing is; then
  // runs the program.
  void with_faults_enabled(const CpuBench::Code& program) {
    bench_.put(kProgram, program);
    bench_.run({
        0xF64E, 0x5024,  // movw r0, #0xED24
        0xF2CE, 0x0000,  // movt r0, #0xE000
        0xF44F, 0x21E0,  // mov.w r1, #0x70000
        0x6001,          // str r1, [r0]
        0xF44F, 0x0170,  // mov.w r1, #0xF00000
        0x6641,          // str r1, [r0, #0x64]
        0xF3BF, 0x8F6F,  // isb
        0xF04F, 0x5140,  // mov.w r1, #0x30000000
        0xF000, 0xB870,  // b.w .+228
    });
  }

  void expect_fault(unsigned exception, std::uint32_t cfsr, std::uint32_t pc) {
    EXPECT_EQ(bench_.ipsr(), exception);
    EXPECT_EQ(bench_.r(8), cfsr);
    EXPECT_EQ(bench_.stacked_pc(), pc);
    EXPECT_EQ(bench_.cpu().pc(), CpuBench::kFaultSeen);
  }

  static constexpr std::uint32_t kProgram = 0x300;
  static constexpr std::uint32_t kNowhere = 0x30000000;
  CpuBench bench_;
};

TEST_F(CpuFaults, BusFaultOfALoadReportsPcAndAddressAndKeepsTheRegisters) {
  with_faults_enabled({
      0x200B,  // movs r0, #11
      0x2216,  // movs r2, #22
      0x2321,  // movs r3, #33
      0x6888,  // ldr r0, [r1, #8]
      0x2200,  // movs r2, #0
      0xE7FE,  // b .
  });
  expect_fault(CpuBench::kBusFault, kPreciserr | kBfarvalid, kProgram + 6);
  EXPECT_EQ(bench_.r(10), kNowhere + 8);
  EXPECT_EQ(bench_.stacked(0), 11U);
  EXPECT_EQ(bench_.stacked(1), kNowhere);
  EXPECT_EQ(bench_.stacked(2), 22U);
  EXPECT_EQ(bench_.stacked(3), 33U);
  EXPECT_EQ(bench_.reg(CpuBench::Register::kLr), 0xFFFFFFF9U);
  EXPECT_EQ(bench_.reg(CpuBench::Register::kSp), CpuBench::kStack - 0x20);
}

struct Form {
  const char* name;
  std::vector<std::uint16_t> code;
  std::uint32_t offset;   // of the instruction that faults
  std::uint32_t address;  // of its first access outside
};

class CpuFaultForms : public CpuFaults, public testing::WithParamInterface<Form> {};

TEST_P(CpuFaultForms, ReportsTheInstructionWithinItsBlock) {
  with_faults_enabled(GetParam().code);
  expect_fault(CpuBench::kBusFault, kPreciserr | kBfarvalid, kProgram + GetParam().offset);
  EXPECT_EQ(bench_.r(10), GetParam().address);
}

INSTANTIATE_TEST_SUITE_P(Encodings, CpuFaultForms,
                         testing::Values(Form{"store",
                                              {
                                                  0xBF00,  // nop
                                                  0x6008,  // str r0, [r1]
                                                  0xBF00,  // nop
                                                  0xE7FE,  // b .
                                              },
                                              2,
                                              0x30000000},
                                         Form{"store_byte",
                                              {
                                                  0x2205,  // movs r2, #5
                                                  0x5488,  // strb r0, [r1, r2]
                                                  0xE7FE,  // b .
                                              },
                                              2,
                                              0x30000005},
                                         Form{"store_half",
                                              {
                                                  0xBF00,  // nop
                                                  0x80C8,  // strh r0, [r1, #6]
                                                  0xE7FE,  // b .
                                              },
                                              2,
                                              0x30000006},
                                         Form{"load_signed",
                                              {
                                                  0x2204,  // movs r2, #4
                                                  0x5E88,  // ldrsh r0, [r1, r2]
                                                  0xE7FE,  // b .
                                              },
                                              2,
                                              0x30000004},
                                         Form{"load_wide_negative",
                                              {
                                                  0xBF00,          // nop
                                                  0xF851, 0x0C08,  // ldr.w r0, [r1, #-8]
                                                  0xE7FE,          // b .
                                              },
                                              2,
                                              0x2FFFFFF8},
                                         Form{"load_pre_indexed",
                                              {
                                                  0xBF00,          // nop
                                                  0xF811, 0x0F03,  // ldrb r0, [r1, #3]!
                                                  0xE7FE,          // b .
                                              },
                                              2,
                                              0x30000003},
                                         Form{"store_post_indexed",
                                              {
                                                  0xBF00,          // nop
                                                  0xF841, 0x0B04,  // str r0, [r1], #4
                                                  0xE7FE,          // b .
                                              },
                                              2,
                                              0x30000000},
                                         Form{"load_shifted",
                                              {
                                                  0x2203,          // movs r2, #3
                                                  0xF851, 0x0022,  // ldr.w r0, [r1, r2, lsl #2]
                                                  0xE7FE,          // b .
                                              },
                                              2,
                                              0x3000000C},
                                         Form{"load_double",
                                              {
                                                  0xBF00,          // nop
                                                  0xE9D1, 0x2304,  // ldrd r2, r3, [r1, #16]
                                                  0xE7FE,          // b .
                                              },
                                              2,
                                              0x30000010},
                                         Form{"store_double",
                                              {
                                                  0xBF00,          // nop
                                                  0xE961, 0x2304,  // strd r2, r3, [r1, #-16]!
                                                  0xE7FE,          // b .
                                              },
                                              2,
                                              0x2FFFFFF0},
                                         Form{"load_multiple",
                                              {
                                                  0xBF00,  // nop
                                                  0xC90C,  // ldmia r1!, {r2, r3}
                                                  0xE7FE,  // b .
                                              },
                                              2,
                                              0x30000000},
                                         Form{"store_multiple_before",
                                              {
                                                  0xBF00,          // nop
                                                  0xE921, 0x001C,  // stmdb r1!, {r2, r3, r4}
                                                  0xE7FE,          // b .
                                              },
                                              2,
                                              0x2FFFFFF4},
                                         Form{"load_exclusive",
                                              {
                                                  0xBF00,          // nop
                                                  0xE851, 0x0F01,  // ldrex r0, [r1, #4]
                                                  0xE7FE,          // b .
                                              },
                                              2,
                                              0x30000004},
                                         Form{"table_branch",
                                              {
                                                  0x2207,          // movs r2, #7
                                                  0xE8D1, 0xF002,  // tbb [r1, r2]
                                              },
                                              2,
                                              0x30000007},
                                         Form{"load_float",
                                              {
                                                  0xBF00,          // nop
                                                  0xED91, 0x0A01,  // vldr s0, [r1, #4]
                                                  0xE7FE,          // b .
                                              },
                                              2,
                                              0x30000004},
                                         Form{"store_floats",
                                              {
                                                  0xBF00,          // nop
                                                  0xECA1, 0x0A04,  // vstmia r1!, {s0-s3}
                                                  0xE7FE,          // b .
                                              },
                                              2,
                                              0x30000000},
                                         Form{"bus_without_a_register",
                                              {
                                                  0xF04F, 0x4280,  // mov.w r2, #0x40000000
                                                  0x68D0,          // ldr r0, [r2, #12]
                                                  0xE7FE,          // b .
                                              },
                                              4,
                                              0x4000000C},
                                         Form{"behind_the_ram",
                                              {
                                                  0xF244, 0x0200,  // movw r2, #0x4000
                                                  0xF2C2, 0x0200,  // movt r2, #0x2000
                                                  0x6010,          // str r0, [r2]
                                                  0xE7FE,          // b .
                                              },
                                              8,
                                              0x20004000},
                                         Form{"second_of_two_alike",
                                              {
                                                  0xF643, 0x71FC,  // movw r1, #0x3FFC
                                                  0xF2C2, 0x0100,  // movt r1, #0x2000
                                                  0x2009,          // movs r0, #9
                                                  0xF841, 0x0B04,  // str r0, [r1], #4
                                                  0xF841, 0x0B04,  // str r0, [r1], #4
                                                  0xE7FE,          // b .
                                              },
                                              14,
                                              0x20004000},
                                         Form{"second_of_two_pushed",
                                              {
                                                  0xF240, 0x040C,  // movw r4, #0x000C
                                                  0xF2C2, 0x0400,  // movt r4, #0x2000
                                                  0xE924, 0x000D,  // stmdb r4!, {r0, r2, r3}
                                                  0xE924, 0x000D,  // stmdb r4!, {r0, r2, r3}
                                                  0xE7FE,          // b .
                                              },
                                              12,
                                              0x1FFFFFF4},
                                         Form{"first_of_two_pushed",
                                              {
                                                  0xF240, 0x0404,  // movw r4, #0x0004
                                                  0xF2C2, 0x0400,  // movt r4, #0x2000
                                                  0x2001,          // movs r0, #1
                                                  0xE924, 0x000D,  // stmdb r4!, {r0, r2, r3}
                                                  0xE924, 0x000D,  // stmdb r4!, {r0, r2, r3}
                                                  0xE7FE,          // b .
                                              },
                                              10,
                                              0x1FFFFFF8},
                                         Form{"condition_fails_before",
                                              {
                                                  0x2000,  // movs r0, #0
                                                  0xBF14,  // ite ne
                                                  0x684A,  // ldrne r2, [r1, #4]
                                                  0x684B,  // ldreq r3, [r1, #4]
                                                  0xE7FE,  // b .
                                              },
                                              6,
                                              0x30000004}),
                         [](const auto& form) { return std::string(form.param.name); });

TEST_F(CpuFaults, StacksTheConditionStateOfAnItBlock) {
  with_faults_enabled({
      0x2000,  // movs r0, #0
      0xBF06,  // itte eq
      0x2201,  // moveq r2, #1
      0x680B,  // ldreq r3, [r1]
      0x2202,  // movne r2, #2
      0xE7FE,  // b .
  });
  expect_fault(CpuBench::kBusFault, kPreciserr | kBfarvalid, kProgram + 6);
  // ITSTATE 0b0000'1100 when the second of three begins: [1:0] at 26:25, [7:2] at 15:10.
  EXPECT_EQ(bench_.stacked_xpsr() & 0x0600FC00U, 0x00000C00U);
}

TEST_F(CpuFaults, ReturnsAfterTheInstructionThatItsHandlerSkips) {
  bench_.put(0x1800, {
                         0x9806,  // ldr r0, [sp, #24]
                         0x3002,  // adds r0, #2
                         0x9006,  // str r0, [sp, #24]
                         0x4770,  // bx lr
                     });
  bench_.handler(CpuBench::kBusFault, 0x1800);
  with_faults_enabled({
      0x2000,  // movs r0, #0
      0xBF06,  // itte eq
      0x2201,  // moveq r2, #1
      0x680B,  // ldreq r3, [r1]
      0x2202,  // movne r2, #2
      0x320A,  // adds r2, #10
      0x680B,  // ldr r3, [r1]
      0x3214,  // adds r2, #20
      0xE7FE,  // b .
  });
  EXPECT_EQ(bench_.ipsr(), 0U);
  // The IT block continues where it was: MOVNE runs under the skipped load's "eq", ADDS under MOVNE's "ne".
  EXPECT_EQ(bench_.r(2), 22U);
  EXPECT_EQ(bench_.cpu().pc(), kProgram + 16);
}

TEST_F(CpuFaults, BecomesAHardFaultWhileItIsDisabled) {
  bench_.run({
      0xF04F, 0x5140,  // mov.w r1, #0x30000000
      0x6808,          // ldr r0, [r1]
      0xE7FE,          // b .
  });
  expect_fault(CpuBench::kHardFault, kPreciserr | kBfarvalid, CpuBench::kMain + 4);
  EXPECT_EQ(bench_.r(9), kForced);
}

TEST_F(CpuFaults, BecomesAHardFaultUnderAMaskAndInAHandlerOfItsPriority) {
  with_faults_enabled({
      0xB672,  // cpsid i
      0x6808,  // ldr r0, [r1]
      0xE7FE,  // b .
  });
  expect_fault(CpuBench::kHardFault, kPreciserr | kBfarvalid, kProgram + 2);
  EXPECT_EQ(bench_.r(9), kForced);

  bench_.put(0x1800, {
                         0x6848,  // ldr r0, [r1, #4]
                         0xE7FE,  // b .
                     });
  bench_.handler(CpuBench::kBusFault, 0x1800);
  with_faults_enabled({
      0x6808,  // ldr r0, [r1]
      0xE7FE,  // b .
  });
  expect_fault(CpuBench::kHardFault, kPreciserr | kBfarvalid, 0x1800);
  EXPECT_EQ(bench_.r(9), kForced);
  EXPECT_EQ(bench_.r(10), kNowhere + 4);
  EXPECT_EQ(bench_.reg(CpuBench::Register::kLr), 0xFFFFFFF1U);
}

TEST_F(CpuFaults, LocksUpWhenAHardFaultFaults) {
  bench_.put(0x1800, {
                         0x6808,  // ldr r0, [r1]
                         0xE7FE,  // b .
                     });
  bench_.handler(CpuBench::kHardFault, 0x1800);
  bench_.run({
      0xF04F, 0x5140,  // mov.w r1, #0x30000000
      0x6808,          // ldr r0, [r1]
      0xE7FE,          // b .
  });
  EXPECT_TRUE(bench_.cpu().lockup());
  EXPECT_EQ(bench_.cpu().next_wake(), kNever);
  bench_.cpu().reset(bench_.cpu().now());
  EXPECT_FALSE(bench_.cpu().lockup());
}

TEST_F(CpuFaults, LocksUpWhenTheNmiOrAFaultMaskBlocksTheHardFault) {
  bench_.put(0x1800, {
                         0xDE00,  // udf #0
                     });
  bench_.handler(CpuBench::kNmi, 0x1800);
  bench_.run({
      0xE7FE,  // b .
  });
  bench_.cpu().pend_nmi();
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_TRUE(bench_.cpu().lockup());

  bench_.run({
      0xB671,  // cpsid f
      0xDE00,  // udf #0
  });
  EXPECT_TRUE(bench_.cpu().lockup());
}

// B1.5.11: the stack has run out of the RAM at its lower end.
TEST_F(CpuFaults, StackOverflowIsABusFaultThatCouldNotStackItsFrame) {
  with_faults_enabled({
      0xF240, 0x0408,  // movw r4, #0x0008
      0xF2C2, 0x0400,  // movt r4, #0x2000
      0x46A5,          // mov sp, r4
      0xB4F0,          // push {r4, r5, r6, r7}
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.ipsr(), CpuBench::kBusFault);
  EXPECT_EQ(bench_.r(8), kPreciserr | kBfarvalid | kStkerr);
  EXPECT_EQ(bench_.r(10), CpuBench::kRam - 8);
  EXPECT_EQ(bench_.reg(CpuBench::Register::kSp), CpuBench::kRam + 8 - 0x20);
  // The part of the frame that lies in the RAM is stored: PC and xPSR.
  EXPECT_EQ(bench_.word(CpuBench::kRam), kProgram + 10);
}

TEST_F(CpuFaults, StackingForAnInterruptFaultsAndTheInterruptComesLater) {
  bench_.handler(CpuBench::kIrq0, 0x1800);
  bench_.put(0x1800, {
                         0xE7FE,  // b .
                     });
  with_faults_enabled({
      0xF24E, 0x1200,  // movw r2, #0xE100
      0xF2CE, 0x0200,  // movt r2, #0xE000
      0x2301,          // movs r3, #1
      0x6013,          // str r3, [r2]
      0x468D,          // mov sp, r1
      0xE7FE,          // b .
  });
  bench_.cpu().set_irq(0, true);
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(bench_.r(8), kStkerr);
  EXPECT_EQ(bench_.ipsr(), CpuBench::kBusFault);
  EXPECT_EQ(bench_.reg(CpuBench::Register::kSp), kNowhere - 0x20);
}

TEST_F(CpuFaults, UnstackingFaults) {
  bench_.put(0x1800, {
                         0xF04F, 0x5040,  // mov.w r0, #0x30000000
                         0x4685,          // mov sp, r0
                         0x4770,          // bx lr
                     });
  bench_.handler(CpuBench::kSvCall, 0x1800);
  with_faults_enabled({
      0xDF00,  // svc #0
      0xE7FE,  // b .
  });
  EXPECT_EQ(bench_.ipsr(), CpuBench::kBusFault);
  EXPECT_EQ(bench_.r(8), kUnstkerr);
  EXPECT_EQ(bench_.reg(CpuBench::Register::kSp), kNowhere);
  EXPECT_EQ(bench_.reg(CpuBench::Register::kLr), 0xFFFFFFF9U);
}

TEST_F(CpuFaults, UndefinedInstruction) {
  with_faults_enabled({
      0x2001,  // movs r0, #1
      0xDE03,  // udf #3
      0xE7FE,  // b .
  });
  expect_fault(CpuBench::kUsageFault, kUndefinstr, kProgram + 2);
  EXPECT_EQ(bench_.stacked(0), 1U);
}

TEST_F(CpuFaults, UndefinedInstructionRightAfterAWait) {
  with_faults_enabled({
      0xBF40,  // sev
      0xBF20,  // wfe
      0xDE03,  // udf #3
      0xE7FE,  // b .
  });
  expect_fault(CpuBench::kUsageFault, kUndefinstr, kProgram + 4);
}

TEST_F(CpuFaults, BranchToArmCode) {
  with_faults_enabled({
      0xF240, 0x4200,  // movw r2, #0x0400
      0x4710,          // bx r2
  });
  expect_fault(CpuBench::kUsageFault, kInvstate, 0x400);
  EXPECT_EQ(bench_.stacked_xpsr() & 1U << 24, 0U);
}

TEST_F(CpuFaults, BranchToNowhere) {
  with_faults_enabled({
      0xF041, 0x0101,  // orr.w r1, r1, #1
      0x4708,          // bx r1
  });
  expect_fault(CpuBench::kBusFault, kIbuserr, kNowhere);
}

// B3.1: peripherals and system space are never executable.
TEST_F(CpuFaults, BranchToAPeripheral) {
  bench_.registers[CpuBench::kBus] = 0;
  with_faults_enabled({
      0x2201,          // movs r2, #1
      0xF2C4, 0x0200,  // movt r2, #0x4000
      0x4710,          // bx r2
  });
  expect_fault(CpuBench::kMemManage, kIaccviol, CpuBench::kBus);
}

TEST_F(CpuFaults, DivisionByZeroTrapsIfEnabled) {
  const CpuBench::Code divide = {
      0x2064,          // movs r0, #100
      0x2200,          // movs r2, #0
      0xFBB0, 0xF3F2,  // udiv r3, r0, r2
      0x2401,          // movs r4, #1
      0xE7FE,          // b .
  };
  with_faults_enabled(divide);
  EXPECT_EQ(bench_.ipsr(), 0U);
  EXPECT_EQ(bench_.r(3), 0U);

  with_faults_enabled({
      0xF64E, 0x5514,  // movw r5, #0xED14
      0xF2CE, 0x0500,  // movt r5, #0xE000
      0xF44F, 0x7604,  // mov.w r6, #0x210
      0x602E,          // str r6, [r5]
      0xF3BF, 0x8F6F,  // isb
      0x2064,          // movs r0, #100
      0x2207,          // movs r2, #7
      0xFB90, 0xF4F2,  // sdiv r4, r0, r2
      0x2105,          // movs r1, #5
      0x468E,          // mov lr, r1
      0xFBB0, 0xF5FE,  // udiv r5, r0, lr
      0x2200,          // movs r2, #0
      0xFBB0, 0xF3F2,  // udiv r3, r0, r2
      0xE7FE,          // b .
  });
  expect_fault(CpuBench::kUsageFault, kDivbyzero, kProgram + 36);
  EXPECT_EQ(bench_.r(4), 14U);
  EXPECT_EQ(bench_.r(5), 20U);
}

TEST_F(CpuFaults, FloatingPointBeforeItIsEnabled) {
  bench_.run({
      0xF64E, 0x5024,  // movw r0, #0xED24
      0xF2CE, 0x0000,  // movt r0, #0xE000
      0xF44F, 0x21E0,  // mov.w r1, #0x70000
      0x6001,          // str r1, [r0]
      0xE7FF,          // b .+2
      0x2005,          // movs r0, #5
      0xEE00, 0x0A10,  // vmov s0, r0
      0xE7FE,          // b .
  });
  expect_fault(CpuBench::kUsageFault, kNocp, CpuBench::kMain + 18);
  EXPECT_EQ(bench_.stacked(0), 5U);
  EXPECT_EQ(bench_.reg(CpuBench::Register::kLr), 0xFFFFFFF9U);
}

TEST_F(CpuFaults, FloatingPointIsDetectedInOtherCodeAtTheSameAddress) {
  bench_.run({
      0xBF00,          // nop
      0xBF00,          // nop
      0xEE00, 0x0A10,  // vmov s0, r0
      0xE7FE,          // b .
  });
  expect_fault(CpuBench::kHardFault, kNocp, CpuBench::kMain + 4);
  bench_.run({
      0xBF00,          // nop
      0xEE00, 0x0A10,  // vmov s0, r0
      0xBF00,          // nop
      0xE7FE,          // b .
  });
  expect_fault(CpuBench::kHardFault, kNocp, CpuBench::kMain + 2);
}

TEST_F(CpuFaults, FloatingPointThatItsHandlerEnablesIsRunAgain) {
  bench_.put(0x1800, {
                         0xF64E, 0x5088,  // movw r0, #0xED88
                         0xF2CE, 0x0000,  // movt r0, #0xE000
                         0xF44F, 0x0170,  // mov.w r1, #0xF00000
                         0x6001,          // str r1, [r0]
                         0x4770,          // bx lr
                     });
  bench_.handler(CpuBench::kHardFault, 0x1800);
  bench_.run({
      0x2005,          // movs r0, #5
      0xEE00, 0x0A90,  // vmov s1, r0
      0xEE10, 0x2A90,  // vmov r2, s1
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.ipsr(), 0U);
  EXPECT_EQ(bench_.r(2), 5U);
}

TEST_F(CpuFaults, AnotherCoprocessorIsAbsent) {
  with_faults_enabled({
      0xBF00,          // nop
      0xEE10, 0x0F10,  // mrc p15, 0, r0, c0, c0, 0
      0xE7FE,          // b .
  });
  expect_fault(CpuBench::kUsageFault, kNocp, kProgram + 2);
}

TEST_F(CpuFaults, ReturnToNoException) {
  bench_.put(0x1800, {
                         0xF06F, 0x000E,  // mvn r0, #14
                         0x4700,          // bx r0
                     });
  bench_.handler(CpuBench::kSvCall, 0x1800);
  with_faults_enabled({
      0xDF00,  // svc #0
      0xE7FE,  // b .
  });
  // 0xFFFFFFF1 returns to a preempted handler; there is none.
  EXPECT_EQ(bench_.ipsr(), CpuBench::kUsageFault);
  EXPECT_EQ(bench_.r(8), kInvpc);
  EXPECT_EQ(bench_.reg(CpuBench::Register::kLr), 0xFFFFFFF1U);
}

TEST_F(CpuFaults, FrameOfTheWrongMode) {
  bench_.put(0x1800, {
                         0x9807,          // ldr r0, [sp, #28]
                         0xF040, 0x000B,  // orr r0, r0, #11
                         0x9007,          // str r0, [sp, #28]
                         0x4770,          // bx lr
                     });
  bench_.handler(CpuBench::kSvCall, 0x1800);
  with_faults_enabled({
      0xDF00,  // svc #0
      0xE7FE,  // b .
  });
  EXPECT_EQ(bench_.ipsr(), CpuBench::kUsageFault);
  EXPECT_EQ(bench_.r(8), kInvpc);
}

TEST_F(CpuFaults, VectorTableOutsideTheMemory) {
  bench_.run({
      0xF64E, 0x5008,  // movw r0, #0xED08
      0xF2CE, 0x0000,  // movt r0, #0xE000
      0xF04F, 0x5140,  // mov.w r1, #0x30000000
      0x6001,          // str r1, [r0]
      0xDF00,          // svc #0
      0xE7FE,          // b .
  });
  // The HardFault's own vector is outside too (B1.5.15).
  EXPECT_TRUE(bench_.cpu().lockup());
}

TEST_F(CpuFaults, OneVectorOutsideTheMemory) {
  // The table's first eight vectors are the last words of the RAM.
  const std::uint32_t table = CpuBench::kStack - 0x20;
  bench_.put_word(table + 4 * CpuBench::kHardFault, CpuBench::kHandler | 1);
  bench_.run({
      0xF64E, 0x5008,  // movw r0, #0xED08
      0xF2CE, 0x0000,  // movt r0, #0xE000
      0xF643, 0x7180,  // movw r1, #0x3F80
      0xF2C2, 0x0100,  // movt r1, #0x2000
      0x6001,          // str r1, [r0]
      0x468D,          // mov sp, r1
      0x2220,          // movs r2, #32
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.ipsr(), 0U);
  bench_.put_word(CpuBench::kStack - 0x80 + 4 * CpuBench::kHardFault, CpuBench::kHandler | 1);
  bench_.cpu().set_irq(40, true);
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(bench_.ipsr(), 0U);  // not enabled
  bench_.cpu().set_register(CpuBench::Register::kPc, 0x380);
  bench_.put(0x380, {
                        0xF24E, 0x1004,  // movw r0, #0xE104
                        0xF2CE, 0x0000,  // movt r0, #0xE000
                        0xF44F, 0x7180,  // mov.w r1, #0x100
                        0x6001,          // str r1, [r0]
                        0xE7FE,          // b .
                    });
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(bench_.ipsr(), CpuBench::kHardFault);
  EXPECT_EQ(bench_.r(9), kVecttbl);
}

TEST_F(CpuFaults, BreakpointWithoutADebugger) {
  bench_.run({
      0xBF00,  // nop
      0xBEAB,  // bkpt #0xAB
      0xE7FE,  // b .
  });
  expect_fault(CpuBench::kHardFault, 0, CpuBench::kMain + 2);
  EXPECT_EQ(bench_.r(9), kDebugevt);
}

TEST_F(CpuFaults, SupervisorCallThatCannotBeTaken) {
  bench_.run({
      0xB672,  // cpsid i
      0xDF00,  // svc #0
      0xE7FE,  // b .
  });
  expect_fault(CpuBench::kHardFault, 0, CpuBench::kMain + 4);
  EXPECT_EQ(bench_.r(9), kForced);
}

TEST_F(CpuFaults, StatusIsClearedByWritingOnes) {
  bench_.put(0x1800, {
                         0xF64E, 0x5028,  // movw r0, #0xED28
                         0xF2CE, 0x0000,  // movt r0, #0xE000
                         0x2180,          // movs r1, #0x80
                         0x7041,          // strb r1, [r0, #1]
                         0x6804,          // ldr r4, [r0]
                         0x6845,          // ldr r5, [r0, #4]
                         0x6045,          // str r5, [r0, #4]
                         0x6845,          // ldr r5, [r0, #4]
                         0x8846,          // ldrh r6, [r0, #2]
                         0x7847,          // ldrb r7, [r0, #1]
                         0xE7FE,          // b .
                     });
  bench_.handler(CpuBench::kHardFault, 0x1800);
  bench_.run({
      0xF04F, 0x5140,  // mov.w r1, #0x30000000
      0x6808,          // ldr r0, [r1]
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.r(4), kPreciserr);
  EXPECT_EQ(bench_.r(5), 0U);
  EXPECT_EQ(bench_.r(6), 0U);
  EXPECT_EQ(bench_.r(7), kPreciserr >> 8);
}

TEST_F(CpuFaults, TheBusDecidesAboutAStoreToFlash) {
  with_faults_enabled({
      0xF242, 0x0200,  // movw r2, #0x2000
      0x2355,          // movs r3, #0x55
      0x6013,          // str r3, [r2]
      0xE7FE,          // b .
  });
  expect_fault(CpuBench::kBusFault, kPreciserr | kBfarvalid, kProgram + 6);
  EXPECT_EQ(bench_.r(10), 0x2000U);

  bench_.on_flash_write = [](std::uint32_t, std::uint32_t) { return true; };
  bench_.put_word(0x2000, 0xFFFFFF0F);
  with_faults_enabled({
      0xF242, 0x0200,  // movw r2, #0x2000
      0x2355,          // movs r3, #0x55
      0x6013,          // str r3, [r2]
      0x6814,          // ldr r4, [r2]
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.ipsr(), 0U);
  EXPECT_EQ(bench_.r(4), 0x05U);
}

TEST_F(CpuFaults, CodeThatWasWrittenToFlashIsRun) {
  bench_.on_flash_write = [](std::uint32_t, std::uint32_t) { return true; };
  bench_.put(0x2000, {
                         0x20FF,  // movs r0, #0xFF
                         0x4770,  // bx lr
                     });
  with_faults_enabled({
      0xF242, 0x0501,  // movw r5, #0x2001
      0x47A8,          // blx r5
      0x4606,          // mov r6, r0
      0xF242, 0x0200,  // movw r2, #0x2000
      0xF242, 0x0311,  // movw r3, #0x2011
      0xF2C4, 0x7370,  // movt r3, #0x4770
      0x6013,          // str r3, [r2]
      0x47A8,          // blx r5
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.r(6), 0xFFU);
  EXPECT_EQ(bench_.r(0), 0x11U);
}

TEST_F(CpuFaults, AnUnmodelledAccessEndsTheRunAndIsNamed) {
  const auto error_of = [&](const CpuBench::Code& program) -> std::string {
    try {
      bench_.run(program);
    } catch (const SimulationError& error) {
      return error.what();
    }
    return "none";
  };
  EXPECT_EQ(error_of({
                0xF64E, 0x5094,  // movw r0, #0xED94
                0xF2CE, 0x0000,  // movt r0, #0xE000
                0x2105,          // movs r1, #5
                0x6001,          // str r1, [r0]
                0xE7FE,          // b .
            }),
            "a write of 0x5 (4 bytes) to 0xe000ed94, which is not modelled (PC 0x0000020a)");
  EXPECT_EQ(error_of({
                0xF241, 0x0000,  // movw r0, #0x1000
                0xF2CE, 0x0000,  // movt r0, #0xE000
                0xBF00,          // nop
                0x6841,          // ldr r1, [r0, #4]
                0xE7FE,          // b .
            }),
            "a read of 4 bytes at 0xe0001004, which is not modelled (PC 0x0000020a)");
  // CCR.UNALIGN_TRP.
  EXPECT_EQ(error_of({
                0xF64E, 0x5014,  // movw r0, #0xED14
                0xF2CE, 0x0000,  // movt r0, #0xE000
                0xF44F, 0x7102,  // mov.w r1, #0x208
                0x6001,          // str r1, [r0]
                0xE7FE,          // b .
            }),
            "a write of 0x208 (4 bytes) to 0xe000ed14, which is not modelled (PC 0x0000020c)");
}

TEST_F(CpuFaults, CodeInRamIsNotModelled) {
  try {
    bench_.run({
        0xF240, 0x1001,  // movw r0, #0x0101
        0xF2C2, 0x0000,  // movt r0, #0x2000
        0x4700,          // bx r0
    });
    FAIL();
  } catch (const SimulationError& error) {
    EXPECT_STREQ(error.what(), "execution of RAM, which is not modelled, at 0x20000100");
  }
}

TEST_F(CpuFaults, AnErrorOfTheBusEndsTheRunAndMayReadThePc) {
  bench_.on_write = [&](std::uint32_t address, std::uint32_t) {
    throw SimulationError(std::to_string(address - CpuBench::kBus) + " at " +
                          std::to_string(bench_.cpu().pc()));
  };
  try {
    bench_.run({
        0xF04F, 0x4080,  // mov.w r0, #0x40000000
        0xBF00,          // nop
        0x6141,          // str r1, [r0, #20]
        0xE7FE,          // b .
    });
    FAIL();
  } catch (const SimulationError& error) {
    EXPECT_EQ(error.what(), "20 at " + std::to_string(CpuBench::kMain + 6));
  }
}

TEST_F(CpuFaults, ThePrivateBusIsClosedToUnprivilegedCode) {
  with_faults_enabled({
      0x2201,          // movs r2, #1
      0xF382, 0x8814,  // msr control, r2
      0xF64E, 0x5000,  // movw r0, #0xED00
      0xF2CE, 0x0000,  // movt r0, #0xE000
      0x6803,          // ldr r3, [r0]
      0xE7FE,          // b .
  });
  expect_fault(CpuBench::kBusFault, kPreciserr | kBfarvalid, kProgram + 14);
}

}  // namespace
}  // namespace groma::sim
