// Time and sleep, and that the result does not depend on how a run is divided.
#include <gtest/gtest.h>

#include <algorithm>
#include <random>

#include "firmware/sim/simulation_error.hpp"
#include "test/sim/emulator/cpu_bench.hpp"

namespace groma::sim {
namespace {

constexpr SimTime kInstruction = CpuTiming{}.instruction;
constexpr SimTime kCycle = CpuTiming{}.cycle;

TEST(CpuTime, EachInstructionHasItsCost) {
  for (const SimTime cost : {kInstruction, kInstruction * 3 / 2}) {
    CpuTiming timing;
    timing.instruction = cost;
    CpuBench bench(timing);
    bench.run({
        0x200A,  // movs r0, #10
        0xBF00,  // nop
        0xBF00,  // nop
        0x3801,  // subs r0, #1
        0xD1FB,  // bne .-6
        0xBF30,  // wfi
    });
    // 1 + 10 x 4 + 1
    EXPECT_EQ(bench.cpu().instructions(), 42U);
    EXPECT_TRUE(bench.cpu().sleeping());
    bench.cpu().reset(5 * kUnitsPerMillisecond);
    bench.cpu().run(6 * kUnitsPerMillisecond);
    EXPECT_EQ(bench.cpu().now(), 5 * kUnitsPerMillisecond + 42 * cost);
  }
}

TEST(CpuTime, ARunEndsAtTheFirstBlockBoundary) {
  CpuBench bench;
  bench.put(CpuBench::kMain, {
                                 0xBF00,  // nop
                                 0xBF00,  // nop
                                 0xBF00,  // nop
                                 0xE7FB,  // b .-6
                             });
  bench.cpu().reset(0);
  bench.cpu().run(1);
  EXPECT_EQ(bench.cpu().now(), 4 * kInstruction);
  bench.cpu().run(4 * kInstruction);
  EXPECT_EQ(bench.cpu().now(), 4 * kInstruction);
  bench.cpu().run(4 * kInstruction + 1);
  EXPECT_EQ(bench.cpu().now(), 8 * kInstruction);
}

TEST(CpuTime, APeripheralEndsTheRunEarly) {
  CpuBench bench;
  bench.registers[CpuBench::kBus] = 0;
  SimTime seen = 0;
  bench.on_write = [&](std::uint32_t, std::uint32_t) {
    seen = bench.cpu().now();
    bench.cpu().limit(seen + 100 * kInstruction);
  };
  bench.put(CpuBench::kMain, {
                                 0xF04F, 0x4080,  // mov.w r0, #0x40000000
                                 0x6000,          // str r0, [r0]
                                 0xE7FE,          // b .
                             });
  bench.cpu().reset(0);
  bench.cpu().run(kUnitsPerMillisecond);
  EXPECT_EQ(seen, 3 * kInstruction);  // the end of the block
  EXPECT_EQ(bench.cpu().now(), 103 * kInstruction);
}

TEST(CpuTime, AStallLetsTimePass) {
  CpuBench bench;
  bench.registers[CpuBench::kBus] = 0;
  bench.on_write = [&](std::uint32_t, std::uint32_t) { bench.cpu().stall(85 * kUnitsPerMillisecond); };
  bench.put(CpuBench::kMain, {
                                 0xF04F, 0x4080,  // mov.w r0, #0x40000000
                                 0x6000,          // str r0, [r0]
                                 0x2101,          // movs r1, #1
                                 0xE7FF,          // b .+2
                                 0x2102,          // movs r1, #2
                                 0xE7FE,          // b .
                             });
  bench.cpu().reset(0);
  bench.cpu().run(kUnitsPerMillisecond);
  EXPECT_EQ(bench.cpu().now(), kUnitsPerMillisecond);
  EXPECT_FALSE(bench.cpu().sleeping());
  EXPECT_EQ(bench.cpu().next_wake(), 85 * kUnitsPerMillisecond + 4 * kInstruction);
  EXPECT_EQ(bench.r(1), 1U);
  bench.cpu().idle_until(84 * kUnitsPerMillisecond);
  bench.cpu().run(86 * kUnitsPerMillisecond);
  EXPECT_EQ(bench.r(1), 2U);
}

// Tracing makes it run each turn.
TEST(CpuTime, PassesOverTheTurnsOfAPollingLoopWithoutADifference) {
  struct Outcome {
    std::uint64_t instructions;
    SimTime found_at;
    int reads;
  };
  const auto outcome_of = [](bool traced, SimTime cut) {
    CpuBench bench;
    bench.registers[CpuBench::kBus] = 0;
    bench.put(CpuBench::kMain, {
                                   0xF04F, 0x4080,  // mov.w r0, #0x40000000
                                   0x6801,          // ldr r1, [r0]
                                   0x2900,          // cmp r1, #0
                                   0xD0FC,          // beq .-4
                                   0xBF30,          // wfi
                               });
    bench.cpu().reset(0);
    bench.cpu().trace(traced);
    constexpr SimTime kChange = 100 * kUnitsPerMicrosecond;
    while (bench.cpu().now() < kChange) bench.cpu().run(std::min(kChange, bench.cpu().now() + cut));
    bench.registers[CpuBench::kBus] = 1;
    while (!bench.cpu().sleeping()) bench.cpu().run(bench.cpu().now() + cut);
    return Outcome{bench.cpu().instructions(), bench.cpu().now(), bench.reads};
  };
  const Outcome each = outcome_of(true, kUnitsPerMillisecond);
  EXPECT_GT(each.reads, 1'000);
  for (const SimTime cut : {kUnitsPerMillisecond, 7 * kUnitsPerMicrosecond, kInstruction}) {
    const Outcome passed_over = outcome_of(false, cut);
    EXPECT_EQ(passed_over.instructions, each.instructions) << cut;
    EXPECT_EQ(passed_over.found_at, each.found_at) << cut;
    EXPECT_LE(passed_over.reads, each.reads) << cut;
  }
  EXPECT_LT(outcome_of(false, kUnitsPerMillisecond).reads, 10);
}

TEST(CpuTime, EntryAndReturnCost) {
  CpuBench bench;
  bench.handler(CpuBench::kSvCall, 0x1800);
  bench.put(0x1800, {
                        0x4770,  // bx lr
                    });
  bench.run({
      0xDF00,  // svc #0
      0xBF30,  // wfi
  });
  bench.cpu().reset(0);
  bench.cpu().run(kUnitsPerMillisecond);
  EXPECT_EQ(bench.cpu().now(), 3 * kInstruction + 22 * kCycle);
}

class CpuSleep : public testing::Test {
 protected:
  CpuSleep() {
    bench_.handler(CpuBench::kIrq0, 0x1800);
    bench_.put(0x1800, {
                           0x3401,  // adds r4, #1
                           0x4770,  // bx lr
                       });
  }
  // Interrupt 0 enabled; R6 = 0xE000E000; R4 counts interrupts.
  void run(const CpuBench::Code& program) {
    bench_.put(0x380, program);
    bench_.run({
        0x2400,          // movs r4, #0
        0x2500,          // movs r5, #0
        0xF04F, 0x26E0,  // mov.w r6, #0xE000E000
        0x2001,          // movs r0, #1
        0xF8C6, 0x0100,  // str.w r0, [r6, #0x100]
        0xF000, 0xB8B7,  // b.w .+370
    });
  }
  void interrupt() {
    bench_.cpu().set_irq(0, true);
    bench_.cpu().set_irq(0, false);
    bench_.run_for(kUnitsPerMillisecond);
  }
  CpuBench bench_;
};

TEST_F(CpuSleep, WaitsForAnInterrupt) {
  run({
      0xBF30,  // wfi
      0x3501,  // adds r5, #1
      0xE7FC,  // b .-4
  });
  EXPECT_TRUE(bench_.cpu().sleeping());
  EXPECT_FALSE(bench_.cpu().sleeping_deep());
  EXPECT_EQ(bench_.cpu().next_wake(), kNever);
  EXPECT_EQ(bench_.cpu().now(), kUnitsPerMillisecond);
  for (std::uint32_t i = 1; i < 4; ++i) {
    interrupt();
    EXPECT_EQ(bench_.r(4), i);
    EXPECT_EQ(bench_.r(5), i);
    EXPECT_TRUE(bench_.cpu().sleeping());
  }
}

TEST_F(CpuSleep, WakingTakesTime) {
  SimTime stored = 0;
  bench_.registers[CpuBench::kBus] = 0;
  bench_.on_write = [&](std::uint32_t, std::uint32_t) { stored = bench_.cpu().now(); };
  run({
      0xB672,          // cpsid i
      0xF04F, 0x4080,  // mov.w r0, #0x40000000
      0xBF30,          // wfi
      0x6000,          // str r0, [r0]
      0xE7FE,          // b .
  });
  ASSERT_TRUE(bench_.cpu().sleeping());
  const SimTime interrupted = bench_.cpu().now();
  interrupt();
  EXPECT_EQ(stored, interrupted + CpuTiming{}.wake_up + 2 * kInstruction);
}

// B1.5.19: the usual race-free pattern of a firmware's idle loop.
TEST_F(CpuSleep, PrimaskDoesNotKeepItAsleep) {
  run({
      0xB672,  // cpsid i
      0xBF30,  // wfi
      0x46A0,  // mov r8, r4
      0xB662,  // cpsie i
      0x3501,  // adds r5, #1
      0xE7FA,  // b .-8
  });
  EXPECT_TRUE(bench_.cpu().sleeping());
  interrupt();
  EXPECT_EQ(bench_.r(8), 0U);  // awake before the handler ran
  EXPECT_EQ(bench_.r(4), 1U);
  EXPECT_EQ(bench_.r(5), 1U);
  EXPECT_TRUE(bench_.cpu().sleeping());
}

TEST_F(CpuSleep, PendingUnderPrimaskDoesNotSleep) {
  run({
      0xB672,          // cpsid i
      0x2001,          // movs r0, #1
      0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
      0xBF30,          // wfi
      0x3501,          // adds r5, #1
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.r(5), 1U);
  EXPECT_EQ(bench_.r(4), 0U);
}

TEST_F(CpuSleep, AnInterruptMaskedByBasepriDoesNotWake) {
  run({
      0x2080,          // movs r0, #0x80
      0xF886, 0x0400,  // strb.w r0, [r6, #0x400]
      0xF380, 0x8811,  // msr basepri, r0
      0xBF30,          // wfi
      0x3501,          // adds r5, #1
      0xE7FE,          // b .
  });
  interrupt();
  EXPECT_TRUE(bench_.cpu().sleeping());
  EXPECT_EQ(bench_.r(5), 0U);
}

TEST_F(CpuSleep, MayBeRequiredToWakeUpQuietly) {
  constexpr std::uint16_t kMask = 0xB672;  // cpsid i
  constexpr std::uint16_t kWfi = 0xBF30;
  constexpr std::uint16_t kWfe = 0xBF20;
  constexpr std::uint16_t kNop = 0xBF00;
  constexpr std::uint16_t kUnmask = 0xB662;  // cpsie i
  constexpr std::uint16_t kLoop = 0xE7FE;
  for (const std::uint16_t sleep : {kWfi, kWfe}) {
    const std::vector<CpuBench::Code> noisy_codes{{sleep, kNop, kNop, kNop, kNop, kLoop},
                                                  {kMask, sleep, kUnmask, kLoop},
                                                  {kMask, sleep, kNop, kNop, kNop, kUnmask, kLoop}};
    for (const CpuBench::Code& noisy : noisy_codes) {
      bench_.cpu().guard_wake_up(false);
      EXPECT_NO_THROW(run(noisy));
      EXPECT_TRUE(bench_.cpu().sleeping());
      bench_.cpu().guard_wake_up(true);
      EXPECT_THROW(run(noisy), SimulationError);
    }
    run({kMask, sleep, kNop, kNop, kNop, kNop, kUnmask, kLoop});
    EXPECT_TRUE(bench_.cpu().sleeping());
    interrupt();
    EXPECT_EQ(bench_.r(4), 1U);
    // With an interrupt pending there is no sleep, and so no wake-up.
    EXPECT_NO_THROW(run({kMask,
                         0x2001,          // movs r0, #1
                         0xF8C6, 0x0200,  // str.w r0, [r6, #0x200]
                         kWfi, kUnmask, kLoop}));
  }
  // Sleep-on-exit wakes up into a handler.
  bench_.handler(CpuBench::kSvCall, 0x1800);
  EXPECT_THROW(run({
                   0x2002,  // movs r0, #2
                   0xF8C6,
                   0x0D10,  // str.w r0, [r6, #0xD10]
                   0xDF00,  // svc #0
                   kLoop,
               }),
               SimulationError);
}

TEST_F(CpuSleep, WaitsForAnEvent) {
  run({
      0xBF40,  // sev
      0xBF20,  // wfe
      0x3501,  // adds r5, #1
      0xBF20,  // wfe
      0x3501,  // adds r5, #1
      0xBF20,  // wfe
      0x3501,  // adds r5, #1
      0xE7FE,  // b .
  });
  EXPECT_EQ(bench_.r(5), 1U);
  EXPECT_TRUE(bench_.cpu().sleeping());
  bench_.cpu().set_event();
  EXPECT_FALSE(bench_.cpu().sleeping());
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(bench_.r(5), 2U);
  // An interrupt also wakes it, and its entry and return set an event.
  interrupt();
  EXPECT_EQ(bench_.r(5), 3U);
}

TEST_F(CpuSleep, AReturnFromAnExceptionIsAnEvent) {
  // The handler consumes the event that its entry set.
  bench_.handler(CpuBench::kSvCall, 0x1900);
  bench_.put(0x1900, {
                         0xBF20,  // wfe
                         0x4770,  // bx lr
                     });
  run({
      0xDF00,  // svc #0
      0xBF20,  // wfe
      0x3501,  // adds r5, #1
      0xBF20,  // wfe
      0x3501,  // adds r5, #1
      0xE7FE,  // b .
  });
  EXPECT_EQ(bench_.r(5), 1U);
  EXPECT_TRUE(bench_.cpu().sleeping());
}

TEST_F(CpuSleep, WideEncodingsOfTheHints) {
  run({
      0xF3AF, 0x8004,  // sev.w
      0xF3AF, 0x8002,  // wfe.w
      0x3501,          // adds r5, #1
      0xBF10,          // yield
      0x3501,          // adds r5, #1
      0xF3AF, 0x8003,  // wfi.w
      0x3501,          // adds r5, #1
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.r(5), 2U);
  EXPECT_TRUE(bench_.cpu().sleeping());
}

TEST_F(CpuSleep, APendingInterruptIsAnEventIfEnabled) {
  run({
      0x2001,          // movs r0, #1
      0xF8C6, 0x0180,  // str.w r0, [r6, #0x180]
      0xBF20,          // wfe
      0x3501,          // adds r5, #1
      0x2010,          // movs r0, #0x10
      0xF8C6, 0x0D10,  // str.w r0, [r6, #0xD10]
      0xF8C6, 0x0280,  // str.w r0, [r6, #0x280]
      0xBF20,          // wfe
      0x3501,          // adds r5, #1
      0xBF20,          // wfe
      0x3501,          // adds r5, #1
      0xE7FE,          // b .
  });
  EXPECT_EQ(bench_.r(5), 0U);
  bench_.cpu().set_irq(0, true);
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(bench_.r(5), 0U);  // disabled, and no SEVONPEND
  bench_.cpu().set_event();
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(bench_.r(5), 1U);
  bench_.cpu().set_irq(0, false);
  bench_.cpu().set_irq(1, true);
  bench_.run_for(kUnitsPerMillisecond);
  EXPECT_EQ(bench_.r(5), 2U);
  EXPECT_EQ(bench_.r(4), 0U);
}

TEST_F(CpuSleep, SleepsAgainOnExit) {
  run({
      0x2006,          // movs r0, #6
      0xF8C6, 0x0D10,  // str.w r0, [r6, #0xD10]
      0xBF30,          // wfi
      0x3501,          // adds r5, #1
      0xE7FC,          // b .-4
  });
  EXPECT_TRUE(bench_.cpu().sleeping_deep());
  interrupt();
  interrupt();
  EXPECT_EQ(bench_.r(4), 2U);
  EXPECT_EQ(bench_.r(5), 0U);
  EXPECT_TRUE(bench_.cpu().sleeping_deep());
}

TEST_F(CpuSleep, SysTickWakes) {
  bench_.handler(CpuBench::kSysTick, 0x1800);
  run({
      0xF643, 0x607F,  // movw r0, #15999
      0x6170,          // str r0, [r6, #20]
      0x61B0,          // str r0, [r6, #24]
      0x2007,          // movs r0, #7
      0x6130,          // str r0, [r6, #16]
      0xBF30,          // wfi
      0x3501,          // adds r5, #1
      0xE7FC,          // b .-4
  });
  bench_.cpu().run(from_seconds(0.0101));
  // 16000 cycles: 250 us.
  EXPECT_EQ(bench_.r(4), 40U);
  EXPECT_EQ(bench_.r(5), 40U);
  EXPECT_TRUE(bench_.cpu().sleeping());
  const SimTime tick = bench_.cpu().next_wake();
  EXPECT_GT(tick, bench_.cpu().now());
  EXPECT_LE(tick, from_seconds(0.0103));
  bench_.cpu().idle_until(tick);
  bench_.cpu().run(tick + kUnitsPerMicrosecond * 100);
  EXPECT_EQ(bench_.cpu().next_wake() - tick, 16'000 * kCycle);
}

TEST_F(CpuSleep, SysTickCountsDown) {
  run({
      0xF240, 0x30E7,  // movw r0, #999
      0x6170,          // str r0, [r6, #20]
      0x61B0,          // str r0, [r6, #24]
      0x2005,          // movs r0, #5
      0x6130,          // str r0, [r6, #16]
      0xE7FF,          // b .+2
      0x69B1,          // ldr r1, [r6, #24]
      0xE7FF,          // b .+2
      0x69B2,          // ldr r2, [r6, #24]
      0xF240, 0x73D0,  // movw r3, #2000
      0x3B01,          // subs r3, #1
      0xD1FD,          // bne .-2
      0x6933,          // ldr r3, [r6, #16]
      0xF8D6, 0x8010,  // ldr r8, [r6, #16]
      0xE7FE,          // b .
  });
  // 1000 cycles to zero; the blocks that read it end after two and after four more instructions.
  EXPECT_EQ(bench_.r(1), 996U);
  EXPECT_EQ(bench_.r(2), 988U);
  EXPECT_EQ(bench_.r(3), 0x10005U);  // COUNTFLAG, cleared by the read
  EXPECT_EQ(bench_.r(8), 5U);
}

// A program with work of uneven length, a timer on the bus that interrupts, SysTick, sleep and floating
// point.
class Workload {
 public:
  explicit Workload(std::uint32_t cut_seed) : cuts_(cut_seed) {
    bench_.handler(CpuBench::kIrq0, 0x1800);
    bench_.put(0x1800, {
                           0xF04F, 0x4080,  // mov.w r0, #0x40000000
                           0x2100,          // movs r1, #0
                           0x6041,          // str r1, [r0, #4]
                           0x3401,          // adds r4, #1
                           0xEE01, 0x4A90,  // vmov s3, r4
                           0xEE32, 0x2A21,  // vadd.f32 s4, s4, s3
                           0x2296,          // movs r2, #150
                           0x4362,          // muls r2, r4
                           0xF3C2, 0x0208,  // ubfx r2, r2, #0, #9
                           0x6002,          // str r2, [r0]
                           0x4770,          // bx lr
                       });
    bench_.handler(CpuBench::kSysTick, 0x1900);
    bench_.put(0x1900, {
                           0x3501,          // adds r5, #1
                           0xEE02, 0x5A90,  // vmov s5, r5
                           0x4770,          // bx lr
                       });
    bench_.put(CpuBench::kMain, {
                                    0xF04F, 0x26E0,  // mov.w r6, #0xE000E000
                                    0xF44F, 0x0070,  // mov.w r0, #0xF00000
                                    0xF8C6, 0x0D88,  // str.w r0, [r6, #0xD88]
                                    0xF3BF, 0x8F6F,  // isb
                                    0x2001,          // movs r0, #1
                                    0xF8C6, 0x0100,  // str.w r0, [r6, #0x100]
                                    0xF240, 0x60F1,  // movw r0, #1777
                                    0x6170,          // str r0, [r6, #20]
                                    0x61B0,          // str r0, [r6, #24]
                                    0x2007,          // movs r0, #7
                                    0x6130,          // str r0, [r6, #16]
                                    0xF04F, 0x4080,  // mov.w r0, #0x40000000
                                    0x2164,          // movs r1, #100
                                    0x6001,          // str r1, [r0]
                                    0x2400,          // movs r4, #0
                                    0x2500,          // movs r5, #0
                                    0xEB14, 0x0805,  // adds r8, r4, r5
                                    0xF008, 0x081F,  // and r8, r8, #31
                                    0xF118, 0x0801,  // adds r8, #1
                                    0xEE33, 0x3A02,  // vadd.f32 s6, s6, s4
                                    0xF1B8, 0x0801,  // subs r8, #1
                                    0xD1FB,          // bne .-6
                                    0xB672,          // cpsid i
                                    0xF014, 0x0F03,  // tst r4, #3
                                    0xBF08,          // it eq
                                    0xBF30,          // wfieq
                                    0xB662,          // cpsie i
                                    0xE92D, 0x0130,  // push {r4, r5, r8}
                                    0xE8BD, 0x0130,  // pop {r4, r5, r8}
                                    0xE7E9,          // b .-42
                                });
    bench_.registers[CpuBench::kBus] = 0;
    bench_.registers[CpuBench::kBus + 4] = 0;
    bench_.on_write = [this](std::uint32_t address, std::uint32_t value) {
      if (address == CpuBench::kBus) {
        due_ = bench_.cpu().now() + (50 + static_cast<SimTime>(value)) * kUnitsPerMicrosecond / 4;
        bench_.cpu().limit(due_);
      } else {
        bench_.cpu().set_irq(0, false);
      }
    };
    bench_.cpu().reset(0);
    bench_.cpu().trace(true);
  }

  void run(SimTime end, bool cut) {
    CortexM4& cpu = bench_.cpu();
    while (cpu.now() < end) {
      SimTime until = std::min(end, due_);
      if (cut)
        until = std::min(until, cpu.now() + std::uniform_int_distribution<SimTime>(1, 30'000'000)(cuts_));
      cpu.run(until);
      if (cpu.sleeping()) cpu.idle_until(std::min({until, due_, cpu.next_wake()}));
      if (cpu.now() >= due_) {
        due_ = kNever;
        cpu.set_irq(0, true);
      }
    }
  }

  [[nodiscard]] CpuBench& bench() { return bench_; }

 private:
  CpuBench bench_;
  SimTime due_ = kNever;
  std::mt19937 cuts_;
};

TEST(CpuCuts, ChangeNothing) {
  constexpr SimTime kEnd = 50 * kUnitsPerMillisecond;
  Workload whole(0);
  whole.run(kEnd, false);
  EXPECT_GT(whole.bench().r(4), 500U);
  EXPECT_GT(whole.bench().r(5), 1000U);
  for (std::uint32_t seed = 1; seed <= 5; ++seed) {
    Workload cut(seed);
    cut.run(kEnd, true);
    EXPECT_EQ(cut.bench().cpu().trace_hash(), whole.bench().cpu().trace_hash()) << seed;
    EXPECT_EQ(cut.bench().cpu().instructions(), whole.bench().cpu().instructions());
    EXPECT_EQ(cut.bench().cpu().exceptions(), whole.bench().cpu().exceptions());
    EXPECT_EQ(cut.bench().r(4), whole.bench().r(4));
  }
}

TEST(CpuCuts, TheTraceDistinguishesAnotherRun) {
  Workload one(0);
  one.run(kUnitsPerMillisecond, false);
  Workload other(0);
  other.bench().registers[CpuBench::kBus] = 0;
  other.bench().put(0x190A, {
                                0xBF00,  // nop
                            });
  other.bench().put(0x1900, {
                                0x3501,          // adds r5, #1
                                0xEE02, 0x5A90,  // vmov s5, r5
                                0xBF00,          // nop
                                0x4770,          // bx lr
                            });
  other.run(kUnitsPerMillisecond, false);
  EXPECT_NE(one.bench().cpu().trace_hash(), other.bench().cpu().trace_hash());
}

}  // namespace
}  // namespace groma::sim
