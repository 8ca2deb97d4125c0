// Faults: their status, the stacked address, and continuing after them.
#include <array>

#include "test/torture/image.hpp"

extern "C" {
std::uint32_t torture_resume;  // where the program continues after the next fault
std::uint32_t torture_fault[8];
void torture_record(const std::uint32_t* frame, std::uint32_t exc_return);
}

namespace torture {
namespace {

constexpr std::uint32_t kNowhere = 0x30000000;
constexpr std::uint32_t kAllFaultsEnabled = 7U << 16;

// Calls torture_record() with the frame's address and EXC_RETURN.
[[gnu::naked]] void fault_handler() {
  asm volatile(
      "tst lr, #4\n"
      "ite eq\n"
      "mrseq r0, msp\n"
      "mrsne r0, psp\n"
      "mov r1, lr\n"
      "push {r4, lr}\n"
      "bl torture_record\n"
      "pop {r4, pc}\n");
}

}  // namespace
}  // namespace torture

void torture_record(const std::uint32_t* frame, std::uint32_t exc_return) {
  torture_fault[0] = torture::ipsr();
  torture_fault[1] = torture::word(torture::kCfsr);
  torture_fault[2] = torture::word(torture::kHfsr);
  torture_fault[3] = (torture_fault[1] & 1U << 15) != 0 ? torture::word(torture::kBfar) : 0;
  torture_fault[4] = exc_return;
  torture_fault[5] = frame[6];
  torture_fault[6] = frame[7];
  torture::word(torture::kCfsr) = torture_fault[1];
  torture::word(torture::kHfsr) = torture_fault[2];
  auto* writable = const_cast<volatile std::uint32_t*>(frame);
  writable[6] = torture_resume & ~1U;
  writable[7] = (writable[7] & ~0x0600FC00U) | 1U << 24;  // Thumb, no IT block
}

namespace torture {
namespace {

// Prints the stacked PC relative to the faulting instruction.
#define TORTURE_FAULT(name, code)                                                              \
  do {                                                                                         \
    std::uint32_t place;                                                                       \
    asm volatile(                                                                              \
        "ldr r0, =torture_resume\n"                                                            \
        "ldr r1, =1f\n"                                                                        \
        "str r1, [r0]\n"                                                                       \
        "ldr r4, =2f\n"                                                                        \
        "mov r5, #0x30000000\n"                                                                \
        "movs r6, #0\n" code                                                                   \
        "\n b 1f\n"                                                                            \
        ".ltorg\n"                                                                             \
        ".thumb_func\n"                                                                        \
        "1: mov %0, r4\n"                                                                      \
        : "=r"(place)::"r0", "r1", "r2", "r3", "r4", "r5", "r6", "r12", "lr", "cc", "memory"); \
    print_fault(name, place);                                                                  \
  } while (false)

void print_fault(const char* name, std::uint32_t place) {
  print(name);
  print("\n");
  print_line("  exception", torture_fault[0]);
  print_line("  cfsr", torture_fault[1]);
  print_line("  hfsr", torture_fault[2]);
  print_line("  bfar", torture_fault[3]);
  print_line("  return", torture_fault[4]);
  print_line("  pc - place", torture_fault[5] - (place & ~1U));
  print_line("  xpsr", torture_fault[6] & 0x07FFFDFF);
  for (std::uint32_t& entry : torture_fault) entry = 0;
}

[[gnu::naked]] void return_to_no_handler() {
  asm volatile(
      "mvn lr, #14\n"
      "bx lr\n");
}

// Returning with the original EXC_RETURN would fault again; this handler returns to the thread.
[[gnu::naked]] void return_handler() {
  asm volatile(
      "mrs r0, msp\n"
      "mov r1, lr\n"
      "push {r4, lr}\n"
      "bl torture_record\n"
      "pop {r4, lr}\n"
      "mvn lr, #6\n"
      "bx lr\n");
}

void each() {
  TORTURE_FAULT("load", "nop\n 2: ldr r0, [r5]\n");
  TORTURE_FAULT("load, post-indexed", "nop\n 2: ldr r0, [r5], #4\n nop\n");
  TORTURE_FAULT("load, byte", "movs r0, #3\n 2: ldrb r0, [r5, r0]\n");
  TORTURE_FAULT("load, double", "nop\n 2: ldrd r0, r1, [r5, #8]\n");
  TORTURE_FAULT("load, multiple", "nop\n 2: ldmia r5!, {r0, r1, r2}\n");
  TORTURE_FAULT("load in an IT block",
                "cmp r6, #0\n itte eq\n moveq r0, #1\n 2: ldreq r1, [r5]\n movne r0, #2\n");
  TORTURE_FAULT("store", "nop\n 2: str r0, [r5, #4]\n");
  TORTURE_FAULT("store, half", "nop\n 2: strh r0, [r5, #-2]\n");
  TORTURE_FAULT("store, multiple", "nop\n 2: stmdb r5!, {r0, r1, r2}\n");
  TORTURE_FAULT("undefined", "nop\n 2: udf #1\n");
  TORTURE_FAULT("undefined, wide", "nop\n 2: udf.w #1\n");
  TORTURE_FAULT("arm state", "ldr r0, =2f\n bic r0, #1\n bx r0\n .align 2\n 2: nop\n");
  TORTURE_FAULT("branch to nowhere", "mov r4, r5\n orr r0, r5, #1\n bx r0\n 2:\n");
  TORTURE_FAULT("branch to never executable", "mov r4, #0xE0000000\n orr r0, r4, #1\n bx r0\n 2:\n");
  TORTURE_FAULT("floating point, off", "nop\n 2: vmov s0, r6\n");
  TORTURE_FAULT("other coprocessor", "nop\n 2: mrc p15, 0, r0, c0, c0, 0\n");
}

}  // namespace

void test_faults() {
  print("faults\n");
  reset_state();
  word(kCcr) = word(kCcr) | 1U << 4;  // divisions by zero
  barrier();
  for (const unsigned exception : {kHardFault, kMemManage, kBusFault, kUsageFault}) {
    set_handler(exception, fault_handler);
  }
  word(kShcsr) = kAllFaultsEnabled;
  barrier();
  print_line("shcsr", word(kShcsr));
  each();
  TORTURE_FAULT("division", "nop\n 2: udiv r0, r5, r6\n");
  TORTURE_FAULT("division, signed", "nop\n 2: sdiv r0, r5, r6\n");

  print("disabled\n");
  word(kShcsr) = 0;
  barrier();
  TORTURE_FAULT("load", "nop\n 2: ldr r0, [r5]\n");
  TORTURE_FAULT("undefined", "nop\n 2: udf #1\n");

  print("masked\n");
  word(kShcsr) = kAllFaultsEnabled;
  mask_interrupts();
  TORTURE_FAULT("load", "nop\n 2: ldr r0, [r5]\n");
  TORTURE_FAULT("supervisor call", "nop\n svc #0\n 2: nop\n");
  unmask_interrupts();
  set_priority(kBusFault, 4);
  set_basepri(4U << 5);
  TORTURE_FAULT("load under basepri", "nop\n 2: ldr r0, [r5]\n");
  set_basepri(0);
  print_line("shcsr", word(kShcsr));

  print("in a handler\n");
  set_priority(kBusFault, 2);
  set_priority(kIrq0, 4);
  set_handler(kIrq0, [] { TORTURE_FAULT("load, above", "nop\n 2: ldr r0, [r5]\n"); });
  pend(1U);
  set_priority(kIrq0, 2);
  set_handler(kIrq0, [] { TORTURE_FAULT("load, alike", "nop\n 2: ldr r0, [r5]\n"); });
  pend(1U);

  print("returns\n");
  set_handler(kSvCall, return_to_no_handler);
  set_handler(kUsageFault, return_handler);
  TORTURE_FAULT("to no handler", "svc #0\n 2: nop\n");

  word(kShcsr) = 0;
  word(kCcr) = word(kCcr) & ~(1U << 4);
  // From here on the FPU is enabled.
  word(kCpacr) = word(kCpacr) | 0xFU << 20;
  barrier();
  reset_state();
}

}  // namespace torture
