// Common declarations of the torture image: the processor's registers, replaceable handlers, a log that
// handlers write letters to, and a console through semihosting.
#pragma once

#include <cstddef>
#include <cstdint>

namespace torture {

using Handler = void (*)();

// Exceptions by number.
inline constexpr unsigned kNmi = 2;
inline constexpr unsigned kHardFault = 3;
inline constexpr unsigned kMemManage = 4;
inline constexpr unsigned kBusFault = 5;
inline constexpr unsigned kUsageFault = 6;
inline constexpr unsigned kSvCall = 11;
inline constexpr unsigned kPendSv = 14;
inline constexpr unsigned kSysTick = 15;
inline constexpr unsigned kIrq0 = 16;
inline constexpr unsigned kInterrupts = 8;

// Addresses (ARMv7-M Architecture Reference Manual, B3.2).
inline constexpr std::uint32_t kSystCsr = 0xE000E010;
inline constexpr std::uint32_t kSystRvr = 0xE000E014;
inline constexpr std::uint32_t kSystCvr = 0xE000E018;
inline constexpr std::uint32_t kIser = 0xE000E100;
inline constexpr std::uint32_t kIcer = 0xE000E180;
inline constexpr std::uint32_t kIspr = 0xE000E200;
inline constexpr std::uint32_t kIcpr = 0xE000E280;
inline constexpr std::uint32_t kIabr = 0xE000E300;
inline constexpr std::uint32_t kIpr = 0xE000E400;
inline constexpr std::uint32_t kIcsr = 0xE000ED04;
inline constexpr std::uint32_t kVtor = 0xE000ED08;
inline constexpr std::uint32_t kAircr = 0xE000ED0C;
inline constexpr std::uint32_t kScr = 0xE000ED10;
inline constexpr std::uint32_t kCcr = 0xE000ED14;
inline constexpr std::uint32_t kShpr = 0xE000ED18;
inline constexpr std::uint32_t kShcsr = 0xE000ED24;
inline constexpr std::uint32_t kCfsr = 0xE000ED28;
inline constexpr std::uint32_t kHfsr = 0xE000ED2C;
inline constexpr std::uint32_t kBfar = 0xE000ED38;
inline constexpr std::uint32_t kCpacr = 0xE000ED88;
inline constexpr std::uint32_t kStir = 0xE000EF00;

inline volatile std::uint32_t& word(std::uint32_t address) {
  return *reinterpret_cast<volatile std::uint32_t*>(address);
}
inline volatile std::uint8_t& byte(std::uint32_t address) {
  return *reinterpret_cast<volatile std::uint8_t*>(address);
}

inline void barrier() {
  asm volatile("dsb\n isb" ::: "memory");
}

#define TORTURE_READ(name)                                  \
  inline std::uint32_t name() {                             \
    std::uint32_t value;                                    \
    asm volatile("mrs %0, " #name : "=r"(value)::"memory"); \
    return value;                                           \
  }
#define TORTURE_WRITE(name)                                          \
  inline void set_##name(std::uint32_t value) {                      \
    asm volatile("msr " #name ", %0\n isb" ::"r"(value) : "memory"); \
  }
TORTURE_READ(ipsr)
TORTURE_READ(apsr)
TORTURE_READ(control)
TORTURE_READ(primask)
TORTURE_READ(basepri)
TORTURE_READ(faultmask)
TORTURE_READ(msp)
TORTURE_READ(psp)
TORTURE_WRITE(basepri)
TORTURE_WRITE(control)
TORTURE_WRITE(psp)
#undef TORTURE_READ
#undef TORTURE_WRITE

inline void mask_interrupts() {
  asm volatile("cpsid i" ::: "memory");
}
inline void unmask_interrupts() {
  asm volatile("cpsie i\n isb" ::: "memory");
}

// Handlers live in a vector table in RAM.
void set_handler(unsigned exception, Handler handler);
// Resets handlers, priorities, masks and enables: interrupts 0 to 7 write their letters a to h.
void reset_state();

inline void set_priority(unsigned exception, unsigned level) {
  byte((exception < kIrq0 ? kShpr - 4 : kIpr - kIrq0) + exception) = static_cast<std::uint8_t>(level << 5);
}
inline void pend_quietly(std::uint32_t interrupts) {
  word(kIspr) = interrupts;
}
inline void pend(std::uint32_t interrupts) {
  pend_quietly(interrupts);
  barrier();
}

// The log.
void note(char letter);
void print(const char* text);
void print_line(const char* name, std::uint32_t value);
// Prints the name and the log, and clears the log.
void print_log(const char* name);
void clear_log();
[[noreturn]] void leave(std::uint32_t code);

// The tests.
void test_exceptions();
void test_floating_point();
void test_faults();
void test_sleep();
void test_chance();

}  // namespace torture
