// Start-up code from reset to main() on QEMU's mps2-an386. The arguments come through semihosting.
#include <array>
#include <cstdint>
#include <cstdlib>
#include <cstring>

// The tests' main(). ISO C++ forbids calling main() by its own name.
int tests_main(int argc, char** argv) asm("main");

extern "C" {
extern std::uint32_t stack_top;
extern std::uint8_t data_start;
extern std::uint8_t data_end;
extern std::uint8_t data_load;
extern std::uint8_t bss_start;
extern std::uint8_t bss_end;

void initialise_monitor_handles();
void __libc_init_array();
[[noreturn]] void reset_handler();
}

namespace {

// "Semihosting for AArch32 and AArch64", 2.0.
enum class Call : std::uint32_t { kGetCommandLine = 0x15, kExitExtended = 0x20 };
constexpr std::uint32_t kApplicationExit = 0x20026;
constexpr std::uint32_t kFaultExitCode = 139;

void semihost(Call call, void* block) {
  register auto number asm("r0") = static_cast<std::uint32_t>(call);
  register void* argument asm("r1") = block;
  asm volatile("bkpt 0xAB" : "+r"(number) : "r"(argument) : "memory");
}

[[noreturn]] void fault_handler() {
  std::uint32_t block[] = {kApplicationExit, kFaultExitCode};
  semihost(Call::kExitExtended, block);
  for (;;) {
  }
}

using Handler = void (*)();
struct Vectors {
  std::uint32_t* stack;
  std::array<Handler, 15> handlers;
};

[[gnu::section(".vectors"), gnu::used]] const Vectors kVectors = [] {
  Vectors vectors{.stack = &stack_top, .handlers = {}};
  vectors.handlers.fill(fault_handler);
  vectors.handlers[0] = reset_handler;
  return vectors;
}();

std::array<char, 1024> command_line;
std::array<char*, 32> arguments;

// A word such as GTEST_SHARD_INDEX=1 becomes an environment variable, since bare metal has no environment.
int read_arguments() {
  struct {
    char* text;
    std::uint32_t size;
  } block{command_line.data(), command_line.size()};
  semihost(Call::kGetCommandLine, &block);
  std::size_t count = 0;
  for (char* word = std::strtok(command_line.data(), " "); word != nullptr && count + 1 < arguments.size();
       word = std::strtok(nullptr, " ")) {
    if (word[0] != '-' && std::strchr(word, '=') != nullptr) {
      putenv(word);
    } else {
      arguments[count++] = word;
    }
  }
  return static_cast<int>(count);
}

void enable_fpu() {
  volatile auto& coprocessor_access = *reinterpret_cast<std::uint32_t*>(0xE000ED88);
  coprocessor_access = coprocessor_access | 0xFU << 20;
  asm volatile("dsb\n isb");
}

}  // namespace

void reset_handler() {
  enable_fpu();
  std::memcpy(&data_start, &data_load, static_cast<std::size_t>(&data_end - &data_start));
  std::memset(&bss_start, 0, static_cast<std::size_t>(&bss_end - &bss_start));
  initialise_monitor_handles();
  // GoogleTest's flags take their values from the environment while they are constructed.
  const int count = read_arguments();
  __libc_init_array();
  std::exit(tests_main(count, arguments.data()));
}
