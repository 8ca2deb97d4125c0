// How many instructions a second the emulated processor executes.
#include <benchmark/benchmark.h>

#include "test/sim/emulator/cpu_bench.hpp"

namespace groma::sim {
namespace {

// Calls, loads, stores and arithmetic as compiled code has them: blocks of four to six instructions.
const CpuBench::Code kWork = {
    0xF240, 0x1400,  // movw r4, #0x0100
    0xF2C2, 0x0400,  // movt r4, #0x2000
    0x2540,          // movs r5, #64
    0x6820,          // ldr r0, [r4]
    0x1940,          // adds r0, r0, r5
    0xF000, 0xF807,  // bl .+18
    0x4070,          // eors r0, r0, r6
    0xF844, 0x0B04,  // str r0, [r4], #4
    0x3D01,          // subs r5, #1
    0xD1F6,          // bne .-16
    0xBF00,          // nop
    0xE7EF,          // b .-30
    0xB540,          // push {r6, lr}
    0x7861,          // ldrb r1, [r4, #1]
    0x08C6,          // lsrs r6, r0, #3
    0x2980,          // cmp r1, #128
    0xBF88,          // it hi
    0x3607,          // addhi r6, #7
    0x4370,          // muls r0, r6
    0xBD40,          // pop {r6, pc}
};

void run(benchmark::State& state, SimTime quantum) {
  CpuBench bench;
  bench.put(CpuBench::kMain, kWork);
  bench.cpu().reset(0);
  const std::uint64_t before = bench.cpu().instructions();
  for (auto _ : state) {
    const SimTime end = bench.cpu().now() + 10 * kUnitsPerMillisecond;
    while (bench.cpu().now() < end) bench.cpu().run(bench.cpu().now() + quantum);
  }
  state.counters["instructions"] = benchmark::Counter(
      static_cast<double>(bench.cpu().instructions() - before), benchmark::Counter::kIsRate);
}

void BM_in_one_run(benchmark::State& state) {
  run(state, 10 * kUnitsPerMillisecond);
}
BENCHMARK(BM_in_one_run);

void BM_in_quanta_of_40_us(benchmark::State& state) {
  run(state, 40 * kUnitsPerMicrosecond);
}
BENCHMARK(BM_in_quanta_of_40_us);

// From the SVC to the next instruction, by way of a handler that returns at once.
void BM_exceptions(benchmark::State& state) {
  CpuBench bench;
  bench.handler(CpuBench::kSvCall, 0x1800);
  bench.put(0x1800, {
                        0x4770,  // bx lr
                    });
  bench.put(CpuBench::kMain, {
                                 0xDF00,  // svc #0
                                 0xE7FD,  // b .-2
                             });
  bench.cpu().reset(0);
  const std::uint64_t before = bench.cpu().exceptions();
  for (auto _ : state) bench.cpu().run(bench.cpu().now() + kUnitsPerMillisecond);
  state.counters["exceptions"] =
      benchmark::Counter(static_cast<double>(bench.cpu().exceptions() - before), benchmark::Counter::kIsRate);
}
BENCHMARK(BM_exceptions);

}  // namespace
}  // namespace groma::sim
