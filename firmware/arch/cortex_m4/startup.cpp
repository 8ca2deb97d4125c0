#include "firmware/arch/cortex_m4/startup.hpp"

#include <algorithm>
#include <cstdint>

#include "firmware/arch/cortex_m4/cpu.hpp"
#include "firmware/arch/cortex_m4/memory.hpp"
#include "firmware/arch/cortex_m4/registers.hpp"

int main();

extern "C" {

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
      ".ltorg" ::"i"(groma::cortex_m4::kStackPaint));
}

[[noreturn, gnu::used]] void start_image() {
  namespace scb = groma::cortex_m4::scb;
  auto& access = scb::kBlock[scb::kCoprocessorAccess];
  access = access | scb::kFpuAccess;
  asm volatile("dsb\n isb" ::: "memory");
  // Memory management, bus and usage faults stay disabled: they escalate to hard faults, which preempt all
  // interrupts.
  auto& control = scb::kBlock[scb::kConfigControl];
  control = control | scb::kTrapDivideByZero;

  groma::cortex_m4::prepare_chip();

  std::copy(groma_data_load, groma_data_load + (groma_data_end - groma_data_begin), groma_data_begin);
  std::fill(groma_bss_begin, groma_bss_end, 0U);
  std::for_each(groma_constructors_begin, groma_constructors_end, [](auto construct) { construct(); });
  main();
  groma::cortex_m4::reset_processor();
}
}
