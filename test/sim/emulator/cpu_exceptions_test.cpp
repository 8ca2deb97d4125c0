// Entry, return and order of exceptions. Sections: ARMv7-M Architecture Reference Manual (DDI 0403E).
#include <gtest/gtest.h>

#include "test/sim/emulator/cpu_bench.hpp"

namespace groma::sim {
namespace {

using Register = CpuBench::Register;

// Handlers append their letter to a string in RAM that R7 points to.
class CpuExceptions : public testing::Test {
 protected:
  static constexpr std::uint32_t kText = CpuBench::kRam + 0x100;
  static constexpr std::uint32_t kProgram = 0x380;

  CpuExceptions() {
    for (std::uint32_t i = 0; i < 8; ++i) {
      writes_letter(0x1800 + 0x40 * i, static_cast<char>('a' + i));
      bench_.handler(CpuBench::kIrq0 + i, 0x1800 + 0x40 * i);
    }
    writes_letter(0x1C00, 's');
    bench_.handler(CpuBench::kSvCall, 0x1C00);
    writes_letter(0x1C40, 'p');
    bench_.handler(CpuBench::kPendSv, 0x1C40);
    writes_letter(0x1C80, 't');
    bench_.handler(CpuBench::kSysTick, 0x1C80);
    writes_letter(0x1CC0, 'n');
    bench_.handler(CpuBench::kNmi, 0x1CC0);
  }

  void writes_letter(std::uint32_t address, char letter) {
    bench_.put(address, {
                            0x2000,          // movs r0, #0
                            0xF807, 0x0B01,  // strb.w r0, [r7], #1
                            0x4770,          // bx lr
                        });
    bench_.put(address, {static_cast<std::uint16_t>(0x2000 | letter)});
  }

  // Runs the program with interrupts 0 to 7 enabled, R6 = 0xE000E000, and R7 at the text.
  void run(const CpuBench::Code& program) {
    bench_.put(kProgram, program);
    bench_.run({
        0xF240, 0x1700,  // movw r7, #0x0100
        0xF2C2, 0x0700,  // movt r7, #0x2000
        0xF04F, 0x26E0,  // mov.w r6, #0xE000E000
        0x20FF,          // movs r0, #0xFF
        0xF8C6, 0x0100,  // str.w r0, [r6, #0x100]
        0xF44F, 0x0070,  // mov.w r0, #0xF00000
        0xF8C6, 0x0D88,  // str.w r0, [r6, #0xD88]
        0xF3BF, 0x8F6F,  // isb
        0xF000, 0xB8AF,  // b.w .+354
    });
  }

  [[nodiscard]] std::string text() {
    std::string letters;
    for (std::uint32_t at = kText; at < bench_.r(7); ++at) {
      letters += static_cast<char>(bench_.word(at & ~3U) >> 8 * (at & 3));
    }
    return letters;
  }

  CpuBench bench_;
};

TEST_F(CpuExceptions, StacksEightWordsAndReturns) {
  bench_.put(0x1800, {
                         0x46E8,          // mov r8, sp
                         0x46F1,          // mov r9, lr
                         0xF3EF, 0x8A05,  // mrs r10, ipsr
                         0x2000,          // movs r0, #0
                         0x2100,          // movs r1, #0
                         0x2200,          // movs r2, #0
                         0x2300,          // movs r3, #0
                         0x4684,          // mov r12, r0
                         0x4280,          // cmp r0, r0
                         0x4770,          // bx lr
                     });
  run({
      0x466C,          // mov r4, sp
      0x200A,          // movs r0, #10
      0x210B,          // movs r1, #11
      0x220C,          // movs r2, #12
      0x230D,          // movs r3, #13
      0xF04F, 0x0C0E,  // mov.w r12, #14
      0xF04F, 0x0E0F,  // mov.w lr, #15
      0xF04F, 0x0501,  // mov.w r5, #1
      0xF1B5, 0x0B02,  // adds.w r11, r5, #-2
      0xF8C6, 0x5200,  // str.w r5, [r6, #0x200]
      0xF3BF, 0x8F6F,  // isb
      0xF3EF, 0x8B00,  // mrs r11, apsr
      0xE7FE,          // b .
  });
  const std::uint32_t stack = bench_.r(4);
  EXPECT_EQ(stack, CpuBench::kStack);
  EXPECT_EQ(bench_.r(8), stack - 0x20);
  EXPECT_EQ(bench_.r(9), 0xFFFFFFF9U);
  EXPECT_EQ(bench_.r(10), CpuBench::kIrq0);
  const std::uint32_t expected[] = {10, 11, 12, 13, 14, 15};
  for (std::uint32_t i = 0; i < 6; ++i) EXPECT_EQ(bench_.word(stack - 0x20 + 4 * i), expected[i]) << i;
  EXPECT_EQ(bench_.word(stack - 8), kProgram + 34);
  EXPECT_EQ(bench_.word(stack - 4), 1U << 31 | 1U << 24);  // N, T
  // All registers are restored.
  EXPECT_EQ(bench_.reg(Register::kSp), stack);
  for (unsigned i = 0; i < 4; ++i) EXPECT_EQ(bench_.r(i), 10 + i);
  EXPECT_EQ(bench_.r(12), 14U);
  EXPECT_EQ(bench_.reg(Register::kLr), 15U);
  EXPECT_EQ(bench_.r(11), 1U << 31);
}

TEST_F(CpuExceptions, AlignsTheStackAndRestoresIt) {
  bench_.put(0x1800, {
                         0x46E8,          // mov r8, sp
                         0xF8DD, 0x901C,  // ldr.w r9, [sp, #28]
                         0x4770,          // bx lr
                     });
  run({
      0xB081,          // sub sp, #4
      0x2501,          // movs r5, #1
      0xF8C6, 0x5200,  // str.w r5, [r6, #0x200]
      0xF3BF, 0x8F6F,  // isb
      0x466C,          // mov r4, sp
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.r(4), CpuBench::kStack - 4);
  EXPECT_EQ(bench_.r(8), CpuBench::kStack - 8 - 0x20);
  EXPECT_EQ(bench_.r(9) & 1U << 9, 1U << 9);

  // B1.5.7: no alignment with STKALIGN off.
  run({
      0x2500,          // movs r5, #0
      0xF8C6, 0x5D14,  // str.w r5, [r6, #0xD14]
      0xB081,          // sub sp, #4
      0x2501,          // movs r5, #1
      0xF8C6, 0x5200,  // str.w r5, [r6, #0x200]
      0xF3BF, 0x8F6F,  // isb
      0x466C,          // mov r4, sp
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.r(4), CpuBench::kStack - 4);
  EXPECT_EQ(bench_.r(8), CpuBench::kStack - 4 - 0x20);
  EXPECT_EQ(bench_.r(9) & 1U << 9, 0U);
}

TEST_F(CpuExceptions, StacksFloatingPointOnlyWhereItWasUsed) {
  bench_.put(0x1800, {
                         0x46E8,          // mov r8, sp
                         0x46F1,          // mov r9, lr
                         0xF3EF, 0x8A14,  // mrs r10, control
                         0xEE00, 0x8A10,  // vmov s0, r8
                         0xEE07, 0x8A90,  // vmov s15, r8
                         0xEEF1, 0x0A10,  // vmrs r0, fpscr
                         0xF040, 0x4000,  // orr r0, r0, #0x80000000
                         0xEEE1, 0x0A10,  // vmsr fpscr, r0
                         0xF3EF, 0x8B14,  // mrs r11, control
                         0x4770,          // bx lr
                     });
  run({
      0x2007,          // movs r0, #7
      0xEE00, 0x0A10,  // vmov s0, r0
      0x2008,          // movs r0, #8
      0xEE07, 0x0A90,  // vmov s15, r0
      0x2501,          // movs r5, #1
      0xF8C6, 0x5200,  // str.w r5, [r6, #0x200]
      0xF3BF, 0x8F6F,  // isb
      0x466C,          // mov r4, sp
      0xEE10, 0x0A10,  // vmov r0, s0
      0xEE17, 0x1A90,  // vmov r1, s15
      0xEEF1, 0x2A10,  // vmrs r2, fpscr
      0xF8D6, 0x3F38,  // ldr.w r3, [r6, #0xF38]
      0xE7FE,          // b .
  });
  const std::uint32_t stack = CpuBench::kStack;
  EXPECT_EQ(bench_.r(4), stack);
  EXPECT_EQ(bench_.r(8), stack - 0x68);
  EXPECT_EQ(bench_.r(9), 0xFFFFFFE9U);
  EXPECT_EQ(bench_.r(10) & 4U, 0U);  // FPCA
  EXPECT_EQ(bench_.r(11) & 4U, 4U);
  EXPECT_EQ(bench_.reg(Register::kControl) & 4U, 4U);
  EXPECT_EQ(bench_.r(0), 7U);
  EXPECT_EQ(bench_.r(1), 8U);
  EXPECT_EQ(bench_.r(2), 0U);
  EXPECT_EQ(bench_.r(3), stack - 0x68 + 0x20);
}

TEST_F(CpuExceptions, AHandlersFloatsAreStackedAgainAfterAHandlerWithoutFloats) {
  // Interrupt 0 uses floats and pends 1 twice, with no floats in between.
  bench_.put(0x1800, {
                         0x2007,          // movs r0, #7
                         0xEE00, 0x0A10,  // vmov s0, r0
                         0x2502,          // movs r5, #2
                         0x4674,          // mov r4, lr
                         0xF8C6, 0x5200,  // str.w r5, [r6, #0x200]
                         0xF3BF, 0x8F6F,  // isb
                         0x46C2,          // mov r10, r8
                         0xF8C6, 0x5200,  // str.w r5, [r6, #0x200]
                         0xF3BF, 0x8F6F,  // isb
                         0xEE10, 0xBA10,  // vmov r11, s0
                         0x4720,          // bx r4
                     });
  bench_.put(0x1840, {
                         0x46F0,          // mov r8, lr
                         0xF3EF, 0x8914,  // mrs r9, control
                         0x4770,          // bx lr
                     });
  run({
      0x2080,          // movs r0, #0x80
      0xF886, 0x0400,  // strb.w r0, [r6, #0x400]
      0x2001,          // movs r0, #1
      0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
      0xF3BF, 0x8F6F,  // isb
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.r(4), 0xFFFFFFF9U);
  EXPECT_EQ(bench_.r(10), 0xFFFFFFE1U);
  EXPECT_EQ(bench_.r(8), 0xFFFFFFE1U);
  EXPECT_EQ(bench_.r(9) & 4U, 0U);
  EXPECT_EQ(bench_.r(11), 7U);
  EXPECT_EQ(bench_.reg(Register::kControl) & 4U, 0U);
}

TEST_F(CpuExceptions, HigherPriorityComesFirstAndLowerWaits) {
  run({
      0xF04F, 0x4080,  // mov.w r0, #0x40000000
      0xF440, 0x00C0,  // orr r0, r0, #0x00600000
      0xF440, 0x4000,  // orr r0, r0, #0x00008000
      0xF040, 0x00A0,  // orr r0, r0, #0x000000A0
      0xF8C6, 0x0400,  // str.w r0, [r6, #0x400]
      0xB672,          // cpsid i
      0x200F,          // movs r0, #0x0F
      0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
      0xB662,          // cpsie i
      0xBF00,          // nop
      0xE7FE,          // b .
  });
  // Priorities: 0 has 0xA0, 1 has 0x80, 2 has 0x60, 3 has 0x40.
  EXPECT_EQ(text(), "dcba");
}

TEST_F(CpuExceptions, LowerNumberComesFirstAtEqualPriority) {
  run({
      0xB672,          // cpsid i
      0x200E,          // movs r0, #0x0E
      0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
      0xB662,          // cpsie i
      0xBF00,          // nop
      0xE7FE,          // b .
  });
  EXPECT_EQ(text(), "bcd");
}

TEST_F(CpuExceptions, PreemptsALowerHandler) {
  // Interrupt 0 (priority 0x80) pends 1 (0x40) and 2 (0x80) while it runs.
  bench_.put(0x1800, {
                         0x2061,          // movs r0, #97
                         0xF807, 0x0B01,  // strb.w r0, [r7], #1
                         0x2006,          // movs r0, #6
                         0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
                         0xF3BF, 0x8F6F,  // isb
                         0x2041,          // movs r0, #65
                         0xF807, 0x0B01,  // strb.w r0, [r7], #1
                         0x4770,          // bx lr
                     });
  run({
      0xF244, 0x0080,  // movw r0, #0x4080
      0xF2C0, 0x0080,  // movt r0, #0x0080
      0xF8C6, 0x0400,  // str.w r0, [r6, #0x400]
      0x2001,          // movs r0, #1
      0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
      0xF3BF, 0x8F6F,  // isb
      0x202E,          // movs r0, #46
      0xF807, 0x0B01,  // strb.w r0, [r7], #1
      0xE7FE,          // b .
  });
  EXPECT_EQ(text(), "abAc.");
}

// B1.5.4: with PRIGROUP 6 only bit 7 preempts; the rest orders pending interrupts.
TEST_F(CpuExceptions, SubpriorityDoesNotPreempt) {
  bench_.put(0x1800, {
                         0x2061,          // movs r0, #97
                         0xF807, 0x0B01,  // strb.w r0, [r7], #1
                         0x2006,          // movs r0, #6
                         0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
                         0xF3BF, 0x8F6F,  // isb
                         0x2041,          // movs r0, #65
                         0xF807, 0x0B01,  // strb.w r0, [r7], #1
                         0x4770,          // bx lr
                     });
  run({
      0xF240, 0x6000,  // movw r0, #0x0600
      0xF2C0, 0x50FA,  // movt r0, #0x05FA
      0xF8C6, 0x0D0C,  // str.w r0, [r6, #0xD0C]
      0xF24C, 0x00E0,  // movw r0, #0xC0E0
      0xF2C0, 0x00A0,  // movt r0, #0x00A0
      0xF8C6, 0x0400,  // str.w r0, [r6, #0x400]
      0x2001,          // movs r0, #1
      0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
      0xF3BF, 0x8F6F,  // isb
      0xF8D6, 0x5D0C,  // ldr.w r5, [r6, #0xD0C]
      0xE7FE,          // b .
  });
  EXPECT_EQ(text(), "aAcb");
  EXPECT_EQ(bench_.r(5), 0xFA050600U);
}

TEST_F(CpuExceptions, BasepriMasksFromItsPriorityOn) {
  run({
      0xF244, 0x0080,  // movw r0, #0x4080
      0xF8C6, 0x0400,  // str.w r0, [r6, #0x400]
      0x2080,          // movs r0, #0x80
      0xF380, 0x8811,  // msr basepri, r0
      0x2003,          // movs r0, #3
      0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
      0xF3BF, 0x8F6F,  // isb
      0x202E,          // movs r0, #46
      0xF807, 0x0B01,  // strb.w r0, [r7], #1
      0x2000,          // movs r0, #0
      0xF380, 0x8811,  // msr basepri, r0
      0xBF00,          // nop
      0xE7FE,          // b .
  });
  EXPECT_EQ(text(), "b.a");
}

TEST_F(CpuExceptions, BasepriMaxOnlyRaises) {
  run({
      0x2040,          // movs r0, #0x40
      0xF380, 0x8811,  // msr basepri, r0
      0x2080,          // movs r0, #0x80
      0xF380, 0x8812,  // msr basepri_max, r0
      0xF3EF, 0x8411,  // mrs r4, basepri
      0x2020,          // movs r0, #0x20
      0xF380, 0x8812,  // msr basepri_max, r0
      0xF3EF, 0x8511,  // mrs r5, basepri
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.r(4), 0x40U);
  EXPECT_EQ(bench_.r(5), 0x20U);
}

TEST_F(CpuExceptions, FaultmaskBlocksAllButTheNmiAndEndsWithItsHandler) {
  bench_.put(0x1800, {
                         0xB671,          // cpsid f
                         0x2002,          // movs r0, #2
                         0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
                         0xF04F, 0x4000,  // mov.w r0, #0x80000000
                         0xF8C6, 0x0D04,  // str.w r0, [r6, #0xD04]
                         0xF3BF, 0x8F6F,  // isb
                         0x202E,          // movs r0, #46
                         0xF807, 0x0B01,  // strb.w r0, [r7], #1
                         0x4770,          // bx lr
                     });
  run({
      0x2080,          // movs r0, #0x80
      0xF886, 0x0400,  // strb.w r0, [r6, #0x400]
      0x2001,          // movs r0, #1
      0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
      0xF3BF, 0x8F6F,  // isb
      0xF3EF, 0x8413,  // mrs r4, faultmask
      0xE7FE,          // b .
  });
  EXPECT_EQ(text(), "n.b");
  EXPECT_EQ(bench_.r(4), 0U);
}

TEST_F(CpuExceptions, ThreadOnTheProcessStack) {
  bench_.put(0x1800, {
                         0x46E8,          // mov r8, sp
                         0x46F1,          // mov r9, lr
                         0xF3EF, 0x8A14,  // mrs r10, control
                         0xF3EF, 0x8B09,  // mrs r11, psp
                         0x4770,          // bx lr
                     });
  run({
      0xF640, 0x0000,  // movw r0, #0x0800
      0xF2C2, 0x0000,  // movt r0, #0x2000
      0xF380, 0x8809,  // msr psp, r0
      0x2002,          // movs r0, #2
      0xF380, 0x8814,  // msr control, r0
      0xF3BF, 0x8F6F,  // isb
      0x2501,          // movs r5, #1
      0xF8C6, 0x5200,  // str.w r5, [r6, #0x200]
      0xF3BF, 0x8F6F,  // isb
      0x466C,          // mov r4, sp
      0xF3EF, 0x8514,  // mrs r5, control
      0xF3EF, 0x8308,  // mrs r3, msp
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.r(4), 0x20000800U);
  EXPECT_EQ(bench_.r(5), 2U);
  EXPECT_EQ(bench_.r(3), CpuBench::kStack);
  EXPECT_EQ(bench_.r(8), CpuBench::kStack);
  EXPECT_EQ(bench_.r(9), 0xFFFFFFFDU);
  EXPECT_EQ(bench_.r(10), 0U);  // SPSEL reads zero in a handler
  EXPECT_EQ(bench_.r(11), 0x20000800U - 0x20);
}

TEST_F(CpuExceptions, UnprivilegedThreadCallsTheSupervisorAndStaysUnprivileged) {
  bench_.put(0x1C00, {
                         0xF3EF, 0x8814,  // mrs r8, control
                         0xF3EF, 0x8909,  // mrs r9, psp
                         0x2020,          // movs r0, #0x20
                         0xF380, 0x8811,  // msr basepri, r0
                         0xF3EF, 0x8A11,  // mrs r10, basepri
                         0x4770,          // bx lr
                     });
  run({
      0xF640, 0x0000,  // movw r0, #0x0800
      0xF2C2, 0x0000,  // movt r0, #0x2000
      0xF380, 0x8809,  // msr psp, r0
      0x2003,          // movs r0, #3
      0xF380, 0x8814,  // msr control, r0
      0xF3BF, 0x8F6F,  // isb
      0xDF01,          // svc #1
      0xF3EF, 0x8414,  // mrs r4, control
      0x466D,          // mov r5, sp
      0xF3EF, 0x8311,  // mrs r3, basepri
      0xB672,          // cpsid i
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.r(8), 1U);
  EXPECT_EQ(bench_.r(9), 0x20000800U - 0x20);
  EXPECT_EQ(bench_.r(10), 0x20U);
  EXPECT_EQ(bench_.r(4), 3U);
  EXPECT_EQ(bench_.r(5), 0x20000800U);
  EXPECT_EQ(bench_.r(3), 0U);
  // The mask that the handler left stays in force although the thread cannot read it; the thread's CPSID had
  // no effect.
  bench_.cpu().set_irq(3, true);
  bench_.cpu().set_irq(3, false);
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(text(), "d");
}

TEST_F(CpuExceptions, MaskedInUnprivilegedThread) {
  run({
      0x2080,          // movs r0, #0x80
      0xF8C6, 0x0400,  // str.w r0, [r6, #0x400]
      0x2080,          // movs r0, #0x80
      0xF380, 0x8811,  // msr basepri, r0
      0x2001,          // movs r0, #1
      0xF380, 0x8814,  // msr control, r0
      0xF3BF, 0x8F6F,  // isb
      0xE7FE,          // b .
  });
  bench_.cpu().set_irq(0, true);
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(text(), "");
}

TEST_F(CpuExceptions, TailChainsWithoutUnstacking) {
  // Both handlers see the same frame; the time is that of one entry, one chain and one return.
  run({
      0xB672,          // cpsid i
      0x2003,          // movs r0, #3
      0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
      0xB662,          // cpsie i
      0xE7FE,          // b .
  });
  EXPECT_EQ(text(), "ab");
  EXPECT_EQ(bench_.cpu().exceptions(), 2U);

  const CpuTiming timing{.cycle = 4992,
                         .instruction = 6240,
                         .entry_cycles = 1000,
                         .return_cycles = 300,
                         .tail_chain_cycles = 70};
  const auto time_of = [&](bool second) {
    CpuBench bench(timing);
    bench.handler(CpuBench::kSvCall, 0x1800);
    bench.handler(CpuBench::kPendSv, 0x1840);
    bench.put(0x1800, {
                          0x4770,  // bx lr
                      });
    bench.put(0x1840, {
                          0x4770,  // bx lr
                      });
    bench.put(CpuBench::kMain, {
                                   0xF04F, 0x26E0,  // mov.w r6, #0xE000E000
                                   0xF04F, 0x5080,  // mov.w r0, #0x10000000
                                   0xF64E, 0x5104,  // movw r1, #0xED04
                                   0xF2CE, 0x0100,  // movt r1, #0xE000
                                   0xB672,          // cpsid i
                                   0xBF00,          // nop
                                   0xB662,          // cpsie i
                                   0xDF00,          // svc #0
                                   0xBF30,          // wfi
                               });
    // PendSV is pended while it is masked, and taken afterwards; or not at all.
    bench.cpu().reset(0);
    if (second) {
      bench.put(0x1800, {
                            0x6008,  // str r0, [r1]
                            0x4770,  // bx lr
                        });
    }
    bench.cpu().run(kUnitsPerSecond);
    return bench.cpu().now();
  };
  // PendSV has SVCall's priority and waits for its end: one more instruction each in both handlers.
  EXPECT_EQ(time_of(true) - time_of(false), 70 * timing.cycle + 2 * timing.instruction);
}

TEST_F(CpuExceptions, ALineThatStaysHighPendsAgain) {
  run({
      0xE7FE,  // b .
  });
  bench_.cpu().set_irq(2, true);
  bench_.cpu().run(bench_.cpu().now() + 100 * kUnitsPerMicrosecond);
  const std::size_t often = text().size();
  EXPECT_GT(often, 50U);
  bench_.cpu().set_irq(2, false);
  bench_.run_for(100 * kUnitsPerMicrosecond);
  // An interrupt that was pending when the line fell is taken once more.
  EXPECT_LE(text().size(), often + 2);
}

TEST_F(CpuExceptions, ALineThatIsHighCannotBeCleared) {
  run({
      0xB672,  // cpsid i
      0xE7FE,  // b .
  });
  bench_.cpu().set_irq(2, true);
  bench_.cpu().set_register(Register::kPc, 0x400);
  bench_.put(0x400, {
                        0x2004,          // movs r0, #4
                        0xF8C6, 0x0280,  // str.w r0, [r6, #0x280]
                        0xF8D6, 0x1200,  // ldr.w r1, [r6, #0x200]
                        0xE7FE,          // b .
                    });
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(bench_.r(1), 4U);
  bench_.cpu().set_irq(2, false);
  bench_.cpu().set_register(Register::kPc, 0x400);
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(bench_.r(1), 0U);
}

TEST_F(CpuExceptions, APulseIsRemembered) {
  run({
      0xB672,  // cpsid i
      0xBF00,  // nop
      0xBF00,  // nop
      0xE000,  // b .+4
      0xBF00,  // nop
      0x2000,  // movs r0, #0
      0xBF30,  // wfi
      0xB662,  // cpsie i
      0xE7FE,  // b .
  });
  EXPECT_TRUE(bench_.cpu().sleeping());
  bench_.cpu().set_irq(1, true);
  bench_.cpu().set_irq(1, false);
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(text(), "b");
}

TEST_F(CpuExceptions, RegistersOfTheInterruptController) {
  run({
      0x200C,          // movs r0, #0x0C
      0xF8C6, 0x0180,  // str.w r0, [r6, #0x180]
      0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
      0xF8D6, 0x1100,  // ldr.w r1, [r6, #0x100]
      0xF8D6, 0x2200,  // ldr.w r2, [r6, #0x200]
      0x2004,          // movs r0, #4
      0xF8C6, 0x0280,  // str.w r0, [r6, #0x280]
      0xF8D6, 0x3280,  // ldr.w r3, [r6, #0x280]
      0xF04F, 0x30FF,  // mov.w r0, #0xFFFFFFFF
      0xF8C6, 0x0404,  // str.w r0, [r6, #0x404]
      0xF8D6, 0x4404,  // ldr.w r4, [r6, #0x404]
      0xF896, 0x5406,  // ldrb.w r5, [r6, #0x406]
      0xF8D6, 0x8004,  // ldr.w r8, [r6, #4]
      0xF8D6, 0x9D00,  // ldr.w r9, [r6, #0xD00]
      0xF8D6, 0xAD04,  // ldr.w r10, [r6, #0xD04]
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.r(1), 0xF3U);
  EXPECT_EQ(bench_.r(2), 0x0CU);
  EXPECT_EQ(bench_.r(3), 0x08U);
  EXPECT_EQ(bench_.r(4), 0xE0E0E0E0U);  // three bits are implemented
  EXPECT_EQ(bench_.r(5), 0xE0U);
  EXPECT_EQ(bench_.r(8), 1U);
  EXPECT_EQ(bench_.r(9), 0x410FC241U);
  EXPECT_EQ(bench_.r(10), 1U << 22 | 1U << 11);  // ISRPENDING, RETTOBASE; disabled ones are not VECTPENDING
  EXPECT_EQ(text(), "");
}

TEST_F(CpuExceptions, SoftwareTriggerAndPendedSystemHandlers) {
  run({
      0x2005,          // movs r0, #5
      0xF8C6, 0x0F00,  // str.w r0, [r6, #0xF00]
      0xF3BF, 0x8F6F,  // isb
      0xF04F, 0x5080,  // mov.w r0, #0x10000000
      0xF8C6, 0x0D04,  // str.w r0, [r6, #0xD04]
      0xF3BF, 0x8F6F,  // isb
      0xF04F, 0x6080,  // mov.w r0, #0x04000000
      0xF8C6, 0x0D04,  // str.w r0, [r6, #0xD04]
      0xF3BF, 0x8F6F,  // isb
      0xF04F, 0x4000,  // mov.w r0, #0x80000000
      0xF8C6, 0x0D04,  // str.w r0, [r6, #0xD04]
      0xF3BF, 0x8F6F,  // isb
      0xDF00,          // svc #0
      0xE7FE,          // b .
  });
  EXPECT_EQ(text(), "fptns");
}

TEST_F(CpuExceptions, PendSvCanBeCancelled) {
  run({
      0xB672,          // cpsid i
      0xF04F, 0x5080,  // mov.w r0, #0x10000000
      0xF8C6, 0x0D04,  // str.w r0, [r6, #0xD04]
      0xF04F, 0x6000,  // mov.w r0, #0x08000000
      0xF8C6, 0x0D04,  // str.w r0, [r6, #0xD04]
      0xB662,          // cpsie i
      0xBF00,          // nop
      0xE7FE,          // b .
  });
  EXPECT_EQ(text(), "");
}

TEST_F(CpuExceptions, VectorTableMoves) {
  bench_.put_word(CpuBench::kRam + 0x400 + 4 * CpuBench::kIrq0, 0x1840 | 1);
  run({
      0xF240, 0x4000,  // movw r0, #0x0400
      0xF2C2, 0x0000,  // movt r0, #0x2000
      0xF8C6, 0x0D08,  // str.w r0, [r6, #0xD08]
      0x2001,          // movs r0, #1
      0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
      0xF3BF, 0x8F6F,  // isb
      0xE7FE,          // b .
  });
  EXPECT_EQ(text(), "b");
}

TEST_F(CpuExceptions, ResetIsRequestedAndClearsTheState) {
  run({
      0x2040,          // movs r0, #0x40
      0xF380, 0x8811,  // msr basepri, r0
      0xF240, 0x0004,  // movw r0, #4
      0xF2C0, 0x50FA,  // movt r0, #0x05FA
      0xF8C6, 0x0D0C,  // str.w r0, [r6, #0xD0C]
      0x2501,          // movs r5, #1
      0xE7FE,          // b .
  });
  EXPECT_TRUE(bench_.cpu().reset_requested());
  EXPECT_EQ(bench_.cpu().next_wake(), kNever);
  bench_.put(CpuBench::kMain, {
                                  0xF3EF, 0x8111,  // mrs r1, basepri
                                  0xF3EF, 0x8214,  // mrs r2, control
                                  0x466B,          // mov r3, sp
                                  0xE7FE,          // b .
                              });
  const SimTime t = bench_.cpu().now();
  bench_.cpu().reset(t);
  EXPECT_FALSE(bench_.cpu().reset_requested());
  EXPECT_EQ(bench_.cpu().now(), t);
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(bench_.r(1), 0U);
  EXPECT_EQ(bench_.r(2), 0U);
  EXPECT_EQ(bench_.r(3), CpuBench::kStack);
}

TEST_F(CpuExceptions, ReturnToThreadUnderAHandlerWhereItIsAllowed) {
  // B1.5.8, CCR.NONBASETHRDENA.
  bench_.put(0x1C00, {
                         0xF240, 0x2001,  // mov.w r0, #0x201
                         0xF8C6, 0x0D14,  // str.w r0, [r6, #0xD14]
                         0x2001,          // movs r0, #1
                         0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
                         0xF3BF, 0x8F6F,  // isb
                         0x4674,          // mov r4, lr
                         0xE7FE,          // b .
                     });
  bench_.put(0x1800, {
                         0x9807,          // ldr r0, [sp, #28]
                         0xF020, 0x00FF,  // bic r0, r0, #0xFF
                         0x9007,          // str r0, [sp, #28]
                         0xF06F, 0x0E06,  // mvn lr, #6
                         0x4770,          // bx lr
                     });
  run({
      0x2080,          // movs r0, #0x80
      0xF886, 0x0D1F,  // strb.w r0, [r6, #0xD1F]
      0xDF00,          // svc #0
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.ipsr(), 0U);
  EXPECT_EQ(bench_.cpu().pc(), 0x1C00U + 20);
}

}  // namespace
}  // namespace groma::sim
