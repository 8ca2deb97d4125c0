// WFI, WFE, SEV and the event register, SysTick. QEMU does not support sleep-on-exit: cpu_time_test tests it.
#include "test/torture/image.hpp"

namespace torture {
namespace {

constexpr std::uint32_t kSendEventOnPending = 1U << 4;

volatile std::uint32_t ticks;

void tick() {
  ticks = ticks + 1;
  note('t');
}

void start_ticks(std::uint32_t cycles) {
  ticks = 0;
  word(kSystRvr) = cycles - 1;
  word(kSystCvr) = 0;
  word(kSystCsr) = 7;
}

void stop_ticks() {
  word(kSystCsr) = 0;
  word(kIcsr) = 1U << 25;
  barrier();
}

void wait_for_interrupt() {
  asm volatile("dsb\n wfi" ::: "memory");
}
void wait_for_event() {
  asm volatile("dsb\n wfe" ::: "memory");
}
void send_event() {
  asm volatile("sev" ::: "memory");
}

}  // namespace

void test_sleep() {
  print("sleep\n");
  reset_state();
  // Pending while masked: wakes immediately, and is taken after unmasking.
  mask_interrupts();
  pend(1U);
  wait_for_interrupt();
  note('.');
  unmask_interrupts();
  print_log("pending under mask");

  set_handler(kSysTick, tick);
  start_ticks(40'000);
  for (int i = 0; i < 3; ++i) {
    wait_for_interrupt();
    note('.');
  }
  stop_ticks();
  print_log("systick wakes");

  start_ticks(40'000);
  mask_interrupts();
  wait_for_interrupt();
  note('.');
  unmask_interrupts();
  stop_ticks();
  print_log("systick wakes under mask");

  send_event();
  wait_for_event();
  note('.');
  // An interrupt sets the event register.
  pend(1U);
  wait_for_event();
  note('.');
  // A disabled interrupt sets it when it becomes pending, with SEVONPEND.
  word(kIcer) = 1U << 1;
  word(kScr) = kSendEventOnPending;
  barrier();
  pend(1U << 1);
  wait_for_event();
  note('.');
  word(kIcpr) = 1U << 1;
  word(kScr) = 0;
  print_log("events");

  // WFE consumes a waiting event; the next WFE ends with the tick.
  set_handler(kSysTick, tick);
  start_ticks(40'000);
  send_event();
  wait_for_event();
  note('.');
  while (ticks == 0) wait_for_event();
  note('.');
  stop_ticks();
  print_log("event used up");

  word(kSystRvr) = 999;
  word(kSystCvr) = 0;
  word(kSystCsr) = 5;
  while ((word(kSystCsr) & 1U << 16) == 0) {
  }
  print_line("systick control", word(kSystCsr) & 7U);
  print_line("counts within", word(kSystCvr) <= 999 ? 1 : 0);
  word(kSystCsr) = 4;
  word(kSystCvr) = 12345;
  print_line("cleared by a write", word(kSystCvr));
  reset_state();
}

}  // namespace torture
