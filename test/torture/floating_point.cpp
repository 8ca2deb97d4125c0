// The floating-point context in exceptions: what is stacked, the value of EXC_RETURN, and what is preserved.
#include <array>

#include "test/torture/image.hpp"

extern "C" {
std::uint32_t torture_return;
std::uint32_t torture_stack;
std::uint32_t value_left;
}

namespace torture {
namespace {

constexpr std::uint32_t kFloatingPointActive = 1U << 2;

[[gnu::naked]] void without_floats() {
  asm volatile(
      "ldr r0, =torture_return\n"
      "str lr, [r0]\n"
      "ldr r0, =torture_stack\n"
      "mov r1, sp\n"
      "str r1, [r0]\n"
      "bx lr\n"
      ".ltorg");
}

[[gnu::naked]] void with_floats() {
  asm volatile(
      "ldr r0, =torture_return\n"
      "str lr, [r0]\n"
      "mrs r1, control\n"
      "ldr r0, =torture_stack\n"
      "str r1, [r0]\n"
      "vmov.f32 s0, #1.0\n"
      "vmov.f32 s7, #1.0\n"
      "vmov.f32 s8, #1.0\n"
      "vmov.f32 s15, #1.0\n"
      "vmrs r0, fpscr\n"
      "orr r0, #0xF0000000\n"
      "orr r0, #0x00C00000\n"
      "vmsr fpscr, r0\n"
      "bx lr\n"
      ".ltorg");
}

float value = 1.5F;

[[gnu::naked]] void overwriting() {
  asm volatile(
      "ldr r0, =torture_return\n"
      "str lr, [r0]\n"
      "vmov.f32 s0, #1.0\n"
      "vmrs r0, fpscr\n"
      "orr r0, #0xC0000000\n"
      "vmsr fpscr, r0\n"
      "bx lr\n"
      ".ltorg");
}

void nested_floats() {
  note('(');
  value = value * 2.0F + 1.0F;
  pend(1U << 1);
  value = value * 2.0F + 3.0F;
  note(')');
}

void inner_floats() {
  note('[');
  value = value * 4.0F + 5.0F;
  pend(1U << 2);  // the same priority: tail-chained
  note(']');
}

void tail_floats() {
  note('{');
  value = value * 0.5F - 7.0F;
  note('}');
}

// Uses floats, is interrupted twice without using any in between, and records what is left.
[[gnu::naked]] void interrupted_twice() {
  asm volatile(
      "vmov.f32 s0, #2.0\n"
      "mov r0, #0x30000000\n"
      "vmsr fpscr, r0\n"
      "movs r0, #2\n"
      "ldr r1, =0xE000E200\n"
      "str r0, [r1]\n"
      "dsb\n"
      "isb\n"
      "str r0, [r1]\n"
      "dsb\n"
      "isb\n"
      "ldr r1, =torture_stack\n"
      "vmrs r0, fpscr\n"
      "str r0, [r1]\n"
      "ldr r1, =value_left\n"
      "vstr s0, [r1]\n"
      "bx lr\n"
      ".ltorg");
}

void pend_and_print(const char* name) {
  std::uint32_t stack = 0;
  asm volatile("mov %0, sp" : "=r"(stack));
  pend(1U);
  print_line(name, torture_return);
  print_line("  space", stack - torture_stack);
  print_line("  control", control() & kFloatingPointActive);
}

void clear_fp_active() {
  set_control(control() & ~kFloatingPointActive);
}

void survival() {
  set_handler(kIrq0, with_floats);
  std::uint32_t changed = 0;
  std::uint32_t status = 0;
  asm volatile(
      "vmov.f32 s0, #2.0\n"
      "vmov.f32 s7, #3.0\n"
      "vmov.f32 s8, #4.0\n"
      "vmov.f32 s15, #5.0\n"
      "vmov.f32 s16, #6.0\n"
      "vmov.f32 s31, #7.0\n"
      "mov r0, #0x50000000\n"
      "vmsr fpscr, r0\n"
      "movs r0, #1\n"
      "ldr r1, =0xE000E200\n"
      "str r0, [r1]\n"
      "dsb\n"
      "isb\n"
      "vmrs %1, fpscr\n"
      "mov %0, #0\n"
      "vmov.f32 s1, #2.0\n vcmp.f32 s0, s1\n vmrs APSR_nzcv, fpscr\n it ne\n orrne %0, #1\n"
      "vmov.f32 s1, #3.0\n vcmp.f32 s7, s1\n vmrs APSR_nzcv, fpscr\n it ne\n orrne %0, #2\n"
      "vmov.f32 s1, #4.0\n vcmp.f32 s8, s1\n vmrs APSR_nzcv, fpscr\n it ne\n orrne %0, #4\n"
      "vmov.f32 s1, #5.0\n vcmp.f32 s15, s1\n vmrs APSR_nzcv, fpscr\n it ne\n orrne %0, #8\n"
      "vmov.f32 s1, #6.0\n vcmp.f32 s16, s1\n vmrs APSR_nzcv, fpscr\n it ne\n orrne %0, #16\n"
      "vmov.f32 s1, #7.0\n vcmp.f32 s31, s1\n vmrs APSR_nzcv, fpscr\n it ne\n orrne %0, #32\n"
      : "=&r"(changed), "=&r"(status)::"r0", "r1", "s0", "s1", "s7", "s8", "s15", "s16", "s31", "cc",
        "memory");
  print_line("registers changed", changed);
  print_line("fpscr", status & 0xF0C00000U);
  print_line("exc_return", torture_return);
  print_line("active in handler", torture_stack & kFloatingPointActive);
}

std::uint32_t bits_of(float number) {
  return __builtin_bit_cast(std::uint32_t, number);
}

}  // namespace

void test_floating_point() {
  print("floating point\n");
  reset_state();
  clear_fp_active();
  set_handler(kIrq0, without_floats);
  pend_and_print("never used");
  asm volatile("vmov.f32 s0, #1.0" ::: "s0");
  pend_and_print("used");
  clear_fp_active();
  pend_and_print("forgotten");
  survival();

  // A thread without floats and a handler with them: the handler does not affect the thread's frames.
  clear_fp_active();
  pend(1U);
  print_line("handler's own", control() & kFloatingPointActive);
  print_line("its return", torture_return);

  set_priority(kIrq0, 4);
  set_handler(kIrq0 + 0, interrupted_twice);
  set_handler(kIrq0 + 1, overwriting);
  pend(1U);
  print_line("left", value_left);
  print_line("its fpscr", torture_stack);
  print_line("seen return", torture_return);

  set_handler(kIrq0 + 0, nested_floats);
  set_handler(kIrq0 + 1, inner_floats);
  set_handler(kIrq0 + 2, tail_floats);
  set_priority(kIrq0 + 0, 4);
  set_priority(kIrq0 + 1, 2);
  set_priority(kIrq0 + 2, 2);
  float mine = 0.25F;
  for (int i = 0; i < 5; ++i) {
    mine = mine * 3.0F + value;
    pend(1U);
    mine -= 1.0F;
  }
  print_line("mine", bits_of(mine));
  print_line("theirs", bits_of(value));
  print_log("nested");
}

}  // namespace torture
