// The vector table and the code between reset and main().
#include <algorithm>
#include <array>
#include <cstdint>

#include "firmware/board/dwm1001/cpu.hpp"
#include "firmware/board/dwm1001/memory.hpp"
#include "firmware/board/dwm1001/nrf52832.hpp"
#include "firmware/board/dwm1001/silicon.hpp"

int main();

extern "C" {

[[noreturn]] void reset_entry();
void fault_entry();
void watchdog_entry();
void uarte0_entry();
void gpiote_entry();
void timer0_entry();
void ecb_entry();

// Fills the stack, which is not in use yet, with kStackPaint and sets the stack pointer: a debugger may start
// here without the vector table.
[[gnu::naked]] void reset_entry() {
  asm volatile(
      "ldr r0, =groma_stack_begin\n"
      "ldr r1, =groma_stack_end\n"
      "ldr r2, =%c0\n"
      "1: str r2, [r0], #4\n"
      "cmp r0, r1\n"
      "bne 1b\n"
      "mov sp, r1\n"
      "b start_image\n"
      ".ltorg" ::"i"(groma::dwm1001::kStackPaint));
}

[[noreturn, gnu::used]] void start_image() {
  namespace scb = groma::nrf52832::scb;
  namespace nvmc = groma::nrf52832::nvmc;
  auto& access = scb::kBlock[scb::kCoprocessorAccess];
  access = access | scb::kFpuAccess;
  asm volatile("dsb\n isb" ::: "memory");
  // Memory management, bus and usage faults stay disabled: they escalate to hard faults, which preempt all
  // interrupts.
  auto& control = scb::kBlock[scb::kConfigControl];
  control = control | scb::kTrapDivideByZero;
  nvmc::kBlock[nvmc::kCacheConfig] = nvmc::kCacheEnabled;

  groma::dwm1001::prepare_silicon();

  std::copy(groma_data_load, groma_data_load + (groma_data_end - groma_data_begin), groma_data_begin);
  std::fill(groma_bss_begin, groma_bss_end, 0U);
  std::for_each(groma_constructors_begin, groma_constructors_end, [](auto construct) { construct(); });
  main();
  groma::dwm1001::reset_processor();
}
}

namespace {

using Handler = void (*)();

constexpr std::size_t kExceptions = 15;
constexpr std::size_t kInterrupts = 39;

struct VectorTable {
  std::uint32_t* stack_end;
  std::array<Handler, kExceptions + kInterrupts> handlers;
};

consteval std::array<Handler, kExceptions + kInterrupts> handlers() {
  std::array<Handler, kExceptions + kInterrupts> table{};
  // An exception or interrupt without a handler is a fault.
  table.fill(fault_entry);
  table[0] = reset_entry;
  const auto set = [&table](groma::nrf52832::Irq irq, Handler handler) {
    table[kExceptions + static_cast<std::size_t>(irq)] = handler;
  };
  using groma::nrf52832::Irq;
  set(Irq::kUarte0, uarte0_entry);
  set(Irq::kGpiote, gpiote_entry);
  set(Irq::kTimer0, timer0_entry);
  set(Irq::kWatchdog, watchdog_entry);
  set(Irq::kEcb, ecb_entry);
  return table;
}

[[gnu::section(".vectors"), gnu::used]] const VectorTable kVectors{groma_stack_end, handlers()};

}  // namespace
