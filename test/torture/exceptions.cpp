// Exceptions: nesting, order, masks, stacks, and registers that must be preserved.
#include <array>

#include "test/torture/image.hpp"

extern "C" {
std::uint32_t torture_frame[10];
}

namespace torture {
namespace {

std::array<std::uint32_t, 16> seen;
alignas(8) std::array<std::uint32_t, 256> process_stack;

// --- nesting

void low() {
  note('<');
  print_line("active low", word(kIabr) & 0xFF);
  pend(1U << 1);
  note('>');
}
void high() {
  note('(');
  seen[3] = word(kIcsr);
  pend(1U << 1);  // again, while it is active
  note(')');
}

void middle() {
  note('[');
  if (seen[4]++ == 0) pend(1U << 2 | 1U << 3 | 1U << 4);
  note(']');
}

void nesting() {
  reset_state();
  seen = {};
  set_handler(kIrq0 + 0, low);
  set_handler(kIrq0 + 1, middle);
  set_handler(kIrq0 + 2, high);
  for (const auto& [irq, level] : {std::array{0U, 6U}, {1U, 4U}, {2U, 2U}, {3U, 4U}, {4U, 7U}}) {
    set_priority(kIrq0 + irq, level);
  }
  pend(1U);
  print_log("nesting");
  print_line("icsr in high", seen[3]);
}

// --- order and masks

void order() {
  reset_state();
  for (unsigned i = 0; i < kInterrupts; ++i) set_priority(kIrq0 + i, 7 - i);
  mask_interrupts();
  pend(0xFF);
  word(kIcsr) = 1U << 28;
  print_line("icsr", word(kIcsr));
  note('.');
  unmask_interrupts();
  print_log("by priority");

  reset_state();
  mask_interrupts();
  pend(0xFF);
  unmask_interrupts();
  print_log("by number");

  reset_state();
  for (unsigned i = 0; i < kInterrupts; ++i) set_priority(kIrq0 + i, i);
  set_basepri(4U << 5);
  pend(0xFF);
  note('.');
  set_basepri(6U << 5);
  note('.');
  asm volatile("msr basepri_max, %0\n isb" ::"r"(2U << 5) : "memory");
  asm volatile("msr basepri_max, %0\n isb" ::"r"(7U << 5) : "memory");
  print_line("basepri", basepri());
  pend(0xFF);
  note('.');
  set_basepri(0);
  print_log("basepri");

  reset_state();
  word(kIcer) = 0x0F;
  pend(0xFF);
  note('.');
  word(kIcpr) = 0x03;
  word(kIser) = 0x0F;
  barrier();
  print_log("enable");
}

void masked_handler() {
  note('(');
  asm volatile("cpsid f" ::: "memory");
  pend(1U << 1);
  print_line("faultmask in handler", faultmask());
  note(')');
}

void fault_mask() {
  reset_state();
  set_priority(kIrq0 + 0, 4);
  set_priority(kIrq0 + 1, 2);
  set_handler(kIrq0 + 0, masked_handler);
  pend(1U);
  print_line("faultmask after", faultmask());
  print_log("faultmask");

  reset_state();
  asm volatile("cpsid f" ::: "memory");
  pend(1U);
  note('.');
  asm volatile("cpsie f\n isb" ::: "memory");
  print_log("faultmask in thread");
}

void grouping() {
  for (unsigned group = 4; group < 8; ++group) {
    reset_state();
    word(kAircr) = 0x05FA0000 | group << 8;
    print_line("aircr", word(kAircr));
    set_handler(kIrq0 + 0, [] {
      note('(');
      pend(0x7E);
      note(')');
    });
    constexpr std::array<unsigned, 7> kLevels{5, 4, 3, 2, 1, 7, 6};
    for (unsigned i = 0; i < kLevels.size(); ++i) set_priority(kIrq0 + i, kLevels[i]);
    pend(1U);
    print_log("grouping");
    set_basepri(3U << 5);
    pend(0x7E);
    note('.');
    set_basepri(0);
    print_log("basepri and grouping");
  }
  reset_state();
}

void system_handlers() {
  reset_state();
  set_handler(kNmi, [] {
    note('n');
    pend(1U);
    note('N');
  });
  word(kIcsr) = 1U << 31;
  barrier();
  word(kStir) = 6;
  barrier();
  word(kIcsr) = 1U << 28;
  barrier();
  asm volatile("svc 3" ::: "memory");
  print_log("system handlers");

  set_priority(kSvCall, 3);
  set_priority(kPendSv, 7);
  set_priority(kIrq0, 5);
  set_handler(kSvCall, [] {
    note('s');
    word(kIcsr) = 1U << 28;
    pend(1U);
    word(kIcsr) = 1U << 28;
    barrier();
    note('S');
  });
  asm volatile("svc 4" ::: "memory");
  print_log("supervisor and pended");
  print_line("shpr2", word(kShpr + 4));
  print_line("shpr3", word(kShpr + 8));

  mask_interrupts();
  word(kIcsr) = 1U << 28;
  print_line("pendsv set", word(kIcsr) >> 28 & 1U);
  word(kIcsr) = 1U << 27;
  print_line("pendsv cleared", word(kIcsr) >> 28 & 1U);
  unmask_interrupts();
  print_log("pendsv taken back");
}

// --- stacks

// Records the frame's address, EXC_RETURN and the frame in torture_frame.
[[gnu::naked]] void record_frame() {
  asm volatile(
      "tst lr, #4\n"
      "ite eq\n"
      "mrseq r0, msp\n"
      "mrsne r0, psp\n"
      "ldr r1, =torture_frame\n"
      "str r0, [r1], #4\n"
      "str lr, [r1], #4\n"
      "movs r2, #8\n"
      "1: ldr r3, [r0], #4\n"
      "str r3, [r1], #4\n"
      "subs r2, #1\n"
      "bne 1b\n"
      "bx lr\n"
      ".ltorg");
}

// barrier_end: the address after the barrier. A processor may take a pending interrupt before it.
void print_frame(const char* name, std::uint32_t barrier_end) {
  constexpr std::size_t kReturnAddress = 8;
  constexpr std::uint32_t kBarrierSize = 8;
  print_line(name, torture_frame[0]);
  for (std::size_t i = 1; i < 10; ++i) {
    if (i != kReturnAddress) print_line("  frame", torture_frame[i]);
  }
  print_line("  returns to the barrier", barrier_end - torture_frame[kReturnAddress] <= kBarrierSize ? 1 : 0);
}

void stacks() {
  reset_state();
  set_handler(kIrq0, record_frame);
  std::uint32_t barrier_end = 0;
  asm volatile(
      "movs r2, #0x12\n"
      "movs r3, #0x13\n"
      "mov r12, #0x1c\n"
      "movs r0, #1\n"
      "ldr r1, =0xE000E200\n"
      "str r0, [r1]\n"
      "dsb\n"
      "isb\n"
      "mov %0, pc\n"
      : "=r"(barrier_end)::"r0", "r1", "r2", "r3", "r12", "cc", "memory");
  barrier_end -= 4;  // pc reads as the address of the instruction plus 4
  print_frame("main stack", barrier_end);

  // A stack aligned to four bytes only: entry skips one word, and return restores it.
  std::uint32_t before = 0;
  std::uint32_t after = 0;
  asm volatile(
      "sub sp, #4\n"
      "mov %0, sp\n"
      "movs r0, #1\n"
      "ldr r1, =0xE000E200\n"
      "str r0, [r1]\n"
      "dsb\n"
      "isb\n"
      "mov %1, sp\n"
      "add sp, #4\n"
      : "=&r"(before), "=&r"(after)::"r0", "r1", "cc", "memory");
  print_line("unaligned", before - after);
  print_line("realigned", torture_frame[9] >> 9 & 1U);
  print_line("space", before - torture_frame[0]);

  // A thread on the process stack.
  set_psp(reinterpret_cast<std::uint32_t>(process_stack.data() + process_stack.size()));
  const std::uint32_t main_stack = msp();
  asm volatile(
      "movs r0, #2\n"
      "msr control, r0\n"
      "isb\n"
      "movs r0, #1\n"
      "ldr r1, =0xE000E200\n"
      "str r0, [r1]\n"
      "dsb\n"
      "isb\n"
      "mov %1, pc\n"
      "mrs %0, control\n"
      "svc 5\n"
      "movs r0, #0\n"
      "msr control, r0\n"
      "isb\n"
      : "=&r"(before), "=&r"(barrier_end)::"r0", "r1", "cc", "memory");
  barrier_end -= 4;
  print_line("control on process stack", before);
  print_line("main stack kept", main_stack - msp());
  print_line("process stack kept",
             reinterpret_cast<std::uint32_t>(process_stack.data() + process_stack.size()) - psp());
  print_frame("process stack", barrier_end);

  // Unprivileged: masks and the main stack pointer are not accessible; a supervisor call is.
  set_handler(kSvCall, [] {
    note('s');
    seen[0] = control();
    pend(1U << 2);
    asm volatile("msr control, %0" ::"r"(0) : "memory");  // back to privilege
  });
  asm volatile(
      "movs r0, #3\n"
      "msr control, r0\n"
      "isb\n"
      "cpsid i\n"
      "movs r0, #0xE0\n"
      "msr basepri, r0\n"
      "mrs %0, basepri\n"
      "mrs %1, msp\n"
      "svc 6\n"
      "movs r0, #0\n"
      "msr control, r0\n"
      "isb\n"
      : "=&r"(before), "=&r"(after)::"r0", "cc", "memory");
  print_line("basepri without privilege", before);
  print_line("msp without privilege", after);
  print_line("control in supervisor", seen[0]);
  print_line("primask", primask());
  print_log("without privilege");
}

// --- survival

[[gnu::naked]] void clobber() {
  asm volatile(
      "mov r0, #-1\n"
      "mov r1, r0\n"
      "mov r2, r0\n"
      "mov r3, r0\n"
      "mov r12, r0\n"
      "adds r0, r0, r0\n"
      "ldr r0, =0x7f7f7f7f\n"
      "uadd8 r1, r0, r0\n"
      "qadd r1, r0, r0\n"
      "bx lr\n"
      ".ltorg");
}

// One bit per register that an interrupt changed; the flags, with the DSP ones, before and after.
void survival() {
  reset_state();
  set_handler(kIrq0, clobber);
  std::uint32_t changed = 0;
  std::uint32_t flags_before = 0;
  std::uint32_t flags_after = 0;
  asm volatile(
      "ldr r0, =0x80ff00ff\n"
      "ldr r1, =0x80010101\n"
      "uadd8 r2, r0, r1\n"  // GE
      "qadd r2, r0, r1\n"   // Q
      "subs r2, r1, r0\n"   // NZCV
      "mrs %1, apsr\n"
      "movs r4, #1\n"
      "ldr r5, =0xE000E200\n"
      "msr apsr_nzcvqg, %1\n"
      "mov r0, #0x10\n"
      "mov r1, #0x11\n"
      "mov r2, #0x12\n"
      "mov r3, #0x13\n"
      "mov r8, #0x18\n"
      "mov r9, #0x19\n"
      "mov r10, #0x1a\n"
      "mov r12, #0x1c\n"
      "mov lr, #0x1e\n"
      "str r4, [r5]\n"
      "dsb\n"
      "isb\n"
      "mrs %2, apsr\n"
      "mov %0, #0\n"
      "cmp r0, #0x10\n it ne\n orrne %0, #1\n"
      "cmp r1, #0x11\n it ne\n orrne %0, #2\n"
      "cmp r2, #0x12\n it ne\n orrne %0, #4\n"
      "cmp r3, #0x13\n it ne\n orrne %0, #8\n"
      "cmp r8, #0x18\n it ne\n orrne %0, #16\n"
      "cmp r9, #0x19\n it ne\n orrne %0, #32\n"
      "cmp r10, #0x1a\n it ne\n orrne %0, #64\n"
      "cmp r12, #0x1c\n it ne\n orrne %0, #128\n"
      "cmp lr, #0x1e\n it ne\n orrne %0, #256\n"
      "cmp r4, #1\n it ne\n orrne %0, #512\n"
      : "=&r"(changed), "=&r"(flags_before), "=&r"(flags_after)::"r0", "r1", "r2", "r3", "r4", "r5", "r8",
        "r9", "r10", "r12", "lr", "cc", "memory");
  print_line("registers changed", changed);
  print_line("flags before", flags_before);
  print_line("flags after", flags_after);

  // A supervisor call within an IT block: the IT state is saved in the frame and restored.
  set_handler(kSvCall, record_frame);
  std::uint32_t path = 0;
  asm volatile(
      "movs %0, #0\n"
      "cmp %0, #0\n"
      "itte eq\n"
      "addeq %0, #1\n"
      "svceq 7\n"
      "addne %0, #2\n"
      "add %0, #4\n"
      : "=&r"(path)::"r0", "r1", "r2", "r3", "cc", "memory");
  print_line("path", path);
  print_line("condition state", torture_frame[9] & 0x0600FC00U);
}

}  // namespace

void test_exceptions() {
  print("exceptions\n");
  nesting();
  order();
  fault_mask();
  grouping();
  system_handlers();
  stacks();
  survival();
  reset_state();
}

}  // namespace torture
