#include <array>

#include "test/torture/image.hpp"

extern "C" {
extern std::uint32_t stack_top;
extern std::uint32_t data_start;
extern std::uint32_t data_end;
extern const std::uint32_t data_load;
extern std::uint32_t bss_start;
extern std::uint32_t bss_end;
[[noreturn]] void reset_handler();
}

namespace torture {
namespace {

// "Semihosting for AArch32 and AArch64", 2.0.
constexpr std::uint32_t kWrite0 = 0x04;
constexpr std::uint32_t kExitExtended = 0x20;
constexpr std::uint32_t kApplicationExit = 0x20026;

void semihost(std::uint32_t operation, const void* argument) {
  register std::uint32_t number asm("r0") = operation;
  register const void* block asm("r1") = argument;
  asm volatile("bkpt 0xAB" : "+r"(number) : "r"(block) : "memory");
}

constexpr unsigned kVectors = kIrq0 + 32;

struct Vectors {
  std::uint32_t* stack;
  std::array<Handler, kVectors - 1> handlers;
};

void unexpected() {
  print_line("unexpected exception", ipsr());
  print_line("cfsr", word(kCfsr));
  leave(3);
}

[[gnu::section(".vectors"), gnu::used]] const Vectors kFirst{&stack_top,
                                                             {reset_handler, unexpected, unexpected}};

// Aligned to the next power of two of its size (B3.2.5).
alignas(256) Vectors vectors;

std::array<char, 512> log;
std::size_t logged;

template <char letter>
void letter_handler() {
  note(letter);
}

}  // namespace

void set_handler(unsigned exception, Handler handler) {
  vectors.handlers[exception - 1] = handler;
  barrier();
}

void note(char letter) {
  if (logged + 2 < log.size()) log[logged++] = letter;
}

void print(const char* text) {
  semihost(kWrite0, text);
}

void print_line(const char* name, std::uint32_t value) {
  std::array<char, 12> text{};
  std::size_t at = 0;
  text[at++] = ' ';
  for (int shift = 28; shift >= 0; shift -= 4) text[at++] = "0123456789abcdef"[value >> shift & 15U];
  text[at++] = '\n';
  print(name);
  print(text.data());
}

void print_log(const char* name) {
  log[logged] = '\n';
  log[logged + 1] = '\0';
  print(name);
  print(" ");
  print(log.data());
  clear_log();
}

void clear_log() {
  logged = 0;
}

void leave(std::uint32_t code) {
  const std::array<std::uint32_t, 2> block{kApplicationExit, code};
  semihost(kExitExtended, block.data());
  for (;;) {
  }
}

void reset_state() {
  unmask_interrupts();
  set_basepri(0);
  word(kIcer) = ~0U;
  word(kIcpr) = ~0U;
  word(kAircr) = 0x05FA0000;
  word(kScr) = 0;
  for (Handler& handler : vectors.handlers) handler = unexpected;
  constexpr std::array<Handler, kInterrupts> kLetters{
      letter_handler<'a'>, letter_handler<'b'>, letter_handler<'c'>, letter_handler<'d'>,
      letter_handler<'e'>, letter_handler<'f'>, letter_handler<'g'>, letter_handler<'h'>};
  for (unsigned i = 0; i < kInterrupts; ++i) {
    set_handler(kIrq0 + i, kLetters[i]);
    set_priority(kIrq0 + i, 0);
  }
  set_handler(kSvCall, letter_handler<'s'>);
  set_handler(kPendSv, letter_handler<'p'>);
  for (const unsigned exception : {kMemManage, kBusFault, kUsageFault, kSvCall, kPendSv, kSysTick}) {
    set_priority(exception, 0);
  }
  word(kIser) = (1U << kInterrupts) - 1;
  barrier();
}

}  // namespace torture

void reset_handler() {
  const std::uint32_t* from = &data_load;
  for (std::uint32_t* to = &data_start; to != &data_end; ++to) *to = *from++;
  for (std::uint32_t* to = &bss_start; to != &bss_end; ++to) *to = 0;
  torture::word(torture::kVtor) = reinterpret_cast<std::uint32_t>(&torture::vectors);
  torture::barrier();
  torture::test_faults();  // first, as the FPU is still off
  torture::test_exceptions();
  torture::test_floating_point();
  torture::test_sleep();
  torture::test_chance();
  torture::leave(0);
}
