// Random interrupts: a generator that all handlers share decides which interrupts are pended where, at which
// priorities and under which masks. Any difference therefore changes all later output.
#include <array>

#include "test/torture/image.hpp"

namespace torture {
namespace {

constexpr int kRounds = 3000;

std::uint32_t state = 12345;
std::uint32_t trace = 2166136261U;
unsigned depth;
float sum;

std::uint32_t draw(std::uint32_t below) {
  state = state * 1664525U + 1013904223U;
  return (state >> 16) % below;
}

void add_to_trace(std::uint32_t what) {
  trace = (trace ^ what) * 16777619U;
}

template <unsigned number>
void handler() {
  ++depth;
  add_to_trace(number | depth << 8);
  note(static_cast<char>('a' + number));
  if (draw(3) == 0) sum = sum * 0.5F + static_cast<float>(number);
  if (draw(2) == 0) pend(1U << draw(kInterrupts));
  if (draw(8) == 0) {
    const std::uint32_t before = basepri();
    set_basepri(draw(8) << 5);
    pend(1U << draw(kInterrupts));
    set_basepri(before);
  }
  if (draw(8) == 0) {
    mask_interrupts();
    pend(1U << draw(kInterrupts));
    unmask_interrupts();
  }
  add_to_trace(ipsr());
  note(static_cast<char>('A' + number));
  --depth;
}

}  // namespace

void test_chance() {
  print("chance\n");
  reset_state();
  constexpr std::array<Handler, kInterrupts> kHandlers{handler<0>, handler<1>, handler<2>, handler<3>,
                                                       handler<4>, handler<5>, handler<6>, handler<7>};
  for (unsigned i = 0; i < kInterrupts; ++i) set_handler(kIrq0 + i, kHandlers[i]);
  for (int round = 0; round < kRounds; ++round) {
    word(kAircr) = 0x05FA0000 | (draw(4) == 0 ? 5U + draw(3) : 0U) << 8;
    for (unsigned i = 0; i < kInterrupts; ++i) set_priority(kIrq0 + i, draw(8));
    const bool masked = draw(2) == 0;
    if (masked) mask_interrupts();
    sum += 1.0F;
    pend(draw(256));
    if (draw(2) == 0) pend(1U << draw(kInterrupts));
    if (masked) unmask_interrupts();
    add_to_trace(word(kIcsr));
    add_to_trace(__builtin_bit_cast(std::uint32_t, sum));
    // The first rounds are printed in full, so that a difference can be analysed.
    if (round < 20) print_log("round");
    if (round % 100 == 0) print_line("trace", trace);
    clear_log();
  }
  print_line("trace", trace);
  print_line("sum", __builtin_bit_cast(std::uint32_t, sum));
}

}  // namespace torture
